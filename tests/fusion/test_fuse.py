"""The server's half of the paper (IV), and the rules on votes, points and order (docs/decisions/voting.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from hand_made import SHAPE, Say, make_ballot, make_tile, states_plane, two_walls, wall, words_plane
from mapvote.cli import app
from mapvote.codec.ballot import Ballot, encode
from mapvote.codec.planes import Words
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.point_map import PointMap
from mapvote.core.rule import PAPER, SURFACES, Rule
from mapvote.core.tile import Memory, Tile
from mapvote.core.types import NO_VOTE, U8, CellState, MapvoteError
from mapvote.core.voting import VOTE_UNIT
from mapvote.formats import read_map, write_map
from mapvote.fusion.fuse import count, differing, fuse_tile, states_over, unspent, update_map
from mapvote.fusion.tile_vote import Vote

LATTICE = Lattice()
GRID = LATTICE.tile((0, 0))
CELL = (10, 10)
KEEP, SURE = FuseSettings(min_votes=1), FuseSettings(min_votes=2)
EMPTY, OCCUPIED = CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED


def vote(vehicle: str, states: U8, **more: object) -> Vote:
    return Vote(vehicle, 0, vehicle, states=states, **more)  # type: ignore[arg-type]


def marks(word: int) -> Words:
    return Words.of(words_plane({CELL: word}))


def fuse(tile: Tile, votes: list[Vote], policy: FuseSettings = KEEP, rule: Rule = SURFACES) -> tuple[U8, Tile]:
    decision, edited = fuse_tile(tile, votes, rule, policy)
    return decision.states, edited


def test_server_row_of_table_1() -> None:
    """Vehicles 1 and 2 say changed-occupied, 3 says undetermined: changed-occupied (paper IV, Table I)."""
    says = [OCCUPIED, OCCUPIED, CellState.UNDETERMINED]
    votes = [vote(f"v{i}", states_plane({CELL: s})) for i, s in enumerate(says)]
    assert count(votes, PAPER, 1)[0][CELL] == OCCUPIED


def test_ground_is_never_deleted_and_everything_else_is_bit_identical() -> None:
    ground, gone, other = wall([CELL], [0.05]), wall([CELL], [0.45, 5.0, 30.0]), wall([(20, 20)], [1.0])
    tile = make_tile(np.concatenate([gone, ground, other]))
    states, edited = fuse(tile, [vote("a", states_plane({CELL: EMPTY}))])
    assert states[CELL] == EMPTY
    assert edited.points.tobytes() == np.concatenate([ground, other]).tobytes()
    assert edited.ground_z is tile.ground_z
    hill = make_tile(wall([CELL], [100.1, 100.65]), ground=100.0)
    _, edited = fuse(hill, [vote("a", states_plane({CELL: EMPTY}), gone=marks(1 << 2))])
    assert edited.points[:, 2].tolist() == pytest.approx([100.1]), "heights are above the ground of the cell"


def test_right_state_with_false_points_injects_nothing() -> None:
    """Two honest vehicles see a wall up to 1 m; a liar votes the same state and adds a tower and another place."""
    honest = wall([CELL], [0.45, 0.75])
    lies = np.concatenate([wall([CELL], [5.0, 9.0]), wall([(99, 99)], [1.0])])
    votes = [vote(f"v{i}", states_plane({CELL: OCCUPIED}), new_points=p) for i, p in enumerate([honest, honest, lies])]
    _, edited = fuse(Tile.empty(GRID), votes, SURE)
    assert edited.points[:, 2].tolist() == pytest.approx([0.45, 0.75])


def test_where_points_are_added_the_map_no_longer_knows_free_space_though_no_vehicle_tells_of_rays() -> None:
    tile = replace(make_tile(wall([], [])), free=words_plane({CELL: 0b1111, (50, 50): 0b1111}))
    new = vote("a", states_plane({CELL: OCCUPIED}), new_points=wall([CELL], [0.75]))
    edited = fuse(tile, [new])[1]
    assert edited.points.tolist() == wall([CELL], [0.75]).tolist()
    assert edited.free is not None
    assert [int(edited.free[cell]) for cell in (CELL, (50, 50))] == [0b1011, 0b1111]


def test_free_space_is_learned_by_enough_vehicles_and_not_where_the_map_has_points() -> None:
    tile = make_tile(wall([CELL], [0.75]))
    free = words_plane({CELL: 0b1111, (50, 50): 0b1111})
    votes = [vote(v, states_plane(fill=1), free=Words.of(free)) for v in ("a", "b")]
    _, edited = fuse(tile, votes, SURE)
    _, alone = fuse(tile, votes[:1], SURE)
    assert edited.free is not None
    assert edited.points is tile.points
    assert int(edited.free[CELL]) == 0b1011
    assert int(edited.free[50, 50]) == 0b1111
    assert alone is tile, "one vehicle teaches nothing, and a map that never learned must not look like one that did"
    assert fuse(tile, votes[:1])[1].free is not None, "unless one is all that a change takes"


def plain_rule(votes: list[int], rule: Rule, min_votes: int) -> int:
    """The state of one cell, in the plainest words (paper IV): what the kernels must agree with."""
    tally = [votes.count(state) for state in range(5)]
    contenders = tally[:4] if rule == SURFACES else tally
    best = max(contenders)
    if best == 0:
        return CellState.UNDETERMINED if tally[4] else NO_VOTE
    if contenders.count(best) > 1:
        return CellState.UNDETERMINED
    state = contenders.index(best)
    if state in (OCCUPIED, EMPTY):
        no_majority = rule == SURFACES and 2 * best <= sum(contenders)
        if no_majority or best < min_votes:
            return CellState.UNDETERMINED
    return state


@given(
    seed=st.integers(0, 2**32 - 1),
    voters=st.sampled_from([1, 2, 3, 5, 9, 40]),
    rule=st.sampled_from([PAPER, SURFACES]),
    min_votes=st.integers(1, 4),
)
@settings(max_examples=40, deadline=None)
def test_the_kernels_decide_as_the_plain_rule_does(seed: int, voters: int, rule: Rule, min_votes: int) -> None:
    rng = np.random.default_rng(seed)
    says = rng.choice(np.array([0, 1, 2, 3, 4, 255], np.uint8), size=(voters, 256), p=rng.dirichlet(np.ones(6)))
    planes = [np.concatenate([row, np.full(256 * 255, NO_VOTE, np.uint8)]).reshape(SHAPE) for row in says]
    states, tally = count([vote(f"v{i}", plane) for i, plane in enumerate(planes)], rule, min_votes)
    assert tally.dtype == (np.uint8 if voters < 16 else np.uint16), "no larger than it need be"
    for column in range(256):
        cell = says[:, column].tolist()
        assert states[0, column] == plain_rule(cell, rule, min_votes)
        assert tally[0, column].tolist() == [VOTE_UNIT * cell.count(state) for state in range(5)]
    assert (states[1:] == NO_VOTE).all()


def test_more_votes_than_sixteen_bits_hold_are_counted() -> None:
    """4,096 vehicles times VOTE_UNIT is 65,536: one more than uint16 can say."""
    states, tally = count([vote(str(i), states_plane({CELL: EMPTY})) for i in range(4096)], SURFACES, 4096)
    assert (states[CELL], tally[CELL].tolist()) == (EMPTY, [0, 0, 0, 4096 * VOTE_UNIT, 0])


@given(
    seed=st.integers(0, 2**32 - 1),
    voters=st.integers(1, 6),
    rule=st.sampled_from([PAPER, SURFACES]),
    min_votes=st.integers(1, 3),
)
@settings(max_examples=25, deadline=None)
def test_one_stage_decides_the_sum_and_asks_for_vehicles_that_back_it(
    seed: int, voters: int, rule: Rule, min_votes: int
) -> None:
    """A vehicle backs what its own tally alone would decide. min_votes = 1 is the paper's plain sum."""
    rng = np.random.default_rng(seed)
    tallies = np.zeros((voters, *SHAPE, 5), np.uint16)
    tallies[:, 0] = rng.integers(0, 4, (voters, 256, 5)) * rng.integers(0, 2, (voters, 256, 5))
    states, total = count([Vote(str(i), 0, "", tally=t) for i, t in enumerate(tallies)], rule, min_votes)
    for column in range(256):
        each = [[state for state in range(5) for _ in range(t[0, column, state])] for t in tallies]
        expected = plain_rule([state for mine in each for state in mine], rule, 1)
        backing = [plain_rule(mine, rule, 1) for mine in each].count(expected)
        if min_votes > 1 and expected in (OCCUPIED, EMPTY) and backing < min_votes:
            expected = CellState.UNDETERMINED
        assert states[0, column] == expected
        assert total[0, column].tolist() == tallies[:, 0, column].sum(axis=0).tolist()


