"""Random histories of a street, lived through by the store and by its rules in plain words (``plain_rules.py``)."""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from threading import Barrier, Thread

import numpy as np

from hand_made import Say, make_ballot, make_map, make_tile, wall, words_plane
from mapvote.codec.ballot import encode
from mapvote.config import FuseSettings
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Memory, Tile
from mapvote.core.types import NO_VOTE, U8, Bool, MapvoteError
from mapvote_server.errors import Conflict, NotFound
from mapvote_server.store.admission import Intake, Receipt
from mapvote_server.store.examination import examine
from mapvote_server.store.policy import KeepPolicy, Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.retention import clear
from mapvote_server.store.reviews import decide, undo
from mapvote_server.store.rollback import replay, rollback
from mapvote_server.store.store import Store
from mapvote_server.store.votes import withdraw
from plain_rules import CE, CO, DAY_S, UE, UN, UO, Cast, Cell, CellMap, Server, Spoken
from stores import Clock

WALL: list[Cell] = [(10, 10), (10, 11), (10, 12), (11, 10), (11, 11)]
LAWN: list[Cell] = [(20, 20), (20, 21), (30, 30)]
HEIGHTS = (0.05, 0.45, 0.75, 1.05)
BROUGHT = (0.4547, 0.7547)
"""Heights of points as a ballot carries them, in steps of 9.4 mm: a point that vehicles bring back is another one."""
VEHICLES = ("a", "b", "c", "d", "e")
OPEN = {"max_deleted_share": 1.0, "max_freed_share": 1.0}
START_S = 1_700_000_000
WAYS = ("north", "south")
"""That somebody drove who determined much besides, where nothing ever comes or goes."""


def street() -> PointMap:
    """The first map: one tile with the wall."""
    return make_map({(0, 0): make_tile(wall(WALL, list(HEIGHTS)))})


