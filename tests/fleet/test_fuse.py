"""The server's half of the paper (IV), and DESIGN 4's rules on votes, points and order."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import SHAPE, make_tile, states_plane, wall, words_plane
from mapvote.config import FuseSettings
from mapvote.core.grid import Lattice, tile_grid
from mapvote.core.types import NO_VOTE, U8, CellState, MapTile
from mapvote.core.voting import VOTE_UNIT, count_votes, decide, one_hot
from mapvote.fleet.fuse import DAY_NS, Rule, TileVote, at_least, count, fold, fuse_tile, restrict, select, states_over

LATTICE = Lattice()
GRID = tile_grid(LATTICE, (0, 0))
CELL = (10, 10)
KEEP, SURE = FuseSettings(min_votes=1), FuseSettings(min_votes=2)
EMPTY, OCCUPIED = CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED


def vote(vehicle: str, states: U8, **more: object) -> TileVote:
    return TileVote(vehicle, 0, vehicle, states=states, **more)  # type: ignore[arg-type]


def fuse(
    tile: MapTile | None, votes: list[TileVote], policy: FuseSettings = KEEP, rule: Rule = "columns"
) -> tuple[U8, MapTile | None]:
    decision, edited = fuse_tile(LATTICE, (0, 0), tile, votes, rule, policy)
    return decision.states, edited


def test_server_row_of_table_1() -> None:
    """Vehicles 1 and 2 say changed-occupied, 3 says undetermined: changed-occupied (paper IV, Table I)."""
    says = [OCCUPIED, OCCUPIED, CellState.UNDETERMINED]
    votes = [vote(f"v{i}", states_plane({CELL: s})) for i, s in enumerate(says)]
    assert count(votes, "paper", 1)[0][CELL] == OCCUPIED


@pytest.mark.parametrize(
    ("says", "paper", "columns"),
    [
        ([OCCUPIED, EMPTY], CellState.UNDETERMINED, CellState.UNDETERMINED),
        ([EMPTY, CellState.UNDETERMINED], CellState.UNDETERMINED, EMPTY),
        ([EMPTY, EMPTY, CellState.UNDETERMINED, CellState.UNDETERMINED, CellState.UNDETERMINED], 4, EMPTY),
        ([EMPTY, EMPTY, CellState.UNCHANGED_OCCUPIED, CellState.UNCHANGED_EMPTY], EMPTY, CellState.UNDETERMINED),
    ],
)
def test_undetermined_competes_in_the_paper_and_abstains_in_columns(says: list[int], paper: int, columns: int) -> None:
    votes = [vote(f"v{i}", states_plane({CELL: s})) for i, s in enumerate(says)]
    assert count(votes, "paper", 1)[0][CELL] == paper
    assert count(votes, "columns", 1)[0][CELL] == columns


def test_tie_keeps_the_points_of_the_map() -> None:
    tile = make_tile(wall([CELL], [0.45, 0.75]))
    votes = [vote("a", states_plane({CELL: EMPTY})), vote("b", states_plane({CELL: CellState.UNCHANGED_OCCUPIED}))]
    assert fuse(tile, votes, rule="paper")[1] is tile


def test_ground_is_never_deleted_and_everything_else_is_bit_identical() -> None:
    ground, gone, other = wall([CELL], [0.05]), wall([CELL], [0.45, 5.0, 30.0]), wall([(20, 20)], [1.0])
    tile = make_tile(np.concatenate([gone, ground, other]))
    states, edited = fuse(tile, [vote("a", states_plane({CELL: EMPTY}))])
    assert states[CELL] == EMPTY
    assert edited is not None
    assert edited.points.tobytes() == np.concatenate([ground, other]).tobytes()
    assert edited.ground_z is tile.ground_z


def test_delete_mask_takes_the_awning_and_leaves_the_wall() -> None:
    tile = make_tile(wall([CELL], [0.45, 1.05, 3.15]))
    awning = words_plane({CELL: 1 << 10})
    _, edited = fuse(tile, [vote("a", states_plane({CELL: EMPTY}), gone=awning)])
    assert edited is not None
    assert edited.points[:, 2].tolist() == pytest.approx([0.45, 1.05])


def test_only_voxels_marked_by_enough_vehicles_are_deleted() -> None:
    tile = make_tile(wall([CELL], [0.45, 0.75, 1.05]))
    masks = [1 << 1 | 1 << 2, 1 << 2 | 1 << 3, 1 << 2]
    votes = [vote(f"v{i}", states_plane({CELL: EMPTY}), gone=words_plane({CELL: m})) for i, m in enumerate(masks)]
    _, edited = fuse(tile, votes, SURE)
    assert edited is not None
    assert edited.points[:, 2].tolist() == pytest.approx([0.45, 1.05])


def test_heights_are_relative_to_the_ground_of_the_cell() -> None:
    tile = make_tile(wall([CELL], [100.1, 100.65]), ground=100.0)
    _, edited = fuse(tile, [vote("a", states_plane({CELL: EMPTY}), gone=words_plane({CELL: 1 << 2}))])
    assert edited is not None
    assert edited.points[:, 2].tolist() == pytest.approx([100.1])


def test_min_votes_holds_back_a_change_that_too_few_saw() -> None:
    tile = make_tile(wall([CELL], [0.45]))
    states, edited = fuse(tile, [vote("a", states_plane({CELL: EMPTY}))], SURE)
    assert states[CELL] == CellState.UNDETERMINED
    assert edited is tile


def test_right_state_with_false_points_injects_nothing() -> None:
    """Two honest vehicles see a wall up to 1 m; a liar votes the same state and adds a tower and another place."""
    honest = wall([CELL], [0.45, 0.75])
    lies = np.concatenate([wall([CELL], [5.0, 9.0]), wall([(99, 99)], [1.0])])
    votes = [vote(f"v{i}", states_plane({CELL: OCCUPIED}), new_points=p) for i, p in enumerate([honest, honest, lies])]
    _, edited = fuse(None, votes, SURE)
    assert edited is not None
    assert edited.points[:, 2].tolist() == pytest.approx([0.45, 0.75])


def test_new_points_need_support_within_one_voxel_of_the_column() -> None:
    says = [wall([CELL], [0.45, 3.15]), wall([CELL], [0.75, 4.05])]
    votes = [vote(f"v{i}", states_plane({CELL: OCCUPIED}), new_points=p) for i, p in enumerate(says)]
    _, edited = fuse(None, votes, SURE)
    assert edited is not None
    assert edited.points[:, 2].tolist() == pytest.approx([0.45, 0.75])


def test_a_vehicle_that_voted_otherwise_adds_no_points() -> None:
    votes = [
        vote("a", states_plane({CELL: OCCUPIED}), new_points=wall([CELL], [0.45])),
        vote("b", states_plane({CELL: CellState.UNDETERMINED}), new_points=wall([CELL], [0.45, 6.0])),
    ]
    _, edited = fuse(None, votes)
    assert edited is not None
    assert len(edited.points) == 1


def test_a_voxel_of_the_map_stays_as_it_is() -> None:
    tile = make_tile(wall([CELL], [0.05]))
    offered = wall([CELL], [0.1, 0.45]) + np.float32(0.01)
    _, edited = fuse(tile, [vote("a", states_plane({CELL: OCCUPIED}), new_points=offered)])
    assert edited is not None
    assert len(edited.points) == 2
    assert edited.points[:1].tobytes() == tile.points.tobytes()


def test_one_stage_is_the_sum_of_the_tallies() -> None:
    """Paper IV: the server aggregates the vote counts; one loud vehicle outvotes two quiet ones."""
    loud, quiet = np.zeros((*SHAPE, 5), np.uint16), np.zeros((*SHAPE, 5), np.uint16)
    loud[CELL] = [0, 0, 100 * VOTE_UNIT, 0, 0]
    quiet[CELL] = [30 * VOTE_UNIT, 0, 0, 0, 5 * VOTE_UNIT]
    votes = [TileVote(f"v{i}", 0, str(i), tally=t) for i, t in enumerate([loud, quiet, quiet])]
    states, tally = count(votes, "paper", 1)
    assert states[CELL] == OCCUPIED
    assert tally[CELL].tolist() == [60 * VOTE_UNIT, 0, 100 * VOTE_UNIT, 0, 10 * VOTE_UNIT]
    assert count(votes, "paper", 2)[0][CELL] == CellState.UNDETERMINED


def test_free_space_is_learned_by_enough_vehicles_and_not_where_the_map_has_points() -> None:
    tile = make_tile(wall([CELL], [0.75]))
    free = words_plane({CELL: 0b1111, (50, 50): 0b1111})
    votes = [vote(v, states_plane(fill=1), free=free) for v in ("a", "b")]
    _, edited = fuse(tile, votes, SURE)
    _, alone = fuse(tile, votes[:1], SURE)
    assert edited is not None
    assert edited.free is not None
    assert edited.points is tile.points
    assert int(edited.free[CELL]) == 0b1011
    assert int(edited.free[50, 50]) == 0b1111
    assert alone is not None
    assert not np.any(alone.free)


def test_a_drive_that_is_silent_never_overrides_and_the_later_one_wins() -> None:
    early = TileVote("a", 1, "x", states=states_plane({(0, 0): EMPTY, (0, 1): EMPTY}))
    late = TileVote("a", 2, "y", states=states_plane({(0, 1): CellState.UNCHANGED_OCCUPIED}))
    folded = fold([late, early], GRID).states
    assert folded is not None
    assert folded[0, 0] == EMPTY
    assert folded[0, 1] == CellState.UNCHANGED_OCCUPIED


def test_ten_drives_of_one_vehicle_are_one_vote() -> None:
    drives = [TileVote("a", i, str(i), states=states_plane({CELL: EMPTY})) for i in range(10)]
    other = vote("b", states_plane({CELL: CellState.UNCHANGED_OCCUPIED}))
    assert fuse(make_tile(wall([CELL], [0.45])), [*drives, other])[0][CELL] == CellState.UNDETERMINED


def test_planes_follow_the_drive_that_speaks_for_the_cell() -> None:
    """An old drive's new points give way when a later drive of the same vehicle speaks for the cell."""
    early = TileVote("a", 1, "x", states=states_plane({CELL: OCCUPIED}), new_points=wall([CELL], [0.45]))
    late = TileVote("a", 2, "y", states=states_plane({CELL: OCCUPIED}), new_points=wall([CELL], [2.0]))
    folded = fold([early, late], GRID)
    assert folded.new_points is not None
    assert folded.new_points[:, 2].tolist() == pytest.approx([2.0])


