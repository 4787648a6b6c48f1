"""The vote of one vehicle on one tile (paper IV): which of its drives count, as one vote (docs/decisions/voting.md).

Pure, and independent of order: drives fold by a commutative rule.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapvote.codec.ballot import Odds, Planes
from mapvote.codec.planes import Words, agreeing, mark, mark_among, mark_spoken, union
from mapvote.config import FuseSettings
from mapvote.core.columns import flat_cells
from mapvote.core.grid import CELLS, TILE_CELLS, Grid
from mapvote.core.points import Fields, Values, joined_fields
from mapvote.core.types import F32, I32, I64, N_STATES, NO_VOTE, U8, U64, Bool, CellState, read_only

DAY_NS = 86_400_000_000_000


Why = Literal["", "young", "window", "otherwise", "damaged", "copy", "opposes", "spent", "reviewed"]
"""Why a vote does not count on a tile, or on one of its cells; "" if it does. See :data:`REASONS`."""
REASONS: Mapping[Why, str] = {
    "young": "younger than the minimum age",
    "window": "too old, or not of the vehicles that passed last",
    "otherwise": "cast by another method or other settings than the policy asks for",
    "damaged": "damaged, and set aside",
    "copy": "a copy: its cells on this tile equal those of another vehicle's ballot, which counts for both",
    "opposes": "opposes the others over most of this tile, or denies nearly all that changed on it",
    "spent": "spent: a version had changed the cell since its vehicle drove",
    "reviewed": "of a change that a reviewer held or rejected",
}
_NO_CELLS = np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Vote(Planes):
    """The vote of one drive, or of one vehicle after :func:`fold`, on one tile, and why it does not count.

    A server reads a vote without its planes first. It reads the planes of those that count (:meth:`with_planes`). A
    decision record states a vote's ballot and why it did not count, no more.
    """

    vehicle: str = ""
    end_ns: int = 0
    digest: str = ""
    """Hash of the ballot: breaks ties between drives that end at the same moment."""
    version: int = 0
    """Version of the map that the vehicle drove with."""
    ballot: int = 0
    """Number of the ballot in a server's log; 0 where there is no server."""
    drive: str = ""
    first_seq: int = 0
    """Event with which the drive first arrived at a server."""
    unrestricted: U8 | None = None
    """Its states as they were sent, where :func:`silenced` left some out."""
    why: Why = ""
    """Why it does not count on the tile at all; "" if it does, or if nobody has judged it."""
    spent: I64 = field(default_factory=lambda: _NO_CELLS)
    """(n,) flat cells on which it votes, ascending, and which have changed since its vehicle drove."""
    reviewed: I64 = field(default_factory=lambda: _NO_CELLS)
    """(n,) flat cells on which it votes, ascending, of a change that a reviewer held or rejected."""
    alike: int = 0
    """For a copy: the ballot that counts for both."""

    def __post_init__(self) -> None:
        if self.states is not None:
            object.__setattr__(self, "states", read_only(self.states))

    def with_planes(self, planes: Planes) -> Vote:
        """The same vote with the planes of its ballot."""
        return replace(self, **{name: getattr(planes, name) for name in Planes.__slots__})

    def why_not(self, cell: int) -> Why:
        """Why it does not count on a flat ``cell``; "" if it does, provided that it votes there."""
        if self.why:
            return self.why
        if cell in self.spent:
            return "spent"
        return "reviewed" if cell in self.reviewed else ""

    @property
    def sent(self) -> U8 | None:
        """(256, 256) the states that were sent, whether they count or not; None in one stage."""
        return self.states if self.unrestricted is None else self.unrestricted

    def supports(self, state: CellState, cells: NDArray[np.intp]) -> Bool:
        """(n,) at which of the flat ``cells`` this vote is, or in one stage also counts, for ``state``."""
        if self.states is not None:
            return np.asarray(self.states.reshape(-1)[cells] == int(state))
        assert self.tally is not None
        return np.asarray(self.tally[cells // TILE_CELLS, cells % TILE_CELLS, int(state)] > 0)

    def agreed(self, cells: NDArray[np.intp], decided: U8, state: CellState) -> NDArray[np.intp]:
        """Indices of those of the flat ``cells`` (n,) that are ``decided`` (256, 256) as ``state``, which this vote
        supports."""
        if self.states is not None:
            places = np.empty(len(cells), dtype=np.intp)
            return places[: agreeing(cells, self.states.reshape(-1), decided.reshape(-1), int(state), places)]
        return np.flatnonzero((decided.reshape(-1)[cells] == state) & self.supports(state, cells))

    def determined(self, cells: NDArray[np.intp]) -> Bool:
        """(n,) which of the flat ``cells`` this vote determines."""
        if self.states is not None:
            return np.asarray(self.states.reshape(-1)[cells] < int(CellState.UNDETERMINED))
        assert self.tally is not None
        counts = self.tally[cells // TILE_CELLS, cells % TILE_CELLS, : int(CellState.UNDETERMINED)]
        return np.asarray(counts.any(axis=-1))

    def mark_passed(self, reached: U64) -> None:
        """One more voter in ``reached`` (see :func:`mapvote.codec.planes.mark`): of the voxels that rays
        passed through, in cells with a vote."""
        assert self.free is not None
        if self.states is not None:
            mark_spoken(reached, self.free.cells, self.free.words, self.states.reshape(-1))
        else:
            passed = self.free.within(self.spoken())
            mark(reached, passed.cells, passed.words)

    def mark_deleted(self, emptied: Words, reached: U64) -> None:
        """One more voter in ``reached`` (k, n): of what it :meth:`deletes` among the n cells ``emptied``."""
        if self.states is not None and self.gone is not None:
            own = self.states.reshape(-1)
            said = int(CellState.CHANGED_EMPTY)
            mark_among(reached, self.gone.cells, self.gone.words, own, said, emptied.cells)
        else:
            deleted = self.deletes(emptied)
            mark(reached, np.searchsorted(emptied.cells, deleted.cells), deleted.words)

    def deletes(self, among: Words) -> Words:
        """The voxels that this vote deletes in the cells that ``among`` names."""
        marked = among if self.gone is None else self.gone.where(among)
        return marked.at(self.supports(CellState.CHANGED_EMPTY, marked.cells))

    def remnants(self, decided: U8) -> Words:
        """The voxels that this vote deletes though the cell stands, in the (256, 256) cells ``decided`` so."""
        if self.gone is None:
            return Words.none()
        marked = self.gone.at(self.agreed(self.gone.cells, decided, CellState.UNCHANGED_OCCUPIED))
        return marked if self.tally is None else marked.at(~self.supports(CellState.CHANGED_EMPTY, marked.cells))


class Dated(Protocol):
    """Anything that a vehicle stated at a moment."""

    @property
    def vehicle(self) -> str: ...
    @property
    def end_ns(self) -> int: ...


D = TypeVar("D", bound=Dated)


def voter_of(vote: Dated, settings: FuseSettings) -> str:
    """Whose vote a drive is: its vehicle's; with ``one_vehicle = "days"`` its vehicle's of the day (UTC) on which the
    drive ended."""
    if settings.one_vehicle == "once":
        return vote.vehicle
    return f"{vote.vehicle} on {np.datetime64(vote.end_ns // DAY_NS, 'D')}"


def by_voter(votes: Iterable[Vote], settings: FuseSettings) -> list[Vote]:
    """The votes, each under the name of its voter, see :func:`voter_of`."""
    if settings.one_vehicle == "once":
        return list(votes)
    return [replace(vote, vehicle=voter_of(vote, settings)) for vote in votes]


def newest_votes(votes: Iterable[D], settings: FuseSettings) -> list[D]:
    """The votes inside the window: drives within ``max_age_days`` of the newest on this tile, then those
    of the ``latest_vehicles`` voters (:func:`voter_of`) that passed last. Ties go to the later name."""
    votes = list(votes)
    if not votes:
        return []
    newest = max(v.end_ns for v in votes)
    recent = [v for v in votes if newest - v.end_ns <= settings.max_age_days * DAY_NS]
    last: dict[str, int] = {}
    for vote in recent:
        voter = voter_of(vote, settings)
        last[voter] = max(last.get(voter, vote.end_ns), vote.end_ns)
    ranked = sorted(last, key=lambda voter: (last[voter], voter), reverse=True)
    if len(ranked) <= settings.latest_vehicles:
        return recent
    chosen = set(ranked[: settings.latest_vehicles])
    return [v for v in recent if voter_of(v, settings) in chosen]


def silenced(vote: Vote, cells: I64) -> Vote:
    """The vote without the flat ``cells`` (n,), ascending."""
    if not len(cells):
        return vote
    return replace(
        vote,
        states=None if vote.states is None else _but(vote.states, cells, NO_VOTE),
        unrestricted=vote.sent,
        tally=None if vote.tally is None else _but(vote.tally, cells, 0),
        free=None if vote.free is None else vote.free.outside(cells),
    )


def _but(plane: NDArray[Any], cells: I64, value: int) -> NDArray[Any]:
    """The plane (256, 256, ...) with ``value`` in flat ``cells``."""
    flat = plane.reshape(CELLS, -1).copy()
    flat[cells] = value
    return flat.reshape(plane.shape)


def fold(drives: Sequence[Vote], grid: Grid) -> Vote:
    """One vehicle's drives as one vote: in every cell the drive that ended last counts, ties by hash; a drive
    without a vote there never overrides. Passed-through voxels add up. Commutative, and idempotent for one drive.

    ``grid`` is the tile's window.
    """
    if len(drives) == 1:
        return drives[0]
    ordered = sorted(drives, key=lambda drive: (drive.end_ns, drive.digest))
    newest = ordered[-1]
    spoken = [drive.spoken().reshape(-1) for drive in ordered]
    last = _last_words(spoken)
    states = tally = unrestricted = None
    if ordered[0].states is not None:
        states = _laid_over([drive.states for drive in ordered])
    else:
        tally = np.zeros((TILE_CELLS, TILE_CELLS, N_STATES), dtype=np.uint16)
        for drive, is_last in zip(ordered, last, strict=True):
            if drive.tally is not None:
                tally[is_last.reshape(tally.shape[:2])] = drive.tally[is_last.reshape(tally.shape[:2])]
    if any(drive.unrestricted is not None for drive in ordered):
        unrestricted = _laid_over([drive.sent for drive in ordered])
    points: list[F32] = []
    fields: list[tuple[int, Fields]] = []
    for drive, is_last in zip(ordered, last, strict=True):
        if drive.new_points is not None:
            here = is_last[flat_cells(grid, drive.new_points)]
            points.append(drive.new_points[here])
            fields.append((len(points[-1]), {name: values[here] for name, values in drive.fields.items()}))
    free = [drive.free.within(said) for drive, said in zip(ordered, spoken, strict=True) if drive.free is not None]
    return Vote(
        vehicle=newest.vehicle,
        end_ns=newest.end_ns,
        digest=newest.digest,
        states=states,
        unrestricted=unrestricted,
        tally=tally,
        gone=union([_marked(drive, is_last) for drive, is_last in zip(ordered, last, strict=True)]),
        new_points=np.concatenate(points) if points else None,
        fields=joined_fields(fields),
        free=union(free) if free else None,
        odds=folded(ordered, last),
    )


def folded(drives: Sequence[Vote], last: Sequence[Bool]) -> Odds | None:
    """The confidence of a vehicle's ``drives``, each in the flat cells (65536,) in which it is the ``last`` to vote;
    None if none states any."""
    parts = [drive.odds.within(is_last) for drive, is_last in zip(drives, last, strict=True) if drive.odds is not None]
    if not parts:
        return None
    cells = np.concatenate([part.cells for part in parts])
    order = np.argsort(cells)
    return Odds(cells[order], np.concatenate([part.steps for part in parts])[order])


def _last_words(spoken: Sequence[Bool]) -> list[Bool]:
    """The flat cells (65536,) in which each drive has a vote and no later one has; drives in the order of time."""
    since = np.zeros(CELLS, dtype=np.bool_)
    last = []
    for votes_here in reversed(spoken):
        last.append(votes_here > since)
        since = since | votes_here
    return last[::-1]


def _laid_over(planes: Sequence[U8 | None]) -> U8:
    """(256, 256) the last of the ``planes`` that has a vote on a cell."""
    out, *later = [plane for plane in planes if plane is not None]
    for plane in later:
        # NO_VOTE has every bit, so this is np.where(plane != NO_VOTE, plane, out), at a tenth of its time.
        out = plane & (out | -(plane != NO_VOTE).view(np.uint8))
    return out


def _marked(drive: Vote, cells: Bool) -> Words:
    """The voxels that a drive deletes, and its remnants, in the flat cells ``cells`` (65536,)."""
    if drive.gone is None:
        return drive.deletes(Words.whole(cells))
    marked = drive.gone.within(cells)
    emptied = CellState.CHANGED_EMPTY
    stands = CellState.UNCHANGED_OCCUPIED
    return marked.at(drive.supports(emptied, marked.cells) | drive.supports(stands, marked.cells))


def one_each(drives: Iterable[Vote], grid: Grid) -> list[Vote]:
    """One vote a vehicle, by name: :func:`fold` of all its drives on the tile whose window is ``grid``."""
    by_vehicle: dict[str, list[Vote]] = {}
    for drive in drives:
        by_vehicle.setdefault(drive.vehicle, []).append(drive)
    return [fold(by_vehicle[vehicle], grid) for vehicle in sorted(by_vehicle)]


def offered(votes: Sequence[Vote], decided: U8, grid: Grid) -> tuple[F32, dict[str, Values], I64, I32]:
    """(points (n, 3), their attributes (n,), cells (n,), numbers of their votes (n,)) that ``votes`` offer for the
    cells ``decided`` (256, 256) as changed-occupied for which they voted so too."""
    nothing = np.empty((0, 3), np.float32), np.empty(0, np.int64), np.empty(0, np.int32)
    offers: list[tuple[F32, I64, I32]] = [nothing]
    fields: list[tuple[int, Fields]] = []
    for number, vote in enumerate(votes):
        if vote.new_points is not None and len(vote.new_points):
            cells = flat_cells(grid, vote.new_points)
            keep = vote.agreed(cells, decided, CellState.CHANGED_OCCUPIED)
            whose = np.full(len(keep), number, dtype=np.int32)
            offers.append((vote.new_points.take(keep, axis=0), cells[keep], whose))
            fields.append((len(keep), {name: values[keep] for name, values in vote.fields.items()}))
    points, cells, voters = (np.concatenate(parts) for parts in zip(*offers, strict=True))
    return points, joined_fields(fields), cells, voters
