"""The five states of paper Figure 3, cell by cell, case 5, and how the paper's open sentences can be read."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from hand_made import make_map, make_tile, wall
from mapvote.config import PaperSettings, VotingSettings
from mapvote.core.columns import below_top, span_of
from mapvote.core.geometry import from_xyz_rpy, rows_from
from mapvote.core.grid import CELL_SIZE, Grid, Lattice, window_around
from mapvote.core.point_map import PointMap
from mapvote.core.reference import reference_window
from mapvote.core.sensors import SENSORS
from mapvote.core.types import NO_VOTE, CellState, Reference
from mapvote.core.voting import VOTE_UNIT, vote_weight
from mapvote.perception.frontend import Observation, PlacedScan
from mapvote.perception.placement import find_obstacles
from mapvote.perception.raycast import ScanView, Sight, cast_rays
from mapvote.rules.paper import (
    BEGINS_ABOVE,
    N_WORDS,
    WITHOUT_MOVERS,
    PaperVoter,
    cell_words,
    classify_paper,
    reading_table,
    readings_of,
    sightings,
    votes_in,
)

ORIGIN = np.array([0.15, 0.15, 1.8])
SENSOR = SENSORS["hdl32e"]


def one_cell(
    n: int, sight: Sight, map_bits: int = 0, passed: int = 0, hit: int = 0, bottom_z: float = 0.5, far: int = 30,
    row: int = 0,
) -> tuple[ScanView, Reference]:  # fmt: skip
    """A window in which only the last cell, ``far`` cells away in the last row, holds anything."""
    grid = Grid(Lattice(), 0, 0, row + 1, far + 1)

    def plane(value: float, dtype: type, fill: float = 0) -> np.ndarray:
        out: np.ndarray = np.full(grid.shape, fill, dtype)
        out[row, far] = value
        return out

    view = ScanView(
        grid, plane(n, np.int32), plane(hit, np.uint64), plane(passed, np.uint64), plane(int(sight), np.uint8)
    )
    mapped = int(map_bits != 0)
    zero = np.zeros(grid.shape, np.float32)
    reference = Reference(
        grid,
        zero,
        zero.astype(np.int32),
        plane(map_bits, np.uint64),
        plane(mapped, np.int32),
        plane(bottom_z, np.float32, np.inf),
        plane(bottom_z + 1, np.float32, -np.inf),
        None,
    )
    return view, reference


def vote(
    view: ScanView, reference: Reference, weighted: bool = True, tall: bool = False, **read: Any
) -> tuple[int, int]:
    """State and votes of the last cell, the paper's sentences ``read`` like that; an occluded scan votes, so that it
    shows."""
    words = cell_words(view, reference, ORIGIN, SENSOR)
    voting = VotingSettings(weighted=weighted, skip_tall_cells=tall)
    states, weights = classify_paper(
        words, reference.counts > 0, voting, PaperSettings.model_validate({"occluded": "votes"} | read)
    )
    return int(states[-1, -1]), int(weights[-1, -1])


@pytest.mark.parametrize(
    ("n", "sight", "map_bits", "state"),
    [
        (7, Sight.CLEAR, 0b1110, CellState.UNCHANGED_OCCUPIED),
        (7, Sight.CLEAR, 0, CellState.CHANGED_OCCUPIED),
        (0, Sight.CLEAR, 0, CellState.UNCHANGED_EMPTY),
        (0, Sight.CLEAR, 0b1110, CellState.CHANGED_EMPTY),
        (0, Sight.BEHIND, 0b1110, CellState.UNDETERMINED),
        (0, Sight.BEYOND, 0, CellState.UNDETERMINED),
        (4, Sight.CLEAR, 0b1110, CellState.UNDETERMINED),
        (4, Sight.CLEAR, 0, CellState.UNDETERMINED),
        (0, Sight.NEVER, 0b1110, NO_VOTE),
    ],
)
def test_the_five_states_of_figure_3(n: int, sight: Sight, map_bits: int, state: int) -> None:
    assert vote(*one_cell(n, sight, map_bits))[0] == state


def test_occupied_cells_have_the_votes_of_equation_1_and_others_one() -> None:
    assert vote(*one_cell(10, Sight.CLEAR))[1] == round(float(vote_weight(10)) * VOTE_UNIT)
    assert vote(*one_cell(10, Sight.CLEAR), weighted=False)[1] == VOTE_UNIT
    assert vote(*one_cell(0, Sight.CLEAR))[1] == VOTE_UNIT
    assert vote(*one_cell(3, Sight.CLEAR))[1] == VOTE_UNIT


def test_the_three_occlusion_rules() -> None:
    behind_a_fence = one_cell(0, Sight.BEHIND, map_bits=0b1010_0000, passed=0b100_0000)
    assert vote(*behind_a_fence, line_of_sight="points")[0] == CellState.UNDETERMINED
    assert vote(*behind_a_fence, line_of_sight="farthest")[0] == CellState.CHANGED_EMPTY
    assert vote(*behind_a_fence, line_of_sight="column")[0] == CellState.CHANGED_EMPTY  # through the span, not a voxel
    over_it = one_cell(0, Sight.CLEAR, map_bits=0b1010_0000, passed=0b1_0000)
    assert vote(*over_it, line_of_sight="column")[0] == CellState.UNDETERMINED


def test_case_5_skips_cells_whose_map_begins_above_the_view_at_that_range() -> None:
    # 9 m away, the view of an HDL-32E at 1.8 m ends at 1.8 + 9 tan(10.67 deg) = 3.50 m.
    for bottom_z, state in ((3.4, CellState.CHANGED_EMPTY), (3.6, NO_VOTE)):
        cell = one_cell(0, Sight.CLEAR, map_bits=1 << 12, bottom_z=bottom_z)
        assert vote(*cell, tall=True)[0] == state
        assert vote(*cell)[0] == CellState.CHANGED_EMPTY


@given(
    st.tuples(*[st.floats(-4.0, 4.0)] * 3),
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    st.floats(0.5, 9.0),
)
@example((0.0, 0.0, 0.0), (0.0, 0.0), 0.695)  # 0.2 deg below the view's upper end
def test_a_map_begins_above_the_view_where_plain_trigonometry_says(
    origin: tuple[float, float, float], lean: tuple[float, float], bottom_z: float
) -> None:
    view, reference = one_cell(0, Sight.CLEAR, map_bits=1 << 12, bottom_z=bottom_z, far=12, row=8)
    up = from_xyz_rpy(0, 0, 0, *lean, 0)[:3, 2]
    away = np.array([12.5 * CELL_SIZE, 8.5 * CELL_SIZE, np.float32(bottom_z)]) - origin
    elevation = np.arcsin(np.clip(away @ up / np.linalg.norm(away), -1.0, 1.0))
    assume(abs(elevation - np.radians(SENSOR.fov_top_deg)) > 1e-4)
    word = cell_words(view, reference, np.array(origin), SENSOR, up_map=up)[-1, -1]
    assert (word & BEGINS_ABOVE != 0) == (elevation > np.radians(SENSOR.fov_top_deg))


def test_case_5_read_literally_skips_cells_where_the_map_is_higher_than_the_scan() -> None:
    literal: dict[str, Any] = {"tall": True, "tall_rule": "height"}
    assert vote(*one_cell(0, Sight.CLEAR, map_bits=0b10), **literal)[0] == NO_VOTE
    assert vote(*one_cell(9, Sight.CLEAR, map_bits=0b110, hit=0b10), **literal)[0] == NO_VOTE
    assert vote(*one_cell(9, Sight.CLEAR, map_bits=0b110, hit=0b101), **literal)[0] == CellState.UNCHANGED_OCCUPIED


def test_bits_of_a_column() -> None:
    for word, span, below in ((0b0100_1000, 0b0111_1000, 0b0111_1111), (0, 0, 0), (1 << 63, 1 << 63, 2**64 - 1)):
        assert (span_of(np.uint64(word)), below_top(np.uint64(word))) == (span, below)


def test_an_occluded_scan_votes_undetermined_or_gives_no_vote() -> None:
    for map_bits in (0, 0b1110):
        hidden = one_cell(0, Sight.BEHIND, map_bits)
        assert vote(*hidden)[0] == CellState.UNDETERMINED
        assert vote(*hidden, occluded="abstains")[0] == NO_VOTE
    assert vote(*one_cell(9, Sight.BEHIND), occluded="abstains")[0] == CellState.CHANGED_OCCUPIED
    assert vote(*one_cell(2, Sight.BEHIND), occluded="abstains")[0] == CellState.UNDETERMINED, "it was seen, a little"


def test_below_n_min_a_cell_is_undetermined_or_empty_but_never_occupied() -> None:
    few = one_cell(4, Sight.CLEAR, 0b1110)
    assert vote(*few)[0] == CellState.UNDETERMINED
    assert vote(*few, few_points="empty")[0] == CellState.CHANGED_EMPTY
    assert vote(*few, few_points="empty", n_min=4)[0] == CellState.UNCHANGED_OCCUPIED


@given(
    st.sampled_from(["votes", "abstains"]),
    st.sampled_from(["undetermined", "empty"]),
    st.sampled_from(["occlude", "removed"]),
    st.sampled_from(["points", "cells", "farthest", "column"]),
    st.sampled_from(["bottom", "height"]),
    st.integers(1, 8),
    st.booleans(),
)
def test_under_every_reading_n_min_points_make_a_cell_occupied(
    occluded: Any, few_points: Any, movers: Any, sight: Any, tall_rule: Any, n_min: int, tall: bool
) -> None:
    paper = PaperSettings(
        occluded=occluded, few_points=few_points, movers=movers, line_of_sight=sight, tall_rule=tall_rule, n_min=n_min
    )
    states, weights = reading_table(VotingSettings(skip_tall_cells=tall), paper)
    n = np.arange(N_WORDS) & 15
    spoken = states != NO_VOTE
    assert np.array_equal(spoken[0], spoken[1]), "a scan speaks or does not, whatever the map holds"
    occupied = (states == CellState.UNCHANGED_OCCUPIED) | (states == CellState.CHANGED_OCCUPIED)
    assert np.array_equal(occupied[0], (n >= n_min) & spoken[0])
    assert not np.isin(states[0], (CellState.UNCHANGED_OCCUPIED, CellState.CHANGED_EMPTY)).any()
    assert not np.isin(states[1], (CellState.CHANGED_OCCUPIED, CellState.UNCHANGED_EMPTY)).any()
    assert weights[n < n_min].max() == VOTE_UNIT
    assert weights[n >= n_min].min() == 2 * VOTE_UNIT


@pytest.mark.parametrize("sight", ["points", "cells", "farthest", "column"])
def test_with_movers_removed_what_the_scan_without_them_saw_decides_as_the_scan_else_does(sight: Any) -> None:
    removed, _ = reading_table(VotingSettings(), PaperSettings(movers="removed", line_of_sight=sight))
    occlude, _ = reading_table(VotingSettings(), PaperSettings(movers="occlude", line_of_sight=sight))
    words, seen = np.arange(N_WORDS), sum(1 << k for k in range(4, 9))
    assert np.array_equal(removed, occlude[:, words & ~seen | (words >> WITHOUT_MOVERS & seen)])


def observed() -> tuple[PointMap, Observation]:
    """A scan of a street over two tiles: a wall of the map is struck eight times, and so is a new thing."""
    tiles = {(0, 0): make_tile(wall([(10, 250)], [0.75, 1.05])), (0, 1): make_tile(wall([], []), index=(0, 1))}
    point_map = make_map(tiles)
    origin = np.array([254.5, 20.5, 6.0]) * CELL_SIZE
    reference = reference_window(point_map, window_around(point_map.lattice, origin[0], origin[1], 24.0))
    heights = np.linspace(0.65, 1.15, 8)
    cells = np.array([[250.5, 10.5], [258.5, 10.5]]) * CELL_SIZE
    points = np.concatenate([np.column_stack([np.tile(cell, (8, 1)), heights]) for cell in cells])
    obstacle, cell = find_obstacles(points, reference)
    moving = np.zeros(len(points), dtype=np.bool_)
    view = cast_rays(rows_from(points, origin), origin, obstacle, moving, reference)
    up, covariance = np.array([0.0, 0.0, 1.0]), 1e-4 * np.eye(3)
    placed = PlacedScan(0, rows_from(points, origin), origin, up, covariance, reference, reference, obstacle, cell)
    return point_map, Observation(placed, moving, view, reference)


def test_a_drive_s_votes_are_the_sums_of_its_scans_tile_by_tile() -> None:
    point_map, seen = observed()
    voter = PaperVoter(VotingSettings(), PaperSettings(occluded="votes"), SENSOR, point_map)
    assert dict(voter.each()) == {}
    for _ in range(2):
        may_be_new = voter.observe(seen)
    votes = dict(voter.each())
    assert list(votes) == [(-1, 0), (-1, 1), (0, 0), (0, 1)], "and where it saw nothing it says so"
    left, right = votes[0, 0], votes[0, 1]
    twice = 2 * round(float(vote_weight(8)) * VOTE_UNIT)
    assert left.planes.tally is not None
    assert right.planes.tally is not None
    assert left.planes.states is not None
    assert right.planes.states is not None
    assert left.planes.tally[10, 250].tolist() == [twice, 0, 0, 0, 0]
    assert right.planes.tally[10, 2].tolist() == [0, 0, twice, 0, 0]
    assert left.planes.states[10, 250] == CellState.UNCHANGED_OCCUPIED
    assert right.planes.states[10, 2] == CellState.CHANGED_OCCUPIED
    assert np.argwhere(right.new).tolist() == [[10, 2]], "its points are new whatever their height"
    assert right.new[10, 2] == ~np.uint64(0)
    assert not left.new.any()
    assert np.count_nonzero(may_be_new) == 1
    assert (left.planes.gone, left.planes.free) == (None, None), "the paper's vote is of whole cells"


def test_scans_vote_only_in_a_square_around_the_vehicle() -> None:
    rows, cols = np.nonzero(votes_in(Grid(Lattice(), 0, 0, 100, 140), np.array([24.0, 9.0, 3.0]), 6.0))
    assert (rows.min(), cols.min()) == (20, 70)
    assert (rows.max(), cols.max()) == (40, 90), "cells that the square ends in"
    assert len(rows) == 21 * 21
    seen, asked = observed()[1], PaperSettings(window_m=6.0)
    words = sightings(seen, SENSOR, 5, asked)
    inside = votes_in(seen.view.grid, seen.scan.origin_map, asked.window_m)
    assert words[inside].any()
    assert not words[~inside].any()
    assert sightings(seen, SENSOR, 5)[~inside].any()


def test_a_sweep_reads_one_sentence_otherwise_at_a_time_in_every_way_that_can_be_set() -> None:
    base = PaperSettings()
    swept = readings_of(base)
    assert swept.pop("as set") == base
    assert swept["occluded votes"] == PaperSettings(occluded="votes")
    differs = [key for paper in swept.values() for key, value in paper if value != getattr(base, key)]
    assert len(differs) == len(swept)
    for setting, field in PaperSettings.model_fields.items():
        assert differs.count(setting) == (len(get_args(field.annotation)) or 3) - 1
    assert list(readings_of(base, "n_min")) == ["as set", "n_min 3", "n_min 8"]