def test_window_in_vehicles_and_days() -> None:
    votes = [TileVote(f"v{i}", i * DAY_NS, "x", states=states_plane()) for i in range(10)]
    votes.append(TileVote("old", -40 * DAY_NS, "x", states=states_plane()))
    chosen = select(votes, FuseSettings(latest_vehicles=3, max_age_days=30))
    assert [v.vehicle for v in chosen] == ["v7", "v8", "v9"]
    assert "old" not in {v.vehicle for v in select(votes, FuseSettings(latest_vehicles=99, max_age_days=30))}


def test_silenced_cells_count_for_nothing() -> None:
    states, free = states_plane({CELL: EMPTY, (1, 1): EMPTY}), words_plane({CELL: 7, (1, 1): 7})
    counts = np.ones(SHAPE, dtype=np.bool_)
    counts[CELL] = False
    silenced = restrict(vote("a", states, free=free), counts)
    assert silenced.states is not None
    assert silenced.free is not None
    assert silenced.states[CELL] == NO_VOTE
    assert silenced.free[CELL] == 0
    assert silenced.states[1, 1] == EMPTY


@given(seed=st.integers(0, 2**32 - 1), voters=st.integers(1, 40))
@settings(max_examples=15, deadline=None)
def test_counting_is_the_sum_of_one_hot_tallies(seed: int, voters: int) -> None:
    rng = np.random.default_rng(seed)
    planes = rng.choice(np.array([0, 1, 2, 3, 4, 255], np.uint8), size=(voters, 5000))
    tally = count_votes(planes)
    assert np.array_equal(tally, one_hot(planes).sum(axis=0))
    assert np.array_equal(decide(tally), decide(one_hot(planes).sum(axis=0)))


