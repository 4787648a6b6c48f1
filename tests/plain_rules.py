"""The rules of the server in plain words, one cell at a time and nothing skipped: what the store must agree with.

Written from the documentation, not from the code: no array holds more than one cell, every publish decides every cell
afresh, and a replay goes through everything again. One tile, few cells, two-stage ballots of the columns rule, flat
ground at 0: the points of a cell are their heights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from mapvote.config import FuseSettings

UO, UE, CO, CE, UN = range(5)
Cell = tuple[int, int]
DAY_S = 86_400
LAYER_M = 0.3
EVERY = (1 << 64) - 1


@dataclass(frozen=True)
class CellMap:
    """Content of one cell in a version, and its memory."""

    heights: tuple[float, ...] = ()
    free: int = 0
    changed: int = 0
    came_s: int = 0
    stays: int = 0
    stayed_s: int = 0

    def stands(self) -> bool:
        return any(z >= LAYER_M for z in self.heights)

    def same_as(self, other: CellMap) -> bool:
        return self.heights == other.heights and self.free == other.free


@dataclass(frozen=True)
class Spoken:
    """One drive's statement on one cell."""

    state: int
    gone: int | None = None
    heights: tuple[float, ...] = ()
    free: int = 0


@dataclass(frozen=True)
class Cast:
    """A ballot as the server took it in."""

    vehicle: str
    drive: str
    end_s: int
    version: int
    says: dict[Cell, Spoken]
    has_free: bool
    received_s: int
    seq: int
    gone_at: int | None = None
    way: str = ""
    """A drive that determined much besides: where. Whoever says the same of one way sent one drive twice."""
    plane: bytes = b""
    """All that it says, 256 x 256 states."""


@dataclass(frozen=True)
class Review:
    """Votes on these cells that count no more: of a rejected change those of drives first heard of before it was
    rejected, of a held one all."""

    verdict: str
    cells: list[Cell]
    seq: int
    gone_at: int | None = None


@dataclass(frozen=True)
class Version:
    kind: str
    cells: dict[Cell, CellMap]
    knows_free: bool
    mark: int
    made_s: float
    settings: FuseSettings
    target: int = 0
    unvoted: str = ""


