"""Gravity: what remains in the air where an object was demolished falls with it.

Rays seldom cross the tops of facades and roofs. So votes on single cells leave them hanging over a house that a quorum
saw go. A group of remaining obstacle voxels (26 neighbours) falls if nothing holds it, and it

- touches what a decided changed-empty deletes in this round, or
- lies inside a demolished object: wholly within its outline from above, and beginning hardly higher than its top there.

Only what stood on the ground carried anything. So a deleted voxel counts if deleted voxels around it lead up to it from
the ground. If votes delete a piece of a bridge that crosses a demolished house, the rest of the bridge does not follow.

A group is held by a voxel near the ground, by a cell that is decided occupied (unchanged or changed), and by a cell
whose change waits (for a reviewer, for another vehicle, for the budget of false deletions). Wires, signs, bridges and
tree crowns stay: they hang on something that stays, or reach beyond the outline of what went.

Groups and objects are followed over the borders of tiles, as far as :class:`Gravity` says. Whether a group falls
depends on both alone, never on the order of votes or tiles, nor on where the borders lie.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core.grid import CELLS, TILE_CELLS, TileIndex
from mapvote.core.groups import groups_of
from mapvote.core.kernel import inlined, kernel
from mapvote.core.record import record
from mapvote.core.tile import Tile
from mapvote.core.types import I32, I64, NO_VOTE, U8, U64, Bool, CellState, read_only


@record()
@dataclass(frozen=True, slots=True)
class Gravity:
    """When a group falls."""

    touch_voxels: int = 2
    """A group touches a deleted voxel that is at most so far away along each axis, voxels. So far an outline reaches
    beyond its deleted cells."""
    ground_voxels: int = 7
    """So many of the lowest voxels of a column hold; bit 0 holds the ground, so they reach 1.8 to 2.1 m above it."""
    longest_cells: int = 250
    """A group that spans more rows or columns stays, cells: 75 m; 0: nothing falls."""
    longest_object_cells: int = 500
    """An object that spans more rows or columns has no inside, cells: 150 m. So two tiles in each direction show all
    that decides about one tile."""
    beside_cells: int = 10
    """Deleted cells so near to each other, rows and columns, lead up from the ground together, cells: 3 m. The top of
    an object at a place is that of its deleted cells at most so much farther away than the nearest one."""
    gap_voxels: int = 2
    """Up to so many layers without a deleted voxel are passed on the way up from the ground."""
    rise_voxels: int = 3
    """A group inside an object begins at most so many layers above its top there: the highest part of a wall is often
    not seen to go."""
    reach_cells: int = 1
    """Deleted cells are of one object if their surroundings, so many cells wide, touch."""
    inside_cells: int = 45
    """An object with a smaller outline has no inside, cells: 4 m2. Poles, signs and bollards have none."""


GRAVITY = Gravity()


@dataclass(frozen=True, slots=True)
class Remains:
    """A tile after the edit by votes; arrays (256, 256)."""

    rest: U64
    """Column words of the obstacle voxels that remain."""
    holds: U64
    """Those of them that stay, whatever happens around them."""
    deleted: U64
    """Voxels that a decided changed-empty has deleted in this round."""
    base: I32
    """Lattice layer of bit 0 of each column."""


def remains_of(
    before: Tile, after: Tile, states: U8, kept: I64, fell: Fallen | None = None, gravity: Gravity = GRAVITY
) -> Remains:
    """The remains of a tile ``before`` and ``after`` its edit by ``states`` (256, 256).

    ``kept`` (n,): flat cells that hold, whatever their state. ``fell``: what went by gravity, not by votes. A tile
    without known ground has no beginning of columns: all of it holds.
    """
    rest = after.obstacle_words
    near_ground = (1 << gravity.ground_voxels) - 1 if after.has_ground else (1 << 64) - 1
    holds = rest & np.uint64(near_ground)
    stands = (states == int(CellState.UNCHANGED_OCCUPIED)) | (states == int(CellState.CHANGED_OCCUPIED))
    holds[stands] = rest[stands]
    holds.reshape(-1)[kept] = rest.reshape(-1)[kept]
    emptied = states == int(CellState.CHANGED_EMPTY)
    deleted = np.where(emptied, before.obstacle_words & ~rest, np.uint64(0))
    if fell is not None:
        deleted &= ~fell.plane()
    return Remains(rest, holds, deleted, after.base)


def remains_without_votes(tile: Tile, gravity: Gravity = GRAVITY) -> Remains:
    """The remains of a tile of which no vehicle votes."""
    silent = np.full((TILE_CELLS, TILE_CELLS), NO_VOTE, dtype=np.uint8)
    return remains_of(tile, tile, silent, np.empty(0, np.int64), gravity=gravity)


@dataclass(frozen=True, slots=True)
class Fallen:
    """The voxels of one tile that fell; n cells, ascending."""

    cells: I64
    """(n,) flat."""
    words: U64
    """(n,) column words."""
    beside: I64
    """(n,) the first deleted cell that the group touches, else that of the object, by :func:`lattice_key`."""

    @classmethod
    def none(cls) -> Fallen:
        """Nothing fell."""
        return cls(np.empty(0, np.int64), np.empty(0, np.uint64), np.empty(0, np.int64))

    @classmethod
    def of(cls, words: U64, beside: I64) -> Fallen:
        """From planes (256, 256); ``beside`` counts where a word has a bit."""
        cells = np.flatnonzero(words)
        return cls(cells, words.reshape(-1)[cells], beside.reshape(-1)[cells])

    def plane(self) -> U64:
        """(256, 256) column words."""
        words = np.zeros(CELLS, dtype=np.uint64)
        words[self.cells] = self.words
        return words.reshape(TILE_CELLS, TILE_CELLS)

    def joined(self, other: Fallen) -> Fallen:
        """The voxels of both."""
        words = np.zeros(CELLS, np.uint64)
        beside = np.full(CELLS, _NOWHERE)
        for part in (self, other):
            words[part.cells] |= part.words
            beside[part.cells] = np.minimum(beside[part.cells], part.beside)
        return Fallen.of(words, beside)


@dataclass(frozen=True, slots=True)
class Falling:
    """All but the votes that decides what falls in a tile."""

    reviewed: Bool | None = None
    """(256, 256) cells of changes that a reviewer holds or rejected, from which nothing falls."""
    fallen: Fallen | None = None
    """Further voxels that fall, by the decisions of the tiles around."""
    gravity: Gravity = GRAVITY


FALLING = Falling()
_NOWHERE = np.iinfo(np.int64).max
_HALF = 1 << 31


def lattice_key(row: int, col: int) -> int:
    """A cell of the lattice as one number, ascending by row, then column."""
    return (row << 32) + col + _HALF


def lattice_cell(key: int) -> tuple[int, int]:
    """(row, col): the inverse of :func:`lattice_key`."""
    return key >> 32, (key & 0xFFFFFFFF) - _HALF


def fall_within(index: TileIndex, left: Remains, gravity: Gravity = GRAVITY) -> tuple[Fallen, frozenset[TileIndex]]:
    """(what falls in one tile whatever lies around it, the tiles without which more cannot be decided)."""
    rows, cols = (np.flatnonzero(left.deleted.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return Fallen.none(), frozenset()
    # A falling group has a voxel in the box around all deleted voxels, or a little beyond.
    margin = 2 * gravity.reach_cells + gravity.touch_voxels + 1
    within = min(rows[0], cols[0]) >= margin and max(rows[-1], cols[-1]) < TILE_CELLS - margin
    box = slice(rows[0] - margin, rows[-1] + margin + 1), slice(cols[0] - margin, cols[-1] + margin + 1)
    if within and not (left.rest[box] & ~left.holds[box]).any():
        return Fallen.none(), frozenset()
    fallen, missing = _fall_in(index, {index: left}, gravity)
    return fallen.get(index, Fallen.none()), missing


def fall_across(
    undecided: Mapping[TileIndex, Remains],
    remains_at: Callable[[TileIndex], Remains],
    gravity: Gravity = GRAVITY,
) -> dict[TileIndex, Fallen]:
    """Further voxels that fall, by tile.

    ``undecided``: the remains of tiles for which :func:`fall_within` misses others. ``remains_at`` gives those of any
    other tile; it is asked only for tiles that matter.
    """
    fallen: dict[TileIndex, Fallen] = {}
    for index in sorted(undecided):
        sites = {index: undecided[index]}
        missing = frozenset({index})
        by_tile: dict[TileIndex, Fallen] = {}
        while missing:
            by_tile, missing = _fall_in(index, sites, gravity)
            sites |= {tile: undecided[tile] if tile in undecided else remains_at(tile) for tile in missing}
        for tile, more in by_tile.items():
            fallen[tile] = fallen[tile].joined(more) if tile in fallen else more
    return fallen


def _fall_in(
    index: TileIndex, sites: Mapping[TileIndex, Remains], gravity: Gravity
) -> tuple[dict[TileIndex, Fallen], frozenset[TileIndex]]:
    """(what falls by the deletions of tile ``index`` as far as ``sites`` show, the tiles that are missing)."""
    window = _Window.of(sites)
    own = window.slices_of(index)
    # Groups that touch a deletion of this tile.
    corner = own[0].start, own[1].start
    limits = gravity.touch_voxels, gravity.longest_cells
    climb = gravity.ground_voxels, gravity.gap_voxels, gravity.beside_cells
    _find_carried(read_only(window.deleted), read_only(window.base), *climb, window.carried)
    planes = *window.shown, read_only(window.deleted), read_only(window.carried)
    places = *corner, *window.lattice_corner
    _drop_touching(*planes, *places, *limits, gravity.beside_cells, *window.memory, *window.outputs)
    # Groups inside an object of which a part lies in this tile.
    for body in _bodies(window, own, gravity):
        outline = body.inside, *body.corner, body.rows, body.cols, body.tops, body.key
        reach = gravity.rise_voxels, gravity.longest_cells, gravity.beside_cells
        _drop_inside(*window.shown, *outline, *reach, *window.memory, *window.outputs)
    fallen = {tile: window.fallen_in(tile) for tile in sites if window.words[window.slices_of(tile)].any()}
    # A group that leaves the tiles around is too long.
    around = gravity.longest_object_cells // TILE_CELLS + 1
    near = {t for t in window.missing() if max(abs(t[0] - index[0]), abs(t[1] - index[1])) <= around}
    return fallen, frozenset(near)


class _Window:
    """The planes of some sites as one window of whole tiles, and what is found in it."""

    def __init__(self, corner: TileIndex, at_hand: Bool, rest: U64, holds: U64, deleted: U64, base: I32) -> None:
        self.corner = corner
        self.known = at_hand
        self.base = base
        self.deleted = deleted
        self.shown = read_only(rest), read_only(holds), read_only(base), at_hand
        self.loose = rest & ~holds != 0
        most = int(np.bitwise_count(rest & ~holds).sum()) + 1
        self.carried = np.zeros(rest.shape, np.uint64)
        self.words = np.zeros(rest.shape, np.uint64)
        self.asked = np.zeros((at_hand.shape[0] + 2, at_hand.shape[1] + 2), np.bool_)
        seen = np.zeros(rest.shape, np.uint64)
        stays = np.zeros(rest.shape, np.uint64)
        self.memory = seen, stays, np.empty(most, np.int64), np.empty(most, np.uint64)
        self.beside = np.full(rest.shape, _NOWHERE)
        self.outputs = self.asked, self.words, self.beside

    @classmethod
    def of(cls, sites: Mapping[TileIndex, Remains]) -> _Window:
        """The smallest window that holds all ``sites``; what no site shows is not known."""
        row0 = min(row for row, _ in sites)
        col0 = min(col for _, col in sites)
        at_hand = np.zeros((max(row for row, _ in sites) - row0 + 1, max(col for _, col in sites) - col0 + 1), np.bool_)
        for row, col in sites:
            at_hand[row - row0, col - col0] = True
        names = "rest", "holds", "deleted", "base"
        return cls((row0, col0), at_hand, *(_laid_out(sites, name, (row0, col0), at_hand.shape) for name in names))

    @property
    def lattice_corner(self) -> tuple[int, int]:
        """Row and column of its first cell on the lattice."""
        return self.corner[0] * TILE_CELLS, self.corner[1] * TILE_CELLS

    def slices_of(self, index: TileIndex) -> tuple[slice, slice]:
        """The cells of a tile."""
        return _slices(index[0] - self.corner[0], index[1] - self.corner[1])

    def fallen_in(self, index: TileIndex) -> Fallen:
        """Voxels that fall in a tile."""
        own = self.slices_of(index)
        return Fallen.of(self.words[own], self.beside[own])

    def missing(self) -> set[TileIndex]:
        """The tiles that were asked for."""
        row0, col0 = self.corner
        return {(int(row) + row0 - 1, int(col) + col0 - 1) for row, col in np.argwhere(self.asked)}

    def shows(self, low: tuple[int, int], high: tuple[int, int]) -> bool:
        """Whether all cells from ``low`` to ``high``, (row, col) each, are known; the tiles that are not are asked
        for."""
        rows, cols = (range(a // TILE_CELLS, b // TILE_CELLS + 1) for a, b in zip(low, high, strict=True))
        unknown = [(r, c) for r in rows for c in cols if not self._knows(r, c)]
        for r, c in unknown:
            if -1 <= r <= self.known.shape[0] and -1 <= c <= self.known.shape[1]:
                self.asked[r + 1, c + 1] = True
        return not unknown

    def _knows(self, row: int, col: int) -> bool:
        inside = 0 <= row < self.known.shape[0] and 0 <= col < self.known.shape[1]
        return inside and bool(self.known[row, col])


def _laid_out(sites: Mapping[TileIndex, Remains], name: str, corner: TileIndex, shape: tuple[int, ...]) -> NDArray[Any]:
    """One plane of all sites, over ``shape`` tiles from ``corner``."""
    if len(sites) == 1:
        return np.asarray(getattr(next(iter(sites.values())), name))
    dtype = np.int32 if name == "base" else np.uint64
    whole = np.zeros((shape[0] * TILE_CELLS, shape[1] * TILE_CELLS), dtype=dtype)
    for (row, col), site in sites.items():
        whole[_slices(row - corner[0], col - corner[1])] = getattr(site, name)
    return whole


def _slices(row: int, col: int) -> tuple[slice, slice]:
    return slice(row * TILE_CELLS, (row + 1) * TILE_CELLS), slice(col * TILE_CELLS, (col + 1) * TILE_CELLS)


@dataclass(frozen=True, slots=True)
class _Body:
    """The inside of a demolished object."""

    inside: Bool
    """(h, w) the cells within the outline, and a little beyond."""
    corner: tuple[int, int]
    """Row and column of its first cell in the window."""
    rows: I64
    """(n,) of its deleted cells in the window."""
    cols: I64
    """(n,)"""
    tops: I32
    """(n,) lattice layer of their highest voxels that stood on the ground."""
    key: int
    """Its first deleted cell, by :func:`lattice_key`."""


_ANYWHERE = read_only(np.empty((0, 0), dtype=np.bool_))
_NO_CELLS = read_only(np.empty(0, dtype=np.int64))
_NO_TOPS = read_only(np.empty(0, dtype=np.int32))
_NOWHERE_HIGH = -(1 << 30)


def _bodies(window: _Window, own: tuple[slice, slice], gravity: Gravity) -> Iterator[_Body]:
    """The insides of the objects of which a deleted cell lies in the cells ``own``; those that unknown tiles may extend
    are asked for instead."""
    rows, cols = np.nonzero(window.deleted != 0)
    if not len(rows):
        return
    # Objects among the deleted cells, each by row, then column.
    number = groups_of(window.deleted, 2 * gravity.reach_cells + 1, rows, cols)[rows, cols]
    order = np.argsort(number, kind="stable")
    starts = np.flatnonzero(np.diff(number[order], prepend=0))
    rows = rows[order]
    cols = cols[order]
    low, high = (np.stack([of.reduceat(part, starts) for part in (rows, cols)]) for of in (np.minimum, np.maximum))
    # Those of this tile that are large enough for an inside, and not too long.
    size = high - low + 1
    first = np.array([[side.start] for side in own])
    here = ((high >= first) & (low < first + TILE_CELLS)).all(axis=0)
    fits = here & (size.max(axis=0) <= gravity.longest_object_cells) & (size.prod(axis=0) >= gravity.inside_cells)
    margin = gravity.beside_cells + 2 * gravity.reach_cells + gravity.touch_voxels
    for k in np.flatnonzero(fits).tolist():
        of_object = slice(starts[k], starts[k + 1] if k + 1 < len(starts) else None)
        r = rows[of_object]
        c = cols[of_object]
        if not ((r >= first[0]) & (r < first[0] + TILE_CELLS) & (c >= first[1]) & (c < first[1] + TILE_CELLS)).any():
            continue
        (r0, c0), (r1, c1) = (low[:, k] - margin).tolist(), (high[:, k] + margin).tolist()
        body = _body_of(window, r, c, gravity) if window.shows((r0, c0), (r1, c1)) else None
        if body is not None:
            yield body


def _body_of(window: _Window, rows: I64, cols: I64, gravity: Gravity) -> _Body | None:
    """The inside of the object of deleted cells (n,) of the window, by row, then column; None if it is too small, or if
    all within it is held."""
    # The outline from above: the convex hull of the cells.
    first = np.flatnonzero(np.diff(rows, prepend=rows[0] - 1))
    last = np.append(first[1:], len(rows)) - 1
    ends = np.concatenate([np.stack([rows[at], cols[at]], axis=1) for at in (first, last)])
    corners = np.concatenate([ends + np.array([i, j]) for i in (-0.5, 0.5) for j in (-0.5, 0.5)])
    hull = scipy.spatial.ConvexHull(corners)
    if hull.volume < gravity.inside_cells:
        return None
    # The cells within it, and a little beyond.
    touch = gravity.touch_voxels
    low = max(int(rows.min()) - touch, 0), max(int(cols.min()) - touch, 0)
    r = np.arange(low[0], min(int(rows.max()) + touch + 1, window.base.shape[0]))[:, None]
    c = np.arange(low[1], min(int(cols.max()) + touch + 1, window.base.shape[1]))
    inside = np.ones((len(r), len(c)), dtype=np.bool_)
    for across, along, offset in hull.equations:
        inside &= across * r + along * c + offset <= touch
    box = slice(low[0], low[0] + len(r)), slice(low[1], low[1] + inside.shape[1])
    if not (window.loose[box] & inside).any():
        return None
    # How high each of its cells stood.
    words = window.carried[rows, cols]
    highest = np.floor(np.log2(np.maximum(words, np.uint64(1)).astype(np.float64))).astype(np.int64).clip(0, 63)
    tops = np.where(words > 0, window.base[rows, cols] + highest, _NOWHERE_HIGH).astype(np.int32)
    key = int(lattice_key(int(rows[0]) + window.lattice_corner[0], int(cols[0]) + window.lattice_corner[1]))
    return _Body(read_only(inside), low, read_only(rows), read_only(cols), read_only(tops), key)


@inlined
def _seen_from(word: np.uint64, layers: int) -> np.uint64:
    """A column's word from a base that lies ``layers`` lower; bits that pass an end are gone."""
    if layers >= 64 or layers <= -64:
        return np.uint64(0)
    return word << np.uint64(layers) if layers >= 0 else word >> np.uint64(-layers)