@given(words=st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=8), k=st.integers(1, 5))
def test_at_least_counts_bits(words: list[int], k: int) -> None:
    expected = sum(1 << b for b in range(64) if sum(w >> b & 1 for w in words) >= k)
    assert int(at_least(np.array(words, np.uint64)[:, None], k)[0]) == expected


def random_drive(rng: np.random.Generator, vehicle: str, end_ns: int) -> TileVote:
    states = states_plane()
    states[:6, :6] = rng.choice(np.array([0, 1, 2, 3, 4, 255], np.uint8), size=(6, 6))
    cells = [(r, c) for r, c in itertools.product(range(6), range(6)) if states[r, c] == OCCUPIED]
    points = wall(cells, [0.45, 0.75]) + rng.uniform(0, 0.1, size=(2 * len(cells), 3)).astype(np.float32)
    free, gone = words_plane({}), words_plane({})
    free[:6, :6], gone[:6, :6] = rng.integers(0, 64, size=(6, 6)), rng.integers(0, 16, size=(6, 6))
    return TileVote(vehicle, end_ns, str(rng.integers(1 << 40)), states=states, gone=gone, new_points=points, free=free)


@given(seed=st.integers(0, 2**32 - 1), rule=st.sampled_from(["paper", "columns"]), min_votes=st.integers(1, 3))
@settings(max_examples=25, deadline=None)
def test_order_never_matters(seed: int, rule: Rule, min_votes: int) -> None:
    """Any order of the same drives, from vehicles with one or several drives, gives bit-identical tiles."""
    rng = np.random.default_rng(seed)
    drives = [random_drive(rng, f"v{rng.integers(5)}", int(rng.integers(3))) for _ in range(8)]
    tile = make_tile(wall(list(itertools.product(range(6), range(6))), [0.05, 0.45, 1.05]))
    results = set()
    for _ in range(3):
        order = [drives[i] for i in rng.permutation(len(drives))]
        states, edited = fuse(tile, order, FuseSettings(min_votes=min_votes), rule)
        assert edited is not None
        assert edited.free is not None
        results.add((states.tobytes(), edited.points.tobytes(), edited.free.tobytes()))
    assert len(results) == 1


def test_states_over_a_window_of_tiles() -> None:
    decision, _ = fuse_tile(LATTICE, (2, 3), None, [vote("a", states_plane({CELL: EMPTY}))], "columns", KEEP)
    far, _ = fuse_tile(LATTICE, (3, 5), None, [vote("a", states_plane({CELL: OCCUPIED}))], "columns", KEEP)
    states, grid = states_over(LATTICE, {(2, 3): decision, (3, 5): far})
    assert states.shape == (512, 768)
    assert (grid.x0, grid.y0) == pytest.approx((3 * 76.8, 2 * 76.8))
    assert states[10, 10] == EMPTY
    assert states[266, 522] == OCCUPIED
    assert (states == NO_VOTE).sum() == states.size - 2