@dataclass
class Server:
    """Everything that happened, and the versions that came of it."""

    cells: dict[Cell, CellMap]
    settings: FuseSettings
    seq: int = 0
    casts: list[Cast] = field(default_factory=list)
    reviews: list[Review] = field(default_factory=list)
    versions: dict[int, Version] = field(default_factory=dict)
    oldest: int = 1
    """The first version that was not cleared away."""

    def __post_init__(self) -> None:
        self.versions[1] = Version("import", dict(self.cells), False, 0, 0.0, self.settings)

    @property
    def newest(self) -> int:
        return max(self.versions)

    def event(self) -> int:
        self.seq += 1
        return self.seq

    def counts_anywhere(self, version: int, says: dict[Cell, Spoken]) -> bool:
        now = self.versions[self.newest].cells
        return any(now[cell].changed <= version for cell in says)

    def vote(self, cast: Cast) -> None:
        """The same drive again takes the place of the first."""
        seq = self.event()
        self.casts = [
            replace(c, gone_at=seq) if (c.vehicle, c.drive) == (cast.vehicle, cast.drive) and c.gone_at is None else c
            for c in self.casts
        ]
        self.casts.append(replace(cast, seq=seq))

    def withdraw(self, vehicle: str) -> None:
        seq = self.event()
        self.casts = [replace(c, gone_at=seq) if c.vehicle == vehicle and c.gone_at is None else c for c in self.casts]

    def review(self, verdict: str, cells: list[Cell]) -> None:
        self.reviews.append(Review(verdict, cells, self.event()))

    def let_go(self, which: int) -> None:
        self.reviews[which] = replace(self.reviews[which], gone_at=self.event())

    def obeys(self, cast: Cast, cell: Cell, mark: int) -> bool:
        """Whether no verdict that stands at ``mark`` bars the vote."""
        first = min(c.seq for c in self.casts if (c.vehicle, c.drive) == (cast.vehicle, cast.drive))
        barring = [
            r for r in self.reviews if r.seq <= mark and (r.gone_at is None or r.gone_at > mark) and cell in r.cells
        ]
        return not any(r.verdict == "held" or first < r.seq for r in barring)

    def publish(self, now_s: float) -> bool:
        """Whether there is a new version."""
        before, mark = self.versions[self.newest], self.seq
        standing = stand_at(self.casts, mark)
        obeys = partial(self.obeys, mark=mark)
        cells, knows = fuse(before, standing, self.settings, now_s, self.newest + 1, lambda cast, cell: True, obeys)
        if knows == before.knows_free and all(cells[c].same_as(before.cells[c]) for c in cells):
            return False
        self.event()
        self.versions[self.newest + 1] = Version("publish", cells, knows, mark, now_s, self.settings)
        return True

    def rollback(self, to: int, now_s: float) -> None:
        number, mark = self.newest + 1, self.event()
        before, target = self.versions[self.newest], self.versions[to]
        cells = turned_back(before, target, number)
        self.versions[number] = Version("rollback", cells, target.knows_free, mark, now_s, target.settings, to)

    def clear_away(self, keep: int) -> None:
        """All but the last versions go; what they decided stays decided."""
        self.event()
        self.oldest = max(self.oldest, self.newest - keep + 1)

    def replay(self, vehicle: str, now_s: float) -> None:
        """The map as if the vehicle had never voted since the oldest version that is kept."""
        number = self.newest + 1
        out = {v.unvoted: n for n, v in self.versions.items() if v.kind == "replay"} | {vehicle: number}
        again = {n: self.versions[n] for n in range(1, self.oldest + 1)}
        for n in range(self.oldest + 1, number):
            again[n] = self._again(n, again, out)
        mark = self.event()
        ours, theirs = again[number - 1], self.versions[number - 1]
        cells = turned_back(theirs, ours, number)
        self.casts = [replace(c, gone_at=mark) if c.vehicle == vehicle and c.gone_at is None else c for c in self.casts]
        self.versions[number] = replace(
            theirs, kind="replay", cells=cells, knows_free=ours.knows_free, mark=mark, made_s=now_s, unvoted=vehicle
        )

    def _again(self, n: int, again: dict[int, Version], out: dict[str, int]) -> Version:
        was, before = self.versions[n], again[n - 1]
        if was.kind == "rollback":
            target = again[was.target]
            return replace(was, cells=turned_back(before, target, n), knows_free=target.knows_free)
        if was.kind == "replay":
            return replace(was, cells=before.cells, knows_free=before.knows_free)
        standing = [c for c in stand_at(self.casts, was.mark) if n >= out.get(c.vehicle, 0)]

        def as_its_vehicle_saw_it(cast: Cast, cell: Cell) -> bool:
            return again[cast.version].cells[cell].same_as(self.versions[cast.version].cells[cell])

        obeys = partial(self.obeys, mark=was.mark)
        cells, knows = fuse(before, standing, was.settings, was.made_s, n, as_its_vehicle_saw_it, obeys)
        return replace(was, cells=cells, knows_free=knows)


def stand_at(casts: Iterable[Cast], mark: int) -> list[Cast]:
    return [c for c in casts if c.seq <= mark and (c.gone_at is None or c.gone_at > mark)]


def turned_back(before: Version, target: Version, number: int) -> dict[Cell, CellMap]:
    """The target's cells; those that are otherwise than before have changed in this version."""
    return {
        cell: before.cells[cell] if then.same_as(before.cells[cell]) else replace(then, changed=number)
        for cell, then in target.cells.items()
    }


def in_window(casts: list[Cast], settings: FuseSettings) -> list[Cast]:
    """Not too much older than the newest, of the vehicles that passed last."""
    newest = max(c.end_s for c in casts)
    recent = [c for c in casts if newest - c.end_s <= settings.max_age_days * DAY_S]
    last = {c.vehicle: max(o.end_s for o in recent if o.vehicle == c.vehicle) for c in recent}
    ranked = sorted(last, key=lambda v: (last[v], v), reverse=True)[: settings.latest_vehicles]
    return [c for c in recent if c.vehicle in ranked]