@kernel
def _find_carried(deleted: U64, base: I32, ground: int, gap: int, beside: int, carried: U64) -> None:
    """Into ``carried``, zeros, the deleted voxels to which deleted voxels of the cells at most ``beside`` rows and
    columns away lead up from the lowest ``ground`` ones, over at most ``gap`` missing layers."""
    rows, cols = deleted.shape
    for r in range(rows):
        for c in range(cols):
            if deleted[r, c] == 0:
                continue
            around = np.uint64(0)
            for a in range(max(r - beside, 0), min(r + beside + 1, rows)):
                for b in range(max(c - beside, 0), min(c + beside + 1, cols)):
                    if deleted[a, b]:
                        around |= _seen_from(deleted[a, b], base[a, b] - base[r, c])
            reached = (np.uint64(1) << np.uint64(ground)) - np.uint64(1)
            grows = True
            while grows:
                above = reached
                for _ in range(gap + 1):
                    above |= above << np.uint64(1)
                above &= around
                grows = above & ~reached != 0
                reached |= above
            carried[r, c] = reached & deleted[r, c]


@kernel
def _drop_touching(
    rest: U64, holds: U64, base: I32, at_hand: Bool, deleted: U64, carried: U64, row0: int, col0: int,
    lattice_row: int, lattice_col: int, touch: int, longest: int, beside_cells: int, seen: U64, stays: U64,
    cells: I64, words: U64, needed: Bool, fallen: U64, beside: I64,
) -> None:  # fmt: skip
    """Into ``fallen`` and ``beside`` the groups that touch a deleted voxel of one tile and that nothing holds.

    The planes are of a window of tiles; ``at_hand`` says which of them are shown. ``row0`` and ``col0`` are the first
    cell of the tile in it, ``lattice_row`` and ``lattice_col`` its own on the lattice. Only ``carried`` voxels of the
    ``deleted`` ones count; cells up to ``beside_cells`` away may carry more of them. ``seen`` and ``stays`` mark the
    voxels of groups that were followed, and of those that are held; ``cells`` and ``words`` are memory for one group.
    Into ``needed``, which has one tile more on every side, the tiles that would decide a group.
    """
    rows, cols = rest.shape
    zero = np.int64(0)  # for a literal 0 numba would compile _follow once more
    for r in range(row0, row0 + TILE_CELLS):
        for c in range(col0, col0 + TILE_CELLS):
            if deleted[r, c] == 0:
                continue
            hangs = deleted[r, c] & ~carried[r, c]
            for a in range(r - touch, r + touch + 1):
                for b in range(c - touch, c + touch + 1):
                    if a < 0 or b < 0 or a >= rows or b >= cols or not at_hand[a // TILE_CELLS, b // TILE_CELLS]:
                        needed[a // TILE_CELLS + 1, b // TILE_CELLS + 1] = True
                        continue
                    loose = rest[a, b] & ~holds[a, b] & ~seen[a, b]
                    if loose == 0:
                        continue
                    if hangs:
                        for i in range((r - beside_cells) // TILE_CELLS, (r + beside_cells) // TILE_CELLS + 1):
                            for j in range((c - beside_cells) // TILE_CELLS, (c + beside_cells) // TILE_CELLS + 1):
                                outside = i < 0 or j < 0 or i >= at_hand.shape[0] or j >= at_hand.shape[1]
                                if outside or not at_hand[i, j]:
                                    needed[i + 1, j + 1] = True
                    near = _seen_from(carried[r, c], base[r, c] - base[a, b])
                    for _ in range(touch):
                        near |= (near << np.uint64(1)) | (near >> np.uint64(1))
                    near &= loose
                    while near & ~seen[a, b]:
                        start = near & ~seen[a, b]
                        start &= ~start + np.uint64(1)
                        n = _follow(
                            rest, holds, base, at_hand, a, b, start, _ANYWHERE, zero, zero, _NO_CELLS, _NO_CELLS,
                            _NO_TOPS, touch, longest, zero, seen, stays, cells, words, needed,
                        )  # fmt: skip
                        for k in range(n):
                            x = cells[k] // cols
                            y = cells[k] % cols
                            fallen[x, y] |= words[k]
                            beside[x, y] = min(beside[x, y], ((lattice_row + r) << 32) + lattice_col + c + _HALF)


@kernel
def _drop_inside(
    rest: U64, holds: U64, base: I32, at_hand: Bool, inside: Bool, row0: int, col0: int, body_rows: I64,
    body_cols: I64, body_tops: I32, key: int, rise: int, longest: int, nearest: int, seen: U64, stays: U64,
    cells: I64, words: U64, needed: Bool, fallen: U64, beside: I64,
) -> None:  # fmt: skip
    """Into ``fallen`` and ``beside`` (``key``) the groups inside a body that nothing holds: ``inside`` (h, w) as in
    :class:`_Body`, from ``row0``, ``col0`` of the window; ``body_rows``, ``body_cols`` and ``body_tops`` (n,) are
    of its deleted cells. The rest as in :func:`_drop_touching`."""
    cols = rest.shape[1]
    for i in range(inside.shape[0]):
        for j in range(inside.shape[1]):
            if not inside[i, j]:
                continue
            a = row0 + i
            b = col0 + j
            waiting = rest[a, b] & ~holds[a, b] & ~seen[a, b]
            while waiting:
                start = waiting & (~waiting + np.uint64(1))
                n = _follow(
                    rest, holds, base, at_hand, a, b, start, inside, row0, col0, body_rows, body_cols, body_tops, rise,
                    longest, nearest, seen, stays, cells, words, needed,
                )  # fmt: skip
                for k in range(n):
                    x = cells[k] // cols
                    y = cells[k] % cols
                    fallen[x, y] |= words[k]
                    beside[x, y] = min(beside[x, y], key)
                waiting &= ~start & ~seen[a, b]


@kernel
def _follow(
    rest: U64, holds: U64, base: I32, at_hand: Bool, row: int, col: int, start: np.uint64, inside: Bool, row0: int,
    col0: int, body_rows: I64, body_cols: I64, body_tops: I32, rise: int, longest: int, nearest: int, seen: U64,
    stays: U64, cells: I64, words: U64, needed: Bool,
) -> int:  # fmt: skip
    """How many entries of ``cells`` and ``words`` are the group of a voxel that falls; 0 if it stays or is undecided.

    With ``inside`` the group must be within it and begin no higher than its body's top; if it is not, it is not
    ``seen`` either.
    """
    rows, cols = rest.shape
    wide = cols // TILE_CELLS + 2
    confined = inside.shape[0] > 0
    low_row = row
    high_row = row
    low_col = col
    high_col = col
    seen[row, col] |= start
    cells[0] = row * cols + col
    words[0] = start
    done = 0
    n = 1
    wanted = 0
    held = False
    leaves = False
    begins = False
    while done < n and not held and not leaves:
        r = cells[done] // cols
        c = cells[done] % cols
        if confined and not begins:
            lowest = 0
            while not words[done] >> np.uint64(lowest) & np.uint64(1):
                lowest += 1
            # The top of the body there: by its cells little farther away than the nearest one.
            away = np.inf
            for k in range(len(body_rows)):
                away = min(away, float((body_rows[k] - r) ** 2 + (body_cols[k] - c) ** 2))
            farthest = (np.sqrt(away) + nearest) ** 2
            top = _NOWHERE_HIGH
            for k in range(len(body_rows)):
                if (body_rows[k] - r) ** 2 + (body_cols[k] - c) ** 2 <= farthest:
                    top = max(top, body_tops[k])
            begins = base[r, c] + lowest <= top + rise
        for a in range(r - 1, r + 2):
            for b in range(c - 1, c + 2):
                if a < 0 or b < 0 or a >= rows or b >= cols or not at_hand[a // TILE_CELLS, b // TILE_CELLS]:
                    wanted |= 1 << ((a // TILE_CELLS + 1) * wide + b // TILE_CELLS + 1)
                    continue
                near = _seen_from(words[done], base[r, c] - base[a, b])
                near = (near | (near << np.uint64(1)) | (near >> np.uint64(1))) & rest[a, b]
                held = held or near & (holds[a, b] | stays[a, b]) != 0
                near &= ~seen[a, b]
                if near:
                    i = a - row0
                    j = b - col0
                    if confined and (
                        i < 0 or j < 0 or i >= inside.shape[0] or j >= inside.shape[1] or not inside[i, j]
                    ):
                        leaves = True
                        continue
                    seen[a, b] |= near
                    cells[n] = a * cols + b
                    words[n] = near
                    n += 1
                    low_row = min(low_row, a)
                    high_row = max(high_row, a)
                    low_col = min(low_col, b)
                    high_col = max(high_col, b)
        done += 1
        held = held or high_row - low_row >= longest or high_col - low_col >= longest
    if held:
        for k in range(n):
            stays[cells[k] // cols, cells[k] % cols] |= words[k]
        return 0
    if leaves or (confined and not begins):
        for k in range(n):
            seen[cells[k] // cols, cells[k] % cols] &= ~words[k]
        return 0
    for k in range(needed.shape[0] * wide):
        if wanted >> k & 1:
            needed[k // wide, k % wide] = True
    return 0 if wanted else n