def test_one_loud_liar_takes_no_wall_down_because_others_once_looked_through_it() -> None:
    """Honest tallies hold a stray changed-empty scan; that is no vehicle standing behind the change."""
    liar, honest = np.zeros((*SHAPE, 5), np.uint16), np.zeros((*SHAPE, 5), np.uint16)
    liar[CELL] = [0, 0, 0, 4000 * VOTE_UNIT, 0]
    honest[CELL] = [30 * VOTE_UNIT, 0, 0, VOTE_UNIT, 0]
    votes = [Vote(f"v{i}", 0, str(i), tally=t) for i, t in enumerate([liar, honest, honest, honest])]
    tile = make_tile(wall([CELL], [0.45]))
    assert fuse(tile, votes, SURE, PAPER)[1] is tile
    second = Vote("w", 0, "w", tally=liar)
    assert fuse(tile, [*votes, second], SURE, PAPER)[0][CELL] == EMPTY


def test_states_over_a_window_of_tiles() -> None:
    decision, _ = fuse_tile(Tile.empty(LATTICE.tile((2, 3))), [vote("a", states_plane({CELL: EMPTY}))], SURFACES, KEEP)
    far, _ = fuse_tile(Tile.empty(LATTICE.tile((3, 5))), [vote("a", states_plane({CELL: OCCUPIED}))], SURFACES, KEEP)
    states, grid = states_over(LATTICE, {(2, 3): decision, (3, 5): far})
    assert states.shape == (512, 768)
    assert (grid.x0, grid.y0) == pytest.approx((3 * 76.8, 2 * 76.8))
    assert states[10, 10] == EMPTY
    assert states[266, 522] == OCCUPIED
    assert (states == NO_VOTE).sum() == states.size - 2


