"""A street with ten parking spaces: does what is published ever contradict the world, and how late is it?

    python benchmarks/parked_cars.py

Cars stay for a while and go, some days later the next one comes. Every day three vehicles of the fleet pass at random
minutes, each with the newest map, and say what is there; after every pass the server publishes. "against the truth"
counts published changes that make a space other than it is at that moment; "hours" is from a change of the world to its
publication, median and worst. Changes that were never published were overtaken by the next, or are of what comes and
goes and is kept out of the map. With noise every vehicle is wrong about every space with that probability. Truth is the
simulation's. At the end a house that stood for a year falls: after how many passes is it gone?
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Cell, Say, make_ballot, make_map, make_tile, states_plane, wall
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
class Space:
    """A parking space of the world."""

    until_h: float
    parked: bool = False
    changed_h: float = np.nan

    def move_on(self, hour: float, stay_days: float, rng: random.Random) -> bool:
        """Whether it changed."""
        if hour < self.until_h:
            return False
        self.parked, self.changed_h = not self.parked, self.until_h
        self.until_h += 24 * (stay_days if self.parked else rng.uniform(0.5, EMPTY_DAYS))
        return True


class Server:
    """A store with a clock, and vehicles that say what stands on things of one tile."""

    def __init__(self, folder: str, first: PointMap, prior_days: float = 30.0) -> None:
        self.now_ns = START_NS
        policy = Policy(fuse=FuseSettings(prior_stay_days=prior_days, max_deleted_share=1.0))
        self.store = Store.create(f"sqlite:///{folder}/store.db", first, policy, clock=lambda: self.now_ns)
        self.point_map = self.store.point_map()

    def holds(self, things: list[list[Cell]]) -> list[bool]:
        """Which of the things the map holds."""
        tile = self.point_map.tiles[0, 0]
        standing = {divmod(int(cell), 256) for cell, z in zip(tile.cells, tile.points[:, 2], strict=True) if z > 0.3}
        return [not standing.isdisjoint(cells) for cells in things]

    def told(self, things: list[list[Cell]], seen: list[bool], vehicle: str, drive: str) -> bool:
        """A vehicle saw these of the things; whether the server then published."""
        states, new = {}, [wall([], [])]
        for cells, there, mapped in zip(things, seen, self.holds(things), strict=True):
            state = {
                (True, True): CellState.UNCHANGED_OCCUPIED,
                (True, False): CellState.CHANGED_OCCUPIED,
                (False, True): CellState.CHANGED_EMPTY,
                (False, False): CellState.UNCHANGED_EMPTY,
            }[there, mapped]
            states |= dict.fromkeys(cells, int(state))
            new += [wall(cells, HEIGHTS)] if state == CellState.CHANGED_OCCUPIED else []
        say = Say(states_plane(states), new_points=np.concatenate(new) if len(new) > 1 else None)
        data = encode(make_ballot(self.point_map, {(0, 0): say}, vehicle, drive, self.now_ns - 10**9))
        (receipt,) = accept(self.store, [examine(data)])
        assert isinstance(receipt, Receipt), receipt
        published = publish(self.store).published
        self.point_map = self.store.point_map() if published else self.point_map
        return bool(published)


def live(stay_days: float, fleet: int, noise: float, days: int, prior_days: float) -> tuple[object, ...]:
    """So many days of one street: (changes, published, against the truth, hours)."""
    rng = random.Random(1)
    street = [Space(rng.uniform(0, 24 * min(stay_days, EMPTY_DAYS))) for _ in SPACES]
    ground = make_map({(0, 0): make_tile(wall([(r, c) for r in range(0, 80, 8) for c in range(0, 220, 8)], [0.05]))})
    changes, published, against, hours = 0, 0, 0, list[float]()
    with tempfile.TemporaryDirectory() as folder:
        server = Server(folder, ground, prior_days)
        for day in range(days):
            minutes = sorted(rng.sample(range(24 * 60), 3))
            for vehicle, minute in zip(rng.sample(range(fleet), 3), minutes, strict=True):
                hour = 24 * day + minute / 60
                changes += sum([space.move_on(hour, stay_days, rng) for space in street])
                server.now_ns = START_NS + round(hour * HOUR_NS)
                before = server.holds(SPACES)
                seen = [space.parked != (rng.random() < noise) for space in street]
                if server.told(SPACES, seen, f"v{vehicle}", f"d{day}"):
                    for space, old, new in zip(street, before, server.holds(SPACES), strict=True):
                        published += old != new
                        against += old != new != space.parked
                        hours += [hour - space.changed_h] if old != new == space.parked else []
        server.store.close()
    return changes, published, against, f"{np.median(hours):.0f} / {max(hours):.0f}" if hours else "-"


def house_falls(fleet: int) -> int:
    """After a year in which each of three passes a day said "unchanged": how many passes until the house is gone."""
    with tempfile.TemporaryDirectory() as folder:
        server = Server(folder, make_map({(0, 0): make_tile(wall(HOUSE, [0.05, *HEIGHTS]))}))
        number, gone = 0, False
        while not gone:
            server.now_ns += 8 * HOUR_NS
            gone = server.told([HOUSE], [number < 365 * 3], f"v{number % fleet}", f"d{number}")
            number += 1
        server.store.close()
    return number - 365 * 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--days", type=int, default=90)
    parser.add_argument("--stay", type=float, nargs="+", default=[1, 3, 7, 20], help="how long cars stay, days")
    asked = parser.parse_args()
    print("| prior_stay_days | noise | stay, days | fleet | changes | published | against the truth | hours |")
    print("|---|---|---|---|---|---|---|---|")
    for prior_days, noise in ((30.0, 0.0), (30.0, 0.02), (25.0, 0.0)):
        for stay_days in asked.stay:
            for fleet in (3, 30, 90):
                found = live(stay_days, fleet, noise, asked.days, prior_days)
                row = f"{prior_days:g}", f"{noise:.0%}", stay_days, fleet, *found
                print("| " + " | ".join(map(str, row)) + " |", flush=True)
    for fleet in (3, 30, 90):
        print(f"| a house falls after a year, fleet of {fleet} | gone after {house_falls(fleet)} passes |", flush=True)


if __name__ == "__main__":
    main()
