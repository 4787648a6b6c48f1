"""The matrix end to end on the smallest street, and its arithmetic by hand."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from mapvote.config import Settings
from mapvote_lab.evaluation.experiments.attacks import ATTACKS
from mapvote_lab.evaluation.experiments.matrix import EXPERIMENTS, Matrix
from mapvote_lab.evaluation.reporting.matrix_tables import FIGURES, Spread, class_table, spread, table
from mapvote_lab.evaluation.results import CaseResult, MapShift, MatrixResult, RoundResult, to_json
from mapvote_lab.evaluation.scoring.cells import ByClass, Scores
from mapvote_lab.evaluation.scoring.map_points import MapScores
from mapvote_lab.evaluation.scoring.objects import ObjectScores


def scores(macro: float) -> Scores:
    of_each = ByClass(macro, macro, macro)
    return Scores(of_each, of_each, of_each, macro, macro)


def entry(macro: float, valid: float = 0.0) -> RoundResult:
    return RoundResult(
        strict=scores(macro), provenance=scores(macro), coverage=0.9,
        also={"border": scores(macro), "border, provenance": scores(macro)},
        objects=ObjectScores((True, False), (True, True), (0.6, 0.1), (2.5, 1.5)),
        map=MapScores(
            stale_deleted=1.0, stale_apart_deleted=1.0, valid_deleted=valid, new_added=1.0, added_false=0.0,
            stale_points=1, valid_points=1, new_samples=1, added_points=1,
        ),
        strict_old_unchanged=scores(macro), provenance_old_unchanged=scores(macro), determined=0.9,
    )  # fmt: skip


def of_rounds(**rounds: RoundResult) -> MatrixResult:
    shift = MapShift(0.0, 0.0, 0.0, 0.0, 0.0)
    return MatrixResult(
        scenario="corner", seed=1, cells=1, map_shift=shift, localisation={}, ceilings={"strict": scores(0.97)},
        rounds=rounds,
    )  # fmt: skip


def test_a_result_is_the_same_after_it_was_written_and_read() -> None:
    result = of_rounds(a=entry(0.9, 0.25))
    text = to_json(result)
    assert msgspec.json.decode(text, type=MatrixResult) == result
    assert json.loads(text)["rounds"]["a"]["map"]["valid_deleted"] == 0.25
    yardstick = CaseResult(
        strict=scores(0.5), provenance=scores(0.5), coverage=1.0, objects=entry(0.5).objects, bytes_per_vehicle=[]
    )
    assert not {"map", "state_bytes_per_vehicle"} & set(json.loads(to_json(yardstick)))
    with pytest.raises(ValueError, match="not JSON compliant"):
        to_json(of_rounds(a=entry(float("nan"))))


def test_the_worst_is_the_lowest_of_a_merit_and_the_highest_of_a_harm() -> None:
    assert spread([0.5, 0.75, 1.0]) == Spread(0.75, 0.25, 0.5, 3)
    assert spread([0.8, 0.9, 1.0], more_is_better=False).worst == 1.0
    assert spread([0.5]).deviation == 0.0


def test_objects_are_counted_in_halves_found_and_above_two_square_metres() -> None:
    assert FIGURES["found"].of(entry(1.0)) == 0.5
    assert FIGURES["false_objects"].of(entry(1.0)) == 1.0


def test_the_table_has_a_line_a_round_and_a_cell_a_figure() -> None:
    lines = (
        table({"main": {2: of_rounds(a=entry(0.5)), 3: of_rounds(a=entry(0.7))}}, "main")
        .to_markdown(with_title=False)
        .splitlines()
    )
    assert len(lines) == 3
    assert lines[2].startswith("| a | 0.600 ± 0.141 (0.500) |")
    assert {line.count("|") for line in lines} == {len(FIGURES) + 2}


def test_precision_and_recall_are_means_over_the_seeds_class_by_class() -> None:
    text = class_table({"main": {2: of_rounds(a=entry(0.5)), 3: of_rounds(a=entry(1.0))}}, "main").to_markdown()
    assert "| a | 0.7500 / 0.7500 | 0.750 / 0.750 | 0.750 / 0.750 |" in text


@pytest.mark.slow
def test_the_whole_machinery_on_a_corner_twice_and_without_the_drives(tmp_path: Path) -> None:
    """Every kind of experiment runs, a second run repeats the numbers from the cache, and scans can be dropped."""
    names = ["main", "liars", "noise", "2 Hz", "parked", "all true"]
    matrix = Matrix("corner", (1,), tmp_path, Settings(), workers=1, parked=2)
    results = {name: {seed: result} for name, seed, result in matrix.run_all(names)}
    main = results["main"][1].rounds
    assert main["surfaces"].provenance.macro_f1 > main["1 column"].provenance.macro_f1
    assert {f"surfaces, 1 of 3 {name}" for name in ATTACKS} <= set(results["liars"][1].rounds)
    scene = matrix.scene(EXPERIMENTS["main"], 1)
    matrix.drop_drives(names, 1)
    assert not list(scene.folder.glob("*/velodyne"))
    before = results["main"][1]
    matrix.result_file("main", 1).unlink()
    assert matrix.run("main", 1) == before
    assert not list(scene.folder.glob("*/velodyne"))  # the ballots were enough