# A vote is spent once its cell has changed since the version that its vehicle drove with.

OTHER, THIRD = (200, 3), (255, 255)
TILE = make_tile(wall([CELL, OTHER], [0.45, 0.75]))


def changed(**versions: int) -> Tile:
    planes = Memory.none().planes.copy()
    for cell, version in zip((CELL, OTHER, THIRD), versions.values(), strict=False):
        planes[0][cell] = version
    return replace(TILE, memory=Memory.of(planes))


def seen_in(version: int) -> Vote:
    free = Words.of(words_plane({CELL: 0b100, OTHER: 0b1}))
    return vote("v", states_plane({CELL: EMPTY, OTHER: EMPTY}), free=free, version=version)


def spoken(cast: Vote) -> list[list[int]]:
    assert cast.states is not None
    return np.argwhere(cast.states != NO_VOTE).tolist()


def test_a_vote_counts_where_its_cell_is_as_old_as_its_map_and_nowhere_else() -> None:
    tile = changed(cell=3, other=5)
    assert spoken(unspent(seen_in(5), tile)) == [list(CELL), list(OTHER)]
    assert spoken(unspent(seen_in(4), tile)) == [list(CELL)]
    assert spoken(unspent(seen_in(3), tile)) == [list(CELL)]
    assert spoken(unspent(seen_in(2), tile)) == []
    assert spoken(unspent(seen_in(0), TILE)) == [list(CELL), list(OTHER)], (
        "on a tile that never changed every vote counts"
    )


def test_what_a_version_showed_wrongly_is_no_ground_for_a_vote() -> None:
    """After a replay: the vehicle saw a map that has been taken back."""
    wrong = np.zeros(SHAPE, dtype=np.bool_)
    wrong[CELL] = True
    assert spoken(unspent(seen_in(3), TILE, {3: wrong})) == [list(OTHER)]
    assert spoken(unspent(seen_in(3), TILE, {2: wrong})) == [list(CELL), list(OTHER)]
    assert spoken(unspent(seen_in(3), changed(cell=0, other=4), {3: wrong})) == []
    assert spoken(unspent(seen_in(3), changed(cell=4, other=3), {3: wrong})) == [list(OTHER)]