class History:
    """One street, twice: in a store and in plain words. Each step is done to both, then they are compared."""

    def __init__(self, seed: int, make_store: Callable[[Clock], Store]) -> None:
        self.rng = random.Random(seed)
        self.clock = Clock(START_S * 10**9)
        self.store = make_store(self.clock)
        first = FuseSettings.model_validate(OPEN)
        self.policy(first)
        walls = {cell: CellMap(HEIGHTS) for cell in WALL}
        self.rules = Server(walls | {cell: CellMap() for cell in LAWN}, first)
        self.hashes = {1: self.store.tiles(1)[0, 0].points}
        self.drives = 0
        self.published: dict[int, int] = {}
        self.verdicts: list[int] = []
        self.there = dict.fromkeys(WALL, True) | dict.fromkeys(LAWN, False)
        self.ways = WAYS if seed % 3 == 0 else ()
        """In one history of three there are copies."""
        self.masks = 0.9 if seed % 2 else 0.5
        """Share of ballots that mark voxels as gone; in every other history of nearly all, also in cells that stand."""

    @property
    def now_s(self) -> int:
        return self.clock.now // 10**9

    def policy(self, settings: FuseSettings) -> None:
        self.store.set_policy(Policy(fuse=settings))

    def live(self, steps: int, troubled: bool = False) -> None:
        """So many steps; AssertionError, naming the step, at the first difference. In a ``troubled`` history every
        other step goes back, takes a vehicle out or clears away."""
        acts = [self.vote] * 8 + [self.round] * 8 + [self.publish] * 2 + [self.world] * 5
        acts += [self.again, self.back, self.take_out, self.other_policy, self.without, self.race]
        acts += [self.review, self.let_go, self.clear_away] + [self.part] * 3
        if troubled:
            acts += [self.back] * 8 + [self.without] * 7 + [self.take_out] * 2 + [self.clear_away] * 7
        for step in range(steps):
            act = self.rng.choice(acts)
            self.clock.now += self.rng.choice([60, 3_600, DAY_S, 3 * DAY_S]) * 10**9
            act()
            self.compare(f"step {step}, {act.__name__}")

    def world(self) -> None:
        """Something comes or goes."""
        cell = self.rng.choice(WALL + LAWN)
        self.there[cell] = not self.there[cell]

    def vote(self) -> None:
        self.drives += 1
        self._cast(self.rng.choice(VEHICLES), f"d{self.drives}")

    def round(self) -> None:
        """Some vehicles pass, and an operator publishes."""
        for vehicle in self.rng.sample(VEHICLES, 3):
            self.drives += 1
            self._cast(vehicle, f"d{self.drives}")
        self.publish()

    def part(self) -> None:
        """A cell of the wall goes in part, and what it leaves stands beside what is left of its neighbour."""
        here, beside = self.rng.choice([((10, 10), (10, 11)), ((10, 11), (11, 10)), ((11, 11), (10, 12))])
        mapped = self.rules.versions[self.rules.newest].cells
        for vehicle in self.rng.sample(VEHICLES, 3):
            self.drives += 1
            gone = [self.rng.choice([0b1110, 0b0110, 0b1010, 0b1100, 0b0100, 0b1000]) for _ in range(2)]
            says = {
                here: Spoken(CE if mapped[here].stands() else UE, gone[0]),
                beside: Spoken(UO if mapped[beside].stands() else UE, gone[1]),
            }
            self._send_and_tell(vehicle, f"d{self.drives}", self.rules.newest, says)
        self.publish()

    def again(self) -> None:
        """A drive is sent once more, with other votes."""
        standing = [cast for cast in self.rules.casts if cast.gone_at is None]
        if standing:
            cast = self.rng.choice(standing)
            self._cast(cast.vehicle, cast.drive)

    def _cast(self, vehicle: str, drive: str) -> None:
        rng, newest = self.rng, self.rules.newest
        version = newest if rng.random() < 0.6 else rng.randint(max(1, newest - 3), newest)
        has_free = rng.random() < 0.7
        masks = rng.random() < self.masks
        mapped = self.rules.versions[version].cells
        says = {c: say(rng, self.there[c], mapped[c], masks, has_free) for c in WALL + LAWN if rng.random() < 0.7}
        if not says:
            return
        self._send_and_tell(vehicle, drive, version, says, masks, has_free)

    def _send_and_tell(
        self, vehicle: str, drive: str, version: int, says: dict[Cell, Spoken], masks: bool = True, free: bool = False
    ) -> None:
        """A ballot to the store and to the rules, which must agree on whether it counts."""
        rng, way = self.rng, self.rng.choice(["", *self.ways])
        states = seen_along(way, rng.choice([0, 0, 1]))
        for cell, spoken in says.items():
            states[cell] = spoken.state
        end_s = self._end_s(self.now_s - rng.choice([1, 30, 5_000, 2 * DAY_S]) - self.drives)
        counts = bool(way) or self.rules.counts_anywhere(version, says)
        if self._send(vehicle, drive, end_s, version, states, says, masks, free) != counts:
            raise AssertionError(f"{vehicle}/{drive} counts: {counts}, and the store thinks otherwise")
        if counts:
            plane = states.tobytes()
            self.rules.vote(Cast(vehicle, drive, end_s, version, says, free, self.now_s, 0, None, way, plane))

    def _end_s(self, about: int) -> int:
        """A moment at which no drive has ended yet: of two that end at once the hashes decide."""
        taken = {cast.end_s for cast in self.rules.casts}
        while about in taken:
            about -= 1
        return about

    def _send(
        self, vehicle: str, drive: str, end_s: int, version: int, states: U8,
        says: dict[Cell, Spoken], masks: bool, has_free: bool,
    ) -> bool:  # fmt: skip
        points = [wall([cell], list(s.heights)) for cell, s in says.items() if s.heights]
        say = Say(
            states,
            gone=words_plane({cell: s.gone or 0 for cell, s in says.items()}) if masks else None,
            new_points=np.concatenate(points) if points else None,
            free=words_plane({cell: s.free for cell, s in says.items()}) if has_free else None,
        )
        base = {(0, 0): self.hashes[version]}
        ballot = make_ballot(street(), {(0, 0): say}, vehicle, drive, end_s * 10**9, base=base, version=version)
        (receipt,) = Intake(self.store).write([examine(encode(ballot))])
        assert isinstance(receipt, Receipt | Conflict), receipt
        return isinstance(receipt, Receipt)

    def publish(self) -> None:
        """Then once more: a publish without new votes changes nothing."""
        done = publish(self.store, override=True).published
        again = publish(self.store, override=True)
        assert not again.published, (
            f"published without new votes: {again.points_deleted} points go, {again.points_added} come"
        )
        assert done == self._publish_by_the_rules(), f"published: {done}"

    def _publish_by_the_rules(self) -> bool:
        done = self.rules.publish(self.now_s)
        if done:
            self.published[self.rules.newest] = self.rules.seq
        return done

    def race(self) -> None:
        """Two operators publish at once: one version at most, whoever wins."""
        barrier, parent = Barrier(2), self.store.current()

        def attempt() -> None:
            barrier.wait()
            with suppress(Conflict):
                publish(self.store, override=True, parent=parent)

        both = [Thread(target=attempt) for _ in range(2)]
        for one in both:
            one.start()
        for one in both:
            one.join()
        self._publish_by_the_rules()

    def back(self) -> None:
        if self.rules.newest > 1:
            to = self.rng.randint(1, self.rules.newest - 1)
            if to < self.rules.oldest:
                with suppress(NotFound):
                    rollback(self.store, to)
                    raise AssertionError(f"rolled back to version {to}, which was cleared away")
                return
            rollback(self.store, to)
            self.rules.rollback(to, self.now_s)

    def clear_away(self) -> None:
        """Garbage is collected: all but the last versions, and ballots that can decide nothing more."""
        keep = self.rng.choice([1, 2, 4])
        self.store.set_policy(Policy(fuse=self.rules.settings, keep=KeepPolicy(versions=keep)))
        clear(self.store, dry_run=False)
        self.policy(self.rules.settings)
        self.rules.clear_away(keep)

    def take_out(self) -> None:
        vehicle = self.rng.choice(VEHICLES)
        with suppress(NotFound):
            withdraw(self.store, vehicle, by="operator")
            self.rules.withdraw(vehicle)

    def review(self) -> None:
        """Somebody holds a change of some cells, or rejects it."""
        cells = self.rng.sample(WALL + LAWN, 2)
        verdict = self.rng.choice(["held", "rejected"])
        plane = np.zeros((256, 256), dtype=np.bool_)
        plane[tuple(zip(*cells, strict=True))] = True
        kind = str(len(self.rules.reviews))  # each of its own kind: none is in the place of another
        feature = {"id": kind, "properties": {"kind": kind}}
        seq = decide(self.store, "held" if verdict == "held" else "rejected", feature, {(0, 0): plane}, by="anna")
        self.rules.review(verdict, cells)
        self.verdicts.append(seq)

    def let_go(self) -> None:
        """A verdict is taken back."""
        standing = [i for i, review in enumerate(self.rules.reviews) if review.gone_at is None]
        if standing:
            which = self.rng.choice(standing)
            undo(self.store, self.verdicts[which], by="anna")
            self.rules.let_go(which)

    def other_policy(self) -> None:
        rng = self.rng
        settings = FuseSettings(
            min_votes=rng.choice([1, 2, 2, 3]),
            latest_vehicles=rng.choice([2, 3, 9]),
            max_age_days=rng.choice([2.0, 30.0]),
            min_age_s=rng.choice([0.0, 0.0, 7_200.0]),
            prior_stay_days=rng.choice([30.0, 30.0, 27.0]),
        ).model_copy(update=OPEN)
        self.policy(settings)
        self.rules.settings = settings

    def without(self) -> None:
        vehicle = self.rng.choice(VEHICLES)
        if any(cast.vehicle == vehicle for cast in self.rules.casts):
            replay(self.store, vehicle, dry_run=False)
            self.rules.replay(vehicle, self.now_s)

    def compare(self, where: str) -> None:
        """The newest version, cell by cell, and nothing anywhere else."""
        newest = self.store.current()
        assert newest == self.rules.newest, f"{where}: version {newest}, by the rules {self.rules.newest}"
        if newest in self.hashes:
            return
        tile = self.store.tile(newest, (0, 0))
        assert tile is not None
        self.hashes[newest] = self.store.tiles(newest)[0, 0].points
        expected = self.rules.versions[newest]
        assert (tile.free is not None) == expected.knows_free, f"{where}: knows of free space"
        for cell, wanted in expected.cells.items():
            found = held_by(tile, cell)
            assert found == wanted, f"{where}: cell {cell} is {found}, by the rules {wanted}"
        assert len(tile.points) == sum(len(cell.heights) for cell in expected.cells.values()), where


