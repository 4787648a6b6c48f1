"""A street with ten parking spaces: does what is published ever contradict the world, and how late is it?

python benchmarks/parked_cars.py

Cars stay for a while and go, some days later the next one comes. Every day three vehicles of the fleet pass at random
minutes, each with the newest map, and say what is there; after every pass (``--nightly``: after the last of a day) the
server publishes. "against the truth" counts published changes that make a space other than it is at that moment;
"hours" is from a change of the world to its publication, median and worst. Changes that were never published were
overtaken by the next, or are of what comes and goes and is kept out of the map. With noise every vehicle is wrong about
every space with that probability. Truth is the simulation's.

``--house``: a house that stood for a year falls. How many passes until it is gone?
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from mapvote.codec.ballot import encode
from mapvote.config import FuseSettings
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote.server.store.admission import Receipt, accept, examine
from mapvote.server.store.policy import Policy
from mapvote.server.store.publish import publish
from mapvote.server.store.store import Store

HOUR_NS = 3_600 * 10**9
START_NS = 1_700_000_000 * 10**9
SPACES = [[(20, 20 * i + c) for c in range(4)] for i in range(1, 11)]
HOUSE = [(60, 60 + c) for c in range(20)]
HEIGHTS = [0.45, 0.75, 1.05]
EMPTY_DAYS = 3.0
"""A space is empty between half a day and so long before the next car comes."""


@dataclass(slots=True)
class Street:
    """The world, and when each space last changed."""

    stay_days: float
    rng: random.Random
    parked: list[bool] = field(default_factory=lambda: [False] * len(SPACES))
    until_h: list[float] = field(default_factory=list)
    changed_h: list[float | None] = field(default_factory=lambda: [None] * len(SPACES))
    changes: int = 0

    def __post_init__(self) -> None:
        self.until_h = [self.rng.uniform(0, 24 * min(self.stay_days, EMPTY_DAYS)) for _ in SPACES]

    def move_on(self, hour: float) -> None:
        for i, until in enumerate(self.until_h):
            if hour >= until:
                self.parked[i] = not self.parked[i]
                self.changed_h[i], self.changes = until, self.changes + 1
                days = self.stay_days if self.parked[i] else self.rng.uniform(0.5, EMPTY_DAYS)
                self.until_h[i] = until + 24 * days


@dataclass(slots=True)
class Result:
    """One row of the table."""

    published: int = 0
    against: int = 0
    hours: list[float] = field(default_factory=list)
    changes: int = 0


def holds(point_map: PointMap) -> list[bool]:
    """Which spaces hold a car in the map."""
    tile = point_map.tiles[0, 0]
    standing = {int(cell) for cell, z in zip(tile.cells, tile.points[:, 2], strict=True) if z > 0.3}
    return [any(r * 256 + c in standing for r, c in cells) for cells in SPACES]


def ballot(point_map: PointMap, parked: list[bool], vehicle: str, drive: str, now_ns: int) -> bytes:
    """What a vehicle says that takes ``parked`` for the world."""
    states, new = {}, []
    for cells, there, mapped in zip(SPACES, parked, holds(point_map), strict=True):
        state = {
            (True, True): CellState.UNCHANGED_OCCUPIED,
            (True, False): CellState.CHANGED_OCCUPIED,
            (False, True): CellState.CHANGED_EMPTY,
            (False, False): CellState.UNCHANGED_EMPTY,
        }[there, mapped]
        states |= dict.fromkeys(cells, int(state))
        new += [wall(cells, HEIGHTS)] if state == CellState.CHANGED_OCCUPIED else []
    say = Say(states_plane(states), new_points=np.concatenate(new) if new else None)
    return encode(make_ballot(point_map, {(0, 0): say}, vehicle, drive, now_ns))


def live(stay_days: float, fleet: int, noise: float, days: int, prior_days: float, nightly: bool) -> Result:
    """So many days of one street."""
    rng, now, result = random.Random(1), [START_NS], Result()
    street = Street(stay_days, rng)
    ground = make_map({(0, 0): make_tile(wall([(r, c) for r in range(0, 80, 8) for c in range(0, 220, 8)], [0.05]))})
    settings = FuseSettings(prior_stay_days=prior_days, max_deleted_share=1.0)
    with tempfile.TemporaryDirectory() as folder:
        url = f"sqlite:///{folder}/store.db"
        store = Store.create(url, ground, Policy(fuse=settings), clock=lambda: now[0])
        point_map = store.point_map()
        for day in range(days):
            minutes = sorted(rng.sample(range(24 * 60), 3))
            for k, (vehicle, minute) in enumerate(zip(rng.sample(range(fleet), 3), minutes, strict=True)):
                hour = 24 * day + minute / 60
                street.move_on(hour)
                now[0] = START_NS + round(hour * HOUR_NS)
                seen = [there != (rng.random() < noise) for there in street.parked]
                data = ballot(point_map, seen, f"v{vehicle}", f"d{day}", now[0] - 10**9)
                (receipt,) = accept(store, [examine(data)])
                assert isinstance(receipt, Receipt), receipt
                if nightly and k < 2:
                    continue
                before = holds(point_map)
                if publish(store).published:
                    point_map = store.point_map()
                    _judge(result, street, before, holds(point_map), hour)
        store.close()
    result.changes = street.changes
    return result


def _judge(result: Result, street: Street, before: list[bool], after: list[bool], hour: float) -> None:
    for i, (old, new) in enumerate(zip(before, after, strict=True)):
        if old != new:
            result.published += 1
            result.against += new != street.parked[i]
            since = street.changed_h[i]
            if new == street.parked[i] and since is not None:
                result.hours.append(hour - since)


def house_falls(fleet: int, passes_a_day: int = 3) -> int:
    """After a year in which every pass said "unchanged": how many passes until the house is gone."""
    now = [START_NS]
    first = make_map({(0, 0): make_tile(wall(HOUSE, [0.05, *HEIGHTS]))})
    policy = Policy(fuse=FuseSettings(max_deleted_share=1.0))
    with tempfile.TemporaryDirectory() as folder:
        store = Store.create(f"sqlite:///{folder}/store.db", first, policy, clock=lambda: now[0])
        point_map = store.point_map()

        def passes(number: int, state: CellState) -> None:
            now[0] += 24 // passes_a_day * HOUR_NS
            say = Say(states_plane(dict.fromkeys(HOUSE, int(state))))
            one = make_ballot(point_map, {(0, 0): say}, f"v{number % fleet}", f"d{number}", now[0] - 10**9)
            (receipt,) = accept(store, [examine(encode(one))])
            assert isinstance(receipt, Receipt), receipt

        year = 365 * passes_a_day
        for number in range(year):
            passes(number, CellState.UNCHANGED_OCCUPIED)
        needed = 0
        while not publish(store).published:
            passes(year + needed, CellState.CHANGED_EMPTY)
            needed += 1
        store.close()
    return needed


def rows(asked: argparse.Namespace) -> Iterator[tuple[object, ...]]:
    for prior_days, noise in ((30.0, 0.0), (30.0, 0.02), (25.0, 0.0)):
        for stay_days in (1, 3, 7, 20) if asked.stay is None else (asked.stay,):
            for fleet in (3, 30, 90):
                found = live(stay_days, fleet, noise, asked.days, prior_days, asked.nightly)
                late = f"{np.median(found.hours):.0f} / {max(found.hours):.0f}" if found.hours else "-"
                counts = found.changes, found.published, found.against
                yield (f"{prior_days:g}", f"{noise:.0%}", stay_days, fleet, *counts, late)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--days", type=int, default=90)
    parser.add_argument("--stay", type=float, help="only this stay, days")
    parser.add_argument("--nightly", action="store_true", help="publish once a day")
    parser.add_argument("--house", action="store_true", help="only the house")
    asked = parser.parse_args()
    if not asked.house:
        print("| prior_stay_days | noise | stay, days | fleet | changes | published | against the truth | hours |")
        print("|---|---|---|---|---|---|---|---|")
        for row in rows(asked):
            print("| " + " | ".join(map(str, row)) + " |", flush=True)
    for fleet in (3, 30, 90):
        print(f"| a house falls after a year, fleet of {fleet} | gone after {house_falls(fleet)} passes |", flush=True)


if __name__ == "__main__":
    main()