def cells_of(found: np.ndarray) -> list[list[int]]:
    assert found.shape == SHAPE
    return np.argwhere(found).tolist()


@given(st.integers(0, 2), st.sampled_from([CELL, OTHER]))
@settings(max_examples=10)
def test_the_last_bit_of_any_coordinate_is_a_difference(axis: int, cell: tuple[int, int]) -> None:
    points = TILE.points.copy()
    mine = [i for i, p in enumerate(points) if (int(p[1] / CELL_SIZE), int(p[0] / CELL_SIZE)) == cell]
    points[mine[0], axis] = np.nextafter(points[mine[0], axis], np.float32(np.inf))
    assert cells_of(differing(TILE, make_tile(points))) == [list(cell)]


Point = tuple[float, float, float]
POINTS = st.lists(st.tuples(*map(st.sampled_from, ([0.1, 0.4], [0.1, 0.2, 0.4], [0.1, 0.2]))), max_size=4)


@given(POINTS, POINTS)
@example([], [(0.0, 0.0, 0.0)])  # all its bits are zero, as those of nothing are
@settings(max_examples=20, deadline=None)
@example([(0.1, 0.1, 0.2)], [(0.1, 0.2, 0.2)])
@example([(0.1, 0.1, 0.2), (0.1, 0.4, 0.1)], [(0.1, 0.1, 0.1), (0.1, 0.4, 0.1)])
def test_cells_differ_that_hold_other_points_whatever_coordinates_these_share(a: list[Point], b: list[Point]) -> None:
    def of_cell(points: list[Point], r: int, c: int) -> list[Point]:
        return [p for p in points if (p[1] >= CELL_SIZE, p[0] >= CELL_SIZE) == (r, c)]

    one, other = (make_tile(np.array(points, np.float32).reshape(-1, 3)) for points in (a, b))
    cells = [[r, c] for r in (0, 1) for c in (0, 1) if of_cell(a, r, c) != of_cell(b, r, c)]
    assert cells_of(differing(one, other)) == cells_of(differing(other, one)) == cells


@pytest.mark.parametrize(
    ("one", "other", "differ"),
    [
        (None, None, []),
        (None, {}, []),  # learning that nothing is free is no difference
        (None, {CELL: 1}, [CELL]),
        ({CELL: 1}, None, [CELL]),
        ({CELL: 1}, {CELL: 1}, []),
        ({CELL: 1}, {CELL: 3, OTHER: 1}, [CELL, OTHER]),
    ],
)
def test_what_is_known_to_be_free_makes_a_difference(
    one: dict[tuple[int, int], int] | None, other: dict[tuple[int, int], int] | None, differ: list[tuple[int, int]]
) -> None:
    a, b = (replace(TILE, free=None if cells is None else words_plane(cells)) for cells in (one, other))
    assert cells_of(differing(a, b)) == [list(cell) for cell in differ]
    more = replace(b, points=np.concatenate([TILE.points, wall([THIRD], [9.0])]))
    assert cells_of(differing(a, more)) == [*(list(cell) for cell in differ), list(THIRD)], "and other points add to it"


# `mapvote update`: the offline server on files.


@pytest.fixture
def street() -> PointMap:
    return two_walls()


def gone(street: PointMap, vehicle: str = "v1", **more: object) -> Ballot:
    """The vehicle says that the first cell of the wall in tile (0, 0) is gone."""
    says = {(0, 0): Say(states_plane({(10, 10): CellState.CHANGED_EMPTY}))}
    return make_ballot(street, says, vehicle=vehicle, **more)  # type: ignore[arg-type]


