"""Points that hang on a demolished object, or inside it, fall with it; nothing else does."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull

from hand_made import SHAPE, Cell, Say, make_ballot, make_map, make_tile, states_plane, wall, words_plane
from mapvote.codec.ballot import Ballot
from mapvote.codec.tile_planes import pack_tile
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Memory
from mapvote.core.types import CellState
from mapvote.fusion import fuse
from mapvote.fusion.fuse import update_map
from mapvote.fusion.gravity import GRAVITY, Fallen, Remains, fall_across, fall_within

UO, UE, CO, CE, UN = map(int, CellState)
Columns = Mapping[Cell, Iterable[int]]
"""Voxels of the map: bits of the column of each cell, on the lattice."""
ROUND = FuseSettings(min_votes=2)
T = TypeVar("T")


def by_tile(cells: Mapping[Cell, T]) -> dict[TileIndex, dict[Cell, T]]:
    """Cells of the lattice as cells of their tiles."""
    found: dict[TileIndex, dict[Cell, T]] = {}
    for (row, col), what in cells.items():
        tile = row // TILE_CELLS, col // TILE_CELLS
        found.setdefault(tile, {})[row % TILE_CELLS, col % TILE_CELLS] = what
    return found


def street(columns: Columns, ground: float = 0.0) -> PointMap:
    """A map with a point in each voxel, on flat ground."""
    tiles = {}
    for tile, cells in by_tile(columns).items():
        points = [wall([cell], [ground + (bit + 0.5) * CELL_SIZE for bit in bits]) for cell, bits in cells.items()]
        tiles[tile] = make_tile(np.concatenate(points), ground, tile)
    return make_map(tiles)


def ballot(point_map: PointMap, vehicle: str, gone: Columns, states: Mapping[Cell, int] | None = None) -> Ballot:
    """A vehicle that saw ``gone`` go, and says ``states`` of other cells."""
    masks = by_tile({cell: sum(1 << bit for bit in bits) for cell, bits in gone.items()})
    says = by_tile({**(states or {}), **dict.fromkeys(gone, CE)})
    spoken = {tile: Say(states_plane(says[tile]), gone=words_plane(masks.get(tile, {}))) for tile in says}
    return make_ballot(point_map, spoken, vehicle, f"{vehicle}-1")


def left(point_map: PointMap) -> dict[Cell, set[int]]:
    """The voxels that a map holds."""
    found: dict[Cell, set[int]] = {}
    for (tile_row, tile_col), tile in point_map.tiles.items():
        for flat, bit in zip(tile.cells.tolist(), tile.columns[0].tolist(), strict=True):
            cell = tile_row * TILE_CELLS + flat // TILE_CELLS, tile_col * TILE_CELLS + flat % TILE_CELLS
            found.setdefault(cell, set()).add(bit)
    return found


def moved(cells: Mapping[Cell, T], by: Cell) -> dict[Cell, T]:
    return {(row + by[0], col + by[1]): what for (row, col), what in cells.items()}


def after(columns: Columns, gone: Columns, states: Mapping[Cell, int] | None = None, by: Cell = (0, 0)) -> object:
    """The voxels left once two vehicles saw ``gone`` go; all of it moved ``by`` rows and columns."""
    point_map = street(moved(columns, by))
    both = [ballot(point_map, name, moved(gone, by), moved(states or {}, by)) for name in ("a", "b")]
    return moved(left(update_map(point_map, both, ROUND)[0]), (-by[0], -by[1]))


def sets(*parts: Columns) -> dict[Cell, set[int]]:
    """All of these voxels together."""
    found: dict[Cell, set[int]] = {}
    for part in parts:
        for cell, bits in part.items():
            found.setdefault(cell, set()).update(bits)
    return found


def box(rows: Iterable[int], cols: Iterable[int], bits: Iterable[int]) -> dict[Cell, list[int]]:
    every = list(bits)
    across = list(cols)
    return {(row, col): every for row in rows for col in across}


FRONT = box([50], range(50, 60), range(1, 20))
"""A facade, 6 m high."""
ROOF = box(range(50, 58), range(50, 60), [20, 21])
"""It hangs on the facade, and no ray ever crossed it."""
HOUSE = sets(FRONT, ROOF)
SIDES = sets(FRONT, box(range(50, 65), [50, 59], range(1, 20)))
"""A facade and two side walls, 4.5 m deep."""
BACK = box([63], range(52, 57), range(17, 21))
"""The top of the far wall, which touches nothing that vehicles saw go."""


def test_a_roof_over_a_demolished_facade_falls_and_its_cells_are_changed_empty() -> None:
    point_map = street(HOUSE)
    updated, decisions = update_map(point_map, [ballot(point_map, name, FRONT) for name in "ab"], ROUND)
    assert left(updated) == {}
    decision = decisions[0, 0]
    assert {tuple(cell) for cell in np.argwhere(decision.states == CE).tolist()} == set(HOUSE)
    assert decision.tally[57, 59].sum() == 0, "nobody voted there"
    assert decision.deleted == sum(len(bits) for bits in HOUSE.values())
    memory = updated.tiles[0, 0].memory
    assert memory is not None
    assert set(memory.cells.tolist()) == {row * TILE_CELLS + col for row, col in HOUSE}, "votes are spent there"


def test_the_top_of_the_far_wall_falls_because_it_lies_inside_the_house() -> None:
    assert after(sets(SIDES, BACK), SIDES) == {}
    assert after(sets(FRONT, BACK), FRONT) == sets(BACK), "behind a facade alone there is no inside"
    high = box([63], range(52, 57), range(23, 26))
    assert after(sets(SIDES, high), SIDES) == sets(high), "what begins above the house is no part of it"
    assert after(sets(SIDES, BACK), SIDES, {(63, 54): UO}) == sets(BACK), "a vehicle saw it stand"


def test_one_vehicle_alone_lets_nothing_fall() -> None:
    point_map = street(HOUSE)
    assert left(update_map(point_map, [ballot(point_map, "a", FRONT)], ROUND)[0]) == left(point_map)


@pytest.mark.parametrize("k", [1, 2, 3])
def test_k_liars_of_2k_and_one_let_nothing_fall(k: int) -> None:
    point_map = street(HOUSE)
    seen = dict.fromkeys(FRONT, UO)
    lies = [ballot(point_map, f"liar{i}", FRONT) for i in range(k)]
    honest = [ballot(point_map, f"v{i}", {}, seen) for i in range(k + 1)]
    careful = FuseSettings(min_votes=k + 1)
    assert left(update_map(point_map, [*lies, *honest], careful)[0]) == left(point_map)


HANGS: dict[str, tuple[Columns, Mapping[Cell, int]]] = {
    "a wall that it shares with the house next door": (box(range(50, 58), [60], range(1, 22)), {}),
    "a pillar of which nobody votes": (box([57], [59], range(1, 22)), {}),
    "a cell that a vehicle saw standing": ({}, {(57, 59): UO}),
    "a roof next door that a vehicle saw standing": (box([55], range(60, 70), [21]), {(55, 69): UO}),
    "a tree whose trunk stands": ({(60, 50): range(1, 20), (59, 50): [19, 20], (58, 50): [20, 21]}, {}),
}


@pytest.mark.parametrize("on", HANGS)
def test_a_roof_stays_that_hangs_on(on: str) -> None:
    more, states = HANGS[on]
    assert after(sets(HOUSE, more), FRONT, states) == sets(ROOF, more)


APART: dict[str, Columns] = {
    "a sign over the road, of whose gantry the map has nothing": box([50], range(62, 75), [18, 19, 20]),
    "a wire that passes by": box([47], range(200), [25]),
    "a wire across the house": box([55], range(30, 90), [23]),
    "a bridge overhead": box(range(60), range(45, 65), [24, 25, 26]),
    "a bridge beside it at the height of its roof": box(range(20, 47), range(40, 70), [17, 18]),
    "a tree crown beside it": box(range(40, 48), range(50, 58), range(10, 18)),
    "a tree crown that hangs over it": box(range(50, 72), range(45, 58), range(23, 30)),
}


@pytest.mark.parametrize("what", APART)
def test_what_is_no_part_of_the_house_stays_in_the_air(what: str) -> None:
    assert after(sets(SIDES, APART[what]), SIDES) == sets(APART[what])


def test_a_crown_over_a_demolished_kiosk_or_car_stays() -> None:
    kiosk = sets(box([50, 58], range(50, 60), range(1, 9)), box(range(50, 59), [50, 59], range(1, 9)))
    twigs = box(range(52, 55), range(52, 55), range(12, 15))
    assert after(sets(kiosk, twigs), kiosk) == sets(twigs)


def test_a_piece_of_a_viaduct_that_votes_delete_over_a_house_does_not_take_the_rest_with_it() -> None:
    deck = box(range(40, 70), range(45, 66), [26, 27])
    piece = box([50], range(52, 56), [26, 27])
    assert after(sets(SIDES, deck), sets(SIDES, piece)) == {cell: {26, 27} for cell in deck if cell not in piece}


def test_the_top_of_a_house_is_not_that_of_the_higher_one_next_door() -> None:
    lower = sets(box([50], range(61, 100), range(1, 9)), box(range(50, 65), [61, 99], range(1, 9)))
    wire = box([56], range(80, 84), [14])
    roof = box([56], range(80, 84), [9, 10])
    assert after(sets(SIDES, lower, wire), sets(SIDES, lower)) == sets(wire)
    assert after(sets(SIDES, lower, roof), sets(SIDES, lower)) == {}


def test_a_wire_between_two_houses_stays_while_one_of_them_stands() -> None:
    wire, other = box([50], range(60, 90), [18]), box([50], range(90, 99), range(1, 20))
    assert after(sets(FRONT, wire, other), FRONT) == sets(wire, other)


def test_a_gantry_keeps_its_beam_as_long_as_one_leg_stands() -> None:
    leg, other, beam = {(50, 50): range(1, 20)}, {(50, 90): range(1, 20)}, box([50], range(51, 90), [18, 19])
    assert after(sets(leg, beam, other), leg) == sets(beam, other)
    assert after(sets(leg, beam, other), sets(leg, other)) == {}


def test_a_storey_over_a_gap_of_the_house_next_door_stays() -> None:
    """A band of glass: the map has nothing between two storeys."""
    other = sets(box([50], range(63, 75), range(1, 10)), box([50], range(63, 75), range(14, 24)))
    assert after(sets(FRONT, other), FRONT) == other


def test_what_waits_for_surer_votes_does_not_fall() -> None:
    point_map, careful = street(HOUSE), FuseSettings(min_votes=2, false_deletions=1e-9)
    assert left(update_map(point_map, [ballot(point_map, name, FRONT) for name in "ab"], careful)[0]) == sets(HOUSE)


def test_without_known_ground_nothing_falls() -> None:
    ground = street(HOUSE)
    unknown = make_tile(ground.tiles[0, 0].points, float("nan"))
    point_map = make_map({(0, 0): unknown})
    updated, _ = update_map(point_map, [ballot(point_map, name, FRONT) for name in "ab"], ROUND)
    assert set(left(updated)) == set(ROOF) - set(FRONT)


def test_a_group_longer_than_a_tile_stays() -> None:
    for cells, stays in ((GRAVITY.longest_cells, False), (GRAVITY.longest_cells + 1, True)):
        beam = box([50], range(60, 60 + cells), [19])
        assert after(sets(FRONT, beam), FRONT) == (sets(beam) if stays else {})


PLACES = [(0, 0), (204, 0), (0, 199), (203, 201), (200, 204), (-307, -311), (2, 195), (192, 203)]


@pytest.mark.parametrize("by", PLACES)
def test_where_the_borders_of_tiles_lie_decides_nothing(by: Cell) -> None:
    held = sets(box(range(54, 56), [40], range(1, 22)), box([54], range(41, 50), [20]))
    assert after(HOUSE, FRONT, by=by) == {}
    assert after(sets(HOUSE, held), FRONT, by=by) == sets(ROOF, held)
    assert after(sets(SIDES, BACK), SIDES, by=by) == {}
    assert after(sets(SIDES, BACK), SIDES, {(63, 54): UO}, by=by) == sets(BACK)
    row = box([50], range(50, 300), range(1, 20))
    long = sets(row, box(range(50, 66), [50, 299], range(1, 20)))
    assert after(sets(long, BACK), long, by=by) == {}, "a row of houses over several tiles"


def test_a_house_at_the_border_falls_into_a_tile_of_which_nobody_votes() -> None:
    by = (205, 0)
    point_map = street(moved(HOUSE, by))
    updated, decisions = update_map(point_map, [ballot(point_map, n, moved(FRONT, by)) for n in "ab"], ROUND)
    assert left(updated) == {}
    assert set(decisions) == {(0, 0), (1, 0)}
    assert len(decisions[1, 0].fell.cells) == 70


def test_the_order_of_ballots_decides_nothing() -> None:
    point_map = street(moved(sets(SIDES, BACK), (200, 200)))
    gone = moved(SIDES, (200, 200))
    ballots = [ballot(point_map, name, gone) for name in "abc"]
    one, other = (update_map(point_map, some, ROUND)[0] for some in (ballots, ballots[::-1]))
    assert left(one) == left(other) == {}
    assert all((one.tiles[index].points == other.tiles[index].points).all() for index in one.tiles)


@pytest.mark.parametrize("by", [place for place in PLACES if place not in ((0, 0), (2, 195))])
def test_a_tile_after_a_fall_is_what_its_votes_and_the_fall_give(by: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    """The short way takes what falls over the border from the tile as it is; the long way fuses the tile again."""
    point_map = street(moved(sets(SIDES, BACK, ROOF), by))
    point_map = replace(point_map, version=3)
    ballots = [ballot(point_map, name, moved(SIDES, by)) for name in "abc"]
    short_map, short = update_map(point_map, ballots, ROUND)
    refused = []
    monkeypatch.setattr(fuse, "fall_besides", lambda *given: refused.append(given))
    long_map, long = update_map(point_map, ballots, ROUND)
    assert refused, "the house lies across a border"
    assert set(short) == set(long)
    for index, decision in long.items():
        for plane in ("states", "edits", "tally"):
            assert (getattr(short[index], plane) == getattr(decision, plane)).all(), plane
        assert (short[index].added, short[index].deleted) == (decision.added, decision.deleted)
        assert (short[index].fell.cells == decision.fell.cells).all()
        assert (short[index].fell.words == decision.fell.words).all()
        assert (short[index].fell.beside == decision.fell.beside).all()
        assert pack_tile(short_map.tile(index))[0] == pack_tile(long_map.tile(index))[0]


def test_what_vehicles_built_is_fused_again_when_it_falls_because_its_stay_is_counted() -> None:
    by = (0, 199)
    rest, gone = moved(sets(SIDES, BACK), by), moved(SIDES, by)
    point_map = replace(street(rest), version=3)
    tiles = dict(point_map.tiles)
    for index, tile in tiles.items():
        cells = np.unique(tile.cells)
        values = np.zeros((4, len(cells)), dtype=np.uint32)
        values[:2] = [[2], [5]]
        tiles[index] = tile.but(memory=Memory(cells, values))
    point_map = replace(point_map, tiles=tiles)
    updated, _ = update_map(point_map, [ballot(point_map, name, gone) for name in "ab"], ROUND)
    assert left(updated) == {}
    for tile in updated.tiles.values():
        assert tile.memory is not None
        assert (tile.memory.values[1] == 0).all(), "nothing stands there any more"
        assert (tile.memory.values[2] == 1).all(), "one object came and went"


# Random groups against scipy's labels -------------------------------------------------------------------------------


LOWEST_BIT = 4
"""The lowest layer of the random voxels has this bit where the base of a column is 0."""


def climbed(layers: NDArray[np.bool_], ground: int) -> int:
    """The highest of ``layers`` (n,) to which they lead up from below ``ground``, over few that are missing; far below
    if none."""
    top = ground - 1
    highest = -(10**6)
    for layer in np.flatnonzero(layers):
        if layer <= top + GRAVITY.gap_voxels + 1:
            top = max(top, int(layer))
            highest = int(layer)
    return highest


def carried(deleted: NDArray[np.bool_], ground: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Deleted voxels (rows, cols, layers) to which those of the cells around lead up from below ``ground``."""
    found = np.zeros_like(deleted)
    reach = GRAVITY.beside_cells
    for r, c in np.argwhere(deleted.any(axis=2)):
        around = deleted[max(r - reach, 0) : r + reach + 1, max(c - reach, 0) : c + reach + 1]
        top = max(climbed(np.asarray(around.any(axis=(0, 1))), ground[r, c]), -1)
        found[r, c, : top + 1] = deleted[r, c, : top + 1]
    return found