def say(rng: random.Random, there: bool, mapped: CellMap, masks: bool, has_free: bool) -> Spoken:
    """Mostly the truth about a cell, as seen against what the map holds of it."""
    truth = {(True, True): UO, (True, False): CE, (False, True): CO, (False, False): UE}[mapped.stands(), there]
    state = truth if rng.random() < 0.75 else rng.choice([UO, UE, CO, CE, UN])
    marks = masks and state in (CE, UO) and rng.random() < 0.7
    gone = rng.choice([0b1110, 0b0110, 0b0010, 0b1010, 0b1100, 0b0100, 0]) if marks else 0
    heights = rng.choice([BROUGHT, BROUGHT[:1], BROUGHT[1:]]) if state == CO else ()
    return Spoken(state, gone if masks else None, heights, rng.choice([0, 0b111000, 0b110]) if has_free else 0)


def held_by(tile: Tile, cell: Cell) -> CellMap:
    """Content and memory of a tile in one cell."""
    heights = tile.points[tile.cells == cell[0] * 256 + cell[1], 2]
    remembered = (int(n) for n in (tile.memory or Memory.none()).planes[:, cell[0], cell[1]])
    free = 0 if tile.free is None else int(tile.free[cell])
    return CellMap(tuple(round(float(z), 4) for z in heights), free, *remembered)