def test_untouched_tiles_are_the_same_objects_and_the_same_ballot_twice_is_one_vote(street: PointMap) -> None:
    after, decisions = update_map(street, [gone(street)], KEEP)
    assert after.tiles[0, 1] is street.tiles[0, 1]
    assert len(after.tiles[0, 0].points) == len(street.tiles[0, 0].points) - 3
    assert decisions[0, 0].deleted == 3
    keep = make_ballot(street, {(0, 0): Say(states_plane({(10, 10): 0}))}, vehicle="v2")
    after, _ = update_map(street, [gone(street), gone(street), keep], KEEP)
    assert after.tiles[0, 0] is street.tiles[0, 0]
    built = Say(states_plane({(5, 5): CellState.CHANGED_OCCUPIED}), new_points=wall([(5, 5)], [0.45, 0.75]))
    after, _ = update_map(street, [make_ballot(street, {(4, 4): built}, vehicle=v) for v in "ab"], FuseSettings())
    assert len(after.tiles[4, 4].points) == 2, "where the map had no tile"


@pytest.mark.parametrize(
    ("ballots", "message"),
    [
        (lambda m: [], "no ballots"),
        (lambda m: [gone(m), gone(m, "v2", method="paper")], "All ballots of a round use one method"),
        (lambda m: [gone(m), gone(m, "v2", settings_hash="t")], "All ballots of a round use one method"),
        (lambda m: [gone(m, map_id="elsewhere")], "not on 'test-map'"),
        (lambda m: [gone(m, base={(0, 0): "0" * 64})], "another version of tile 0,0"),
        (lambda m: [gone(m), gone(m, end_ns=5_000_000_000)], "given twice"),
        (lambda m: [gone(m, method="astrology")], "unknown"),
    ],
)
def test_a_round_that_cannot_be_fused_says_why(
    street: PointMap, ballots: Callable[[PointMap], list[Ballot]], message: str
) -> None:
    with pytest.raises(MapvoteError, match=message):
        update_map(street, ballots(street), KEEP)


def run(arguments: Sequence[object]) -> str:
    result = CliRunner().invoke(app, ["update", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def test_update_on_files(street: PointMap, tmp_path: Path) -> None:
    write_map(street, tmp_path / "map")
    for vehicle in ("v1", "v2"):
        (tmp_path / vehicle).write_bytes(encode(gone(street, vehicle)))
    files = [tmp_path / "v1", tmp_path / "v2"]
    run([tmp_path / "map", *files, "--out", tmp_path / "new", "--cells", tmp_path / "cells.npz"])
    assert len(read_map(tmp_path / "new").tiles[0, 0].points) == len(street.tiles[0, 0].points) - 3
    with np.load(tmp_path / "cells.npz") as cells:
        assert cells["states"][10, 10] == CellState.CHANGED_EMPTY
        assert (float(cells["x0"]), float(cells["y0"]), float(cells["cell_size"])) == (0.0, 0.0, 0.3)
    assert "dry run" in run([tmp_path / "map", *files, "--dry-run", "--out", tmp_path / "nothing"])
    assert not (tmp_path / "nothing").exists()


def test_update_says_who_sent_what_another_sent(street: PointMap, tmp_path: Path) -> None:
    write_map(street, tmp_path / "map")
    borders = np.random.default_rng(1).integers(-5, 6, (2, 256)).cumsum(axis=1).clip(-20, 20)
    rows = np.arange(256)[:, None]
    states = np.where((rows > 60 + borders[0]) & (rows < 180 + borders[1]), CellState.UNCHANGED_EMPTY, NO_VOTE).astype(
        np.uint8
    )
    for vehicle, moved in (("v1", states), ("v2", np.roll(states, 1, axis=0))):
        (tmp_path / vehicle).write_bytes(encode(make_ballot(street, {(0, 0): Say(moved)}, vehicle)))
    told = run([tmp_path / "map", tmp_path / "v1", tmp_path / "v2", "--dry-run"])
    assert "on 1 tile: the two count as one vehicle there" in told


def test_what_cannot_change_anything_or_be_read_says_how_to_mend_it(street: PointMap, tmp_path: Path) -> None:
    write_map(street, tmp_path / "map")
    (tmp_path / "b").write_bytes(encode(gone(street)))
    assert "--min-votes 1" in run([tmp_path / "map", tmp_path / "b", "--dry-run"])
    assert "0 points added, 3 deleted" in run([tmp_path / "map", tmp_path / "b", "--dry-run", "--min-votes", "1"])
    (tmp_path / "b").write_bytes(b"nonsense")
    with pytest.raises(MapvoteError, match=r"/b: ballot: not readable"):
        run([tmp_path / "map", tmp_path / "b", "--dry-run"])