def without_copies(casts: list[Cast], settings: FuseSettings) -> list[Cast]:
    """Drives of several vehicles that say the same of one way are one: that is heard which agrees best with all others,
    of those the one that ended first."""
    if settings.min_votes < 2:
        return casts
    out = set()
    for alike in alike_among(casts):
        others = [c for c in casts if c not in alike]
        best = max(alike, key=lambda c: (agreement(c, others), -c.end_s))
        out |= {c.seq for c in alike if c is not best}
    return [c for c in casts if c.seq not in out]


def alike_among(casts: list[Cast]) -> list[list[Cast]]:
    found = [[c for c in casts if c.way == way] for way in sorted({c.way for c in casts} - {""})]
    return [alike for alike in found if len({c.vehicle for c in alike}) > 1]


def agreement(cast: Cast, others: list[Cast]) -> int:
    """In how many more cells it says what another determined than otherwise, of every seventh cell."""
    own, score = np.frombuffer(cast.plane, np.uint8)[::7], 0
    for other in others:
        theirs = np.frombuffer(other.plane, np.uint8)[::7]
        both = (own < UN) & (theirs < UN)
        score += int((both & (own == theirs)).sum()) - int((both & (own != theirs)).sum())
    return score


def liars(everyone: list[Cast], heard: list[Cast]) -> int:
    """One vehicle of those that vote one way and are ignored everywhere may be honest, for each way."""
    left = {c.vehicle for c in heard}
    silent = [{c.vehicle for c in alike} - left for alike in alike_among(everyone)]
    return max(0, len(set().union(*silent)) - sum(1 for vehicles in silent if vehicles))


def fuse(
    before: Version,
    standing: list[Cast],
    settings: FuseSettings,
    now_s: float,
    number: int,
    readable: Callable[[Cast, Cell], bool],
    obeys: Callable[[Cast, Cell], bool],
) -> tuple[dict[Cell, CellMap], bool]:
    """Every cell, decided afresh."""
    ripe = [c for c in standing if c.received_s <= now_s - settings.min_age_s]
    if not ripe:
        return dict(before.cells), before.knows_free
    everyone = in_window(ripe, settings)
    chosen = without_copies(everyone, settings)
    quorum = settings.min_votes - liars(everyone, chosen)
    quorum = max(quorum, min(settings.min_votes, 2))
    learns = len({c.vehicle for c in chosen if c.has_free})
    knows = before.knows_free or learns >= max(quorum, 1)
    lately = [c for c in ripe if max(r.end_s for r in ripe) - c.end_s <= window_days(settings) * DAY_S]
    lately = without_copies(lately, settings)
    cells, added, decided = {}, False, {}
    for cell, held in before.cells.items():

        def counts(cast: Cast, cell: Cell = cell, held: CellMap = held) -> bool:
            return cell in cast.says and held.changed <= cast.version and readable(cast, cell)

        heard: dict[str, list[Cast]] = {}
        last: dict[str, int] = {}
        for cast in sorted(chosen, key=lambda c: c.end_s):
            last[cast.vehicle] = cast.end_s
            if counts(cast) and obeys(cast, cell):
                heard.setdefault(cast.vehicle, []).append(cast)
        recent = sorted((c for c in lately if counts(c)), key=lambda c: c.end_s)
        says = {vehicle: drives[-1].says[cell] for vehicle, drives in heard.items()}
        decided[cell] = (
            state_of(held, heard, says, recent, cell, settings, quorum),
            says,
            last,
            unbroken(recent, cell, settings)[0],
        )
    stay = [
        (cell, layer)
        for cell, (state, says, *_) in decided.items()
        for layer in layers(before.cells[cell])
        if layer and not (state in (CE, UO) and may_go(layer, state, says, quorum))
    ]
    for cell, held in before.cells.items():
        beside = {n for (r, c), n in stay if abs(r - cell[0]) <= 1 and abs(c - cell[1]) <= 1}
        cells[cell] = edited(held, *decided[cell], quorum, {n + step for n in beside for step in (-1, 0, 1)})
        added = added or len(cells[cell].heights) > len(held.heights)
    for cell, held in before.cells.items():
        free = held.free
        if knows and learns >= quorum:
            telling = [c for c in chosen if c.has_free and cell in c.says and held.changed <= c.version]
            telling = [c for c in telling if readable(c, cell) and obeys(c, cell)]
            passed = [
                {bit for c in telling if c.vehicle == v for bit in bits(c.says[cell].free)}
                for v in {c.vehicle for c in chosen}
            ]
            free |= sum(1 << b for b in range(64) if sum(b in mine for mine in passed) >= quorum)
        if knows and (learns or added):
            free &= ~occupied(cells[cell].heights)
        cells[cell] = replace(cells[cell], free=free)
        if not cells[cell].same_as(held):
            cells[cell] = replace(cells[cell], changed=number)
    return cells, knows