def in_plain_words(
    rest: NDArray[np.bool_], holds: NDArray[np.bool_], deleted: NDArray[np.bool_], base: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Voxels that fall among voxels (rows, cols, layers); bit 0 of a column is layer ``base`` - LOWEST_BIT."""
    ground = base - LOWEST_BIT + GRAVITY.ground_voxels
    groups, count = ndimage.label(rest, np.ones((3, 3, 3)))
    stood = carried(deleted, ground)
    tops = np.where(stood.any(axis=2), stood.shape[2] - 1 - stood[..., ::-1].argmax(axis=2), -(10**6))
    near = ndimage.binary_dilation(stood, np.ones((5, 5, 5)))
    # Outlines of the objects of deleted cells.
    emptied = deleted.any(axis=2)
    objects = ndimage.label(ndimage.binary_dilation(emptied, np.ones((3, 3))), np.ones((3, 3)))[0]
    bodies = []
    for number in range(1, objects.max() + 1):
        cells = np.argwhere(emptied & (objects == number))
        hull = ConvexHull(np.concatenate([cells + np.array([i, j]) for i in (-0.5, 0.5) for j in (-0.5, 0.5)]))
        if hull.volume >= GRAVITY.inside_cells:
            every = np.argwhere(np.ones(emptied.shape))
            inside = (every @ hull.equations[:, :2].T + hull.equations[:, 2] <= 2).all(axis=1).reshape(emptied.shape)
            bodies.append((inside, cells))

    def begins(group: NDArray[np.bool_], cells: NDArray[np.int64]) -> bool:
        """Whether a voxel of a group is at most three layers above the top of an object there, or lower."""
        for r, c, layer in np.argwhere(group):
            away = np.hypot(*(cells - [r, c]).T)
            beside = cells[away <= away.min() + GRAVITY.beside_cells + 1e-9]
            if layer <= tops[beside[:, 0], beside[:, 1]].max() + GRAVITY.rise_voxels:
                return True
        return False

    falls = np.zeros(count + 1, dtype=np.bool_)
    for number in range(1, count + 1):
        group = groups == number
        if (group & holds).any():
            continue
        within = any((inside | ~group.any(axis=2)).all() and begins(group, cells) for inside, cells in bodies)
        falls[number] = within or (group & near).any()
    return np.asarray(falls[groups])


def words_of(voxels: NDArray[np.bool_], base: NDArray[np.int32]) -> NDArray[np.uint64]:
    """Column words of voxels (rows, cols, layers)."""
    layers = np.arange(voxels.shape[2]) + LOWEST_BIT - base[..., None]
    return np.asarray((voxels.astype(np.uint64) << layers.astype(np.uint64)).sum(axis=2, dtype=np.uint64))


SIZE = 40
CORNER = 2 * TILE_CELLS - SIZE // 2


def falls(remains_of: Mapping[TileIndex, Remains]) -> dict[TileIndex, Fallen]:
    """Voxels that fall in each tile, first alone, then across borders."""
    sites, fell, undecided = dict(remains_of), dict[TileIndex, Fallen](), dict[TileIndex, Remains]()
    for index, site in remains_of.items():
        fell[index], missing = fall_within(index, site)
        sites[index] = Remains(site.rest & ~fell[index].plane(), site.holds, site.deleted, site.base)
        if missing:
            undecided[index] = sites[index]
    for index, more in fall_across(undecided, sites.__getitem__).items():
        fell[index] = fell[index].joined(more)
    return fell


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.03, 0.08, 0.2]), st.sampled_from([0.0003, 0.002, 0.01]))
def test_random_groups_across_borders_fall_as_labels_say(seed: int, share: float, gone: float) -> None:
    rng = np.random.default_rng(seed)
    rest = rng.random((SIZE, SIZE, 12)) < share
    deleted = (rng.random(rest.shape) < gone) & ~rest
    holds = rest & (rng.random(rest.shape) < 0.01)
    base = rng.integers(0, 3, (SIZE, SIZE)).astype(np.int32)
    planes: dict[str, NDArray[Any]] = {"base": np.zeros((5 * TILE_CELLS, 5 * TILE_CELLS), dtype=np.int32)}
    own = slice(CORNER, CORNER + SIZE), slice(CORNER, CORNER + SIZE)
    planes["base"][own] = base
    for name, voxels in (("rest", rest), ("holds", holds), ("deleted", deleted)):
        planes[name] = np.zeros(planes["base"].shape, dtype=np.uint64)
        planes[name][own] = words_of(voxels, base)
    sites = {}
    for row in range(-2, 6):
        for col in range(-2, 6):
            at = slice(row * TILE_CELLS, (row + 1) * TILE_CELLS), slice(col * TILE_CELLS, (col + 1) * TILE_CELLS)
            words = [planes[name][at] for name in ("rest", "holds", "deleted")]
            whole = words[0].shape == SHAPE
            rest_of, holds_of, deleted_of = words if whole else [np.zeros(SHAPE, np.uint64)] * 3
            base_of = planes["base"][at] if whole else np.zeros(SHAPE, np.int32)
            sites[row, col] = Remains(rest_of, holds_of, deleted_of, base_of)
    fell = np.zeros(planes["rest"].shape, dtype=np.uint64)
    for (row, col), fallen in falls(sites).items():
        if len(fallen.cells):
            fell[row * TILE_CELLS : (row + 1) * TILE_CELLS, col * TILE_CELLS : (col + 1) * TILE_CELLS] = fallen.plane()
    assert (fell[own] == words_of(in_plain_words(rest, holds, deleted, base), base)).all()
    fell[own] = 0
    assert not fell.any()