@cache
def _mask(way: str) -> Bool:
    """View from a path, without the wall and the lawn: its border wanders, in parts of the tile of its own."""
    if not way:
        return np.zeros((256, 256), dtype=np.bool_)
    borders = np.random.default_rng(WAYS.index(way)).integers(-5, 6, (2, 256)).cumsum(axis=1).clip(-20, 20)
    rows, (first, last) = np.arange(256)[:, None], {"north": (70, 130), "south": (160, 220)}[way]
    return np.asarray((rows > first + borders[0]) & (rows < last + borders[1]))


def seen_along(way: str, by: int) -> U8:
    """States of a drive that went a way, moved by so many cells: nothing has changed there."""
    return np.where(np.roll(_mask(way), by, axis=1), np.uint8(UE), np.uint8(NO_VOTE))


def live(seed: int, make_store: Callable[[Clock], Store], steps: int = 40, *, troubled: bool = False) -> str | None:
    """One history; what the store and the rules disagree on, None if on nothing. ``troubled``: with many rollbacks,
    vehicles taken out, replays and clearings."""
    history = History(seed, make_store)
    try:
        history.live(steps, troubled)
    except (AssertionError, MapvoteError) as error:
        return f"seed {seed}: {type(error).__name__} {error}"
    finally:
        history.store.close()
    return None