def state_of(
    held: CellMap,
    heard: dict[str, list[Cast]],
    says: dict[str, Spoken],
    recent: list[Cast],
    cell: Cell,
    settings: FuseSettings,
    quorum: int,
) -> int:
    """The decision on one cell: one vote a vehicle, its latest drive that says anything."""
    state = decide([s.state for s in says.values()], quorum)
    said = [(drives[-1].end_s, drives[-1].says[cell].state) for drives in heard.values()]
    state = state if state in (CO, CE) else turn(said, quorum) or state
    if state == CO and is_temporary(held, recent, cell, settings):
        state = UN
    if (state == CO or (state == CE and held.came_s)) and last_word(heard, cell) != state:
        state = UN
    return state


def layers(held: CellMap) -> set[int]:
    """Those in which a cell has points; 0 is the ground."""
    return {int(z // LAYER_M) for z in held.heights}


def edited(
    held: CellMap,
    state: int,
    says: dict[str, Spoken],
    last: dict[str, int],
    since: int | None,
    quorum: int,
    touched: set[int],
) -> CellMap:
    """One cell after its points went and came, and what it remembers; ``touched`` layers lie beside what stays."""
    heights = held.heights
    if state in (CE, UO):
        heights = tuple(z for z in heights if z < LAYER_M or not goes(int(z // LAYER_M), state, says, quorum, touched))
    if state == CO:
        taken = layers(held)
        offered = {v: {int(z // LAYER_M): z for z in s.heights} for v, s in says.items() if s.state == CO}
        for layer in sorted({layer for mine in offered.values() for layer in mine}):
            backing = sum(any(near in mine for near in (layer - 1, layer, layer + 1)) for mine in offered.values())
            if backing >= quorum and layer not in taken:
                heights += (next(mine[layer] for mine in offered.values() if layer in mine),)
    new = replace(held, heights=heights)
    if new.stands() and not held.stands():
        first = min(last[v] for v, s in says.items() if s.state == CO)
        return replace(new, came_s=first if since is None else min(since, first))
    if held.stands() and not new.stands() and held.came_s:
        ended = max(min((last[v] for v, s in says.items() if s.state == CE), default=0), held.came_s)
        return replace(new, came_s=0, stays=held.stays + 1, stayed_s=held.stayed_s + ended - held.came_s)
    return new


def decide(votes: list[int], min_votes: int) -> int:
    """Undetermined abstains; a change needs a majority of those that determined the cell, and a quorum."""
    counts = [votes.count(state) for state in (UO, UE, CO, CE)]
    best = max(counts)
    if best == 0 or counts.count(best) > 1:
        return UN
    state = counts.index(best)
    if state in (CO, CE) and (2 * best <= sum(counts) or best < min_votes):
        return UN
    return state


def turn(said: list[tuple[int, int]], min_votes: int) -> int | None:
    """Until some moment all say that nothing changed, and since then more than the quorum, and all, that it did."""
    for before, after in ((UO, CE), (UE, CO)):
        then = [end_s for end_s, state in said if state == before]
        since = [end_s for end_s, state in said if state == after]
        everyone = len(then) + len(since) == sum(state != UN for _, state in said)
        if everyone and len(since) > min_votes and max(then, default=0) < min(since):
            return after
    return None


def last_word(heard: dict[str, list[Cast]], cell: Cell) -> int:
    """The statement of the last drive that determined the cell."""
    determined = [
        (c.end_s, c.says[cell].state) for drives in heard.values() for c in drives if c.says[cell].state != UN
    ]
    return max(determined)[1]


def goes(layer: int, state: int, says: dict[str, Spoken], quorum: int, touched: set[int]) -> bool:
    """Whether enough vehicles say that this voxel is gone, of a cell that is empty now or that stands."""
    if state == CE:
        marks = [EVERY if s.gone is None else s.gone for s in says.values() if s.state == CE]
        return sum(m >> layer & 1 for m in marks) >= quorum
    return is_nearly_gone(layer, says, quorum) or (layer not in touched and is_left(layer, says, quorum))


def may_go(layer: int, state: int, says: dict[str, Spoken], quorum: int) -> bool:
    """Whether a voxel goes if it touches nothing that stays."""
    return goes(layer, state, says, quorum, set())


def is_nearly_gone(layer: int, says: dict[str, Spoken], quorum: int) -> bool:
    """Whether two thirds of the vehicles say that a voxel is gone, alone or with its whole cell."""
    return is_marked(layer, says, max(quorum, 2), (UO, CE), 2 / 3)


def is_left(layer: int, says: dict[str, Spoken], quorum: int) -> bool:
    """Whether half of the vehicles say that a voxel is gone of a cell that stands."""
    return is_marked(layer, says, quorum, (UO,), 1 / 2)


def is_marked(layer: int, says: dict[str, Spoken], quorum: int, saying: tuple[int, ...], share: float) -> bool:
    """Whether so many of those ``saying`` this of the cell mark a voxel, and more than a ``share`` of who decided."""
    marks = [s.gone or 0 if s.gone is not None or s.state == UO else EVERY for s in says.values() if s.state in saying]
    marking, determined = sum(m >> layer & 1 for m in marks), sum(s.state != UN for s in says.values())
    return marking >= quorum and marking > share * determined + 1e-9


def window_days(settings: FuseSettings) -> float:
    """How far back anybody looks for a first sighting."""
    return max(2 * settings.stay_days, settings.max_age_days)


def unbroken(recent: list[Cast], cell: Cell, settings: FuseSettings) -> tuple[int | None, int]:
    """When what is seen in a cell without a break was first seen, and last."""
    since: int | None = None
    seen = absent = 0
    for cast in recent:
        state = cast.says[cell].state
        if state == UE:
            absent += 1
            since = None if absent >= settings.min_votes else since
        if state == CO:
            absent, seen = 0, cast.end_s
            since = cast.end_s if since is None else since
    return since, seen


def is_temporary(held: CellMap, recent: list[Cast], cell: Cell, settings: FuseSettings) -> bool:
    """A new object stays out until it is expected to stay, by the objects that came and went here before and its own
    age."""
    since, seen = unbroken(recent, cell, settings)
    age = 0.0 if since is None else (seen - since) / DAY_S
    expected = (settings.prior_stay_days + held.stayed_s / DAY_S + age) / (1.0 + held.stays)
    sure = (settings.prior_stay_days + held.stayed_s / DAY_S) / (1.0 + held.stays) >= settings.stay_days
    return not (sure or age >= settings.stay_days or expected >= settings.stay_days)


def bits(word: int) -> set[int]:
    return {b for b in range(64) if word >> b & 1}


def occupied(heights: Iterable[float]) -> int:
    word = 0
    for z in heights:
        word |= (1 << int(z // LAYER_M)) if z >= LAYER_M else 0
    return word
