"""What strikes or clears a mapped voxel by columns_v1 (rules A, B and I)."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.grid import Lattice
from mapvote.detection.evidence import PLANES, Evidence, count_of
from mapvote.perception.raycast import Sight
from mapvote_lab.evaluation.columns_v1.counters import STRUCK_ITSELF, THROUGH_ITSELF, ColumnEvidence
from small_window import AT, NOTHING, middle, reference_of, view_of, words


def test_a_hit_next_to_a_mapped_voxel_strikes_it_and_vetoes_the_rays_that_grazed_past() -> None:
    hit = NOTHING.copy()
    hit[3, 3] = 0b1000  # one cell and one layer off
    for veto, counts in ((True, (0, 1)), (False, (1, 0))):
        evidence = ColumnEvidence(Lattice(), veto=veto)
        evidence.count(view_of(hit, middle(0b100)), reference_of(middle(0b100)))
        cell = evidence.tiles[(0, 0)][AT]
        assert (count_of(cell, 0, 2), count_of(cell, PLANES, 2)) == counts


def test_a_hit_two_cells_away_counts_only_for_an_uncertain_pose() -> None:
    hit = NOTHING.copy()
    hit[2, 4] = 0b100
    for reach, counts in ((1, (1, 0)), (2, (0, 1))):
        evidence = ColumnEvidence(Lattice())
        evidence.count(view_of(hit, middle(0b100)), reference_of(middle(0b100)), reach)
        cell = evidence.tiles[(0, 0)][AT]
        assert (count_of(cell, 0, 2), count_of(cell, PLANES, 2)) == counts


def test_a_mapped_voxel_also_keeps_what_befell_it_alone() -> None:
    hit = NOTHING.copy()
    hit[3, 3] = 0b100
    evidence = ColumnEvidence(Lattice())
    evidence.count(view_of(hit, middle(0b110)), reference_of(middle(0b1100)))
    cell = evidence.tiles[(0, 0)][AT]
    assert (cell[STRUCK_ITSELF], cell[THROUGH_ITSELF]) == (0, 0b100), "the hit lies next to it, the ray went through it"
    evidence.count(view_of(middle(0b1100), middle(0b100)), reference_of(middle(0b1100)))
    assert (cell[STRUCK_ITSELF], cell[THROUGH_ITSELF]) == (0b1100, 0b100)


def test_a_mapped_voxel_within_the_error_of_a_hit_beside_it_was_struck_itself() -> None:
    hit = NOTHING.copy()
    hit[3, 3] = 0b100
    evidence = ColumnEvidence(Lattice())
    evidence.count(view_of(hit, middle(0b100)), reference_of(middle(0b100)), touched=middle(0b110))
    assert evidence.tiles[(0, 0)][AT][STRUCK_ITSELF] == 0b100


def test_a_scan_that_is_unsure_of_its_pose_says_of_no_single_voxel_that_a_ray_went_through() -> None:
    evidence = ColumnEvidence(Lattice())
    evidence.count(view_of(NOTHING, middle(0b100)), reference_of(middle(0b100)), 2)
    assert evidence.tiles[(0, 0)][AT][THROUGH_ITSELF] == 0


def test_without_rule_a_a_visible_cell_is_seen_through_whole() -> None:
    for by_ray, count in ((True, 0), (False, 1)):
        evidence = ColumnEvidence(Lattice(), by_ray=by_ray)
        evidence.count(view_of(NOTHING, middle(0b1), Sight.BEHIND), reference_of(middle(0b100)))
        assert count_of(evidence.tiles[(0, 0)][AT], 0, 2) == count


@given(st.lists(st.tuples(words, words, words), min_size=1, max_size=12))
@settings(max_examples=30, deadline=None)
def test_with_all_its_rules_it_counts_as_a_survey_does(scans: list[tuple[np.ndarray, ...]]) -> None:
    columns, survey = ColumnEvidence(Lattice()), Evidence(Lattice())
    for hit, passed, occupied in scans:
        columns.count(view_of(hit, passed), reference_of(occupied))
        survey.count(view_of(hit, passed), reference_of(occupied))
    np.testing.assert_array_equal(columns.tiles[(0, 0)][..., : 2 * PLANES], survey.tiles[(0, 0)])
