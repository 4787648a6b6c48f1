"""Readings swept and cells explained on the smallest street: a look-up decides as the vote did, and all is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.config import Settings
from mapvote.core.types import MapvoteError
from mapvote.detection.readings import OPEN_SENTENCES, read
from mapvote.plots import save
from mapvote_lab.evaluation.evaluate import Evaluation, evaluate
from mapvote_lab.evaluation.experiments.cases import choose_cases, paper_cases
from mapvote_lab.evaluation.experiments.kept import read_kept
from mapvote_lab.evaluation.experiments.passes import pass_folder
from mapvote_lab.evaluation.experiments.scene import Scene
from mapvote_lab.evaluation.experiments.study import Study
from mapvote_lab.evaluation.experiments.sweep import decided
from mapvote_lab.evaluation.reporting.budget_figure import budget_figure
from mapvote_lab.evaluation.reporting.tables import as_json, as_text
from mapvote_lab.evaluation.scoring.budget import Budget
from mapvote_lab.evaluation.scoring.cells import UNSCORED, confusion
from mapvote_lab.evaluation.scoring.jury import Jury

pytestmark = pytest.mark.slow

CASES = "1,2,3,4,5,1 column"
SLOWER = {"rate_hz": 4.0}
FIELDS = ("true_changed_occupied", "true_changed_empty", "false_changed_occupied", "false_changed_empty")


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    settings = Settings()
    settings = settings.model_copy(update={"paper": read(settings.paper, "occluded=abstains")})
    scene = Scene("corner", 3, settings, tmp_path_factory.mktemp("cache"), SLOWER)
    return evaluate(scene, choose_cases(settings, CASES)[0], study=Study(readings=True, explained=("1", "3", "5")))


def test_a_reading_looked_up_decides_every_cell_as_the_vote_did(studied: Evaluation) -> None:
    scene, settings = studied.scene, studied.scene.settings
    cases = choose_cases(settings, CASES)[0]
    jury = Jury(studied.first_map, studied.truth)
    kept = [read_kept(pass_folder(scene, cases, name, True), jury.window) for name in scene.drive_names("v")]
    for name, (server, own) in decided(kept, jury.first_map.counts > 0, cases).items():
        np.testing.assert_array_equal(server, studied.outcomes[name].states, err_msg=f"case {name}")
        for mine, voted in zip(own, studied.outcomes[name].vehicle_states, strict=True):
            np.testing.assert_array_equal(mine, voted, err_msg=f"a vehicle's own, case {name}")


def test_the_sweep_holds_what_the_tables_hold_and_every_other_reading(studied: Evaluation) -> None:
    swept = studied.result.readings
    assert len(swept) == 1 + sum(len(sentence.readings) - 1 for sentence in OPEN_SENTENCES)
    for number in paper_cases(studied.scene.settings):
        if number in "12345":
            assert swept["as set"][number]["strict"] == studied.result.cases[number].strict
    assert swept["line_of_sight column"]["1"]["strict"] == studied.result.cases["1 column"].strict
    assert swept["occluded votes"]["1"] != swept["as set"]["1"]


@pytest.mark.parametrize("case", ["1", "3", "5"])
def test_a_budget_holds_every_true_and_every_false_cell_and_adds_up_to_100(studied: Evaluation, case: str) -> None:
    for truth_name, found in studied.result.budgets[case].items():
        truth = Jury(studied.first_map, studied.truth).truths[truth_name]
        table = confusion(studied.outcomes[case].states, truth)
        cells = {name: sum(share.cells for share in getattr(found, name).values()) for name in FIELDS}
        assert [cells[name] for name in FIELDS] == [
            table[1].sum(), table[2].sum(), table[[0, 2], 1].sum(), table[[0, 1], 2].sum()
        ]  # fmt: skip
        assert found.true_changed_occupied["found"].cells == table[1, 1]
        assert found.true_changed_empty["found"].cells == table[2, 2]
        assert table.sum() == np.count_nonzero(truth != UNSCORED)
        for name in FIELDS:
            percent = sum(round(10 * share.percent) for share in getattr(found, name).values())
            assert percent == (1000 if cells[name] else 0)


def test_invalid_cells_are_a_cause_in_case_5_only(studied: Evaluation) -> None:
    def invalid(found: Budget) -> int:
        shares = {**found.true_changed_occupied, **found.true_changed_empty}
        return sum(share.cells for cause, share in shares.items() if cause.startswith("invalid"))

    assert all(invalid(found) == 0 for found in studied.result.budgets["1"].values())


def test_the_study_is_told_in_tables_numbers_and_a_picture(studied: Evaluation, tmp_path: Path) -> None:
    text = as_text(studied.result)
    for told in ("Readings of the paper", "occluded votes", "falsely called changed (empty)", "100.0", "above 4 m"):
        assert told in text
    assert '"budgets"' in as_json(studied.result)
    save(budget_figure("1", studied.causes["1"], studied.window), tmp_path / "explained.png")
    assert (tmp_path / "explained.png").stat().st_size > 10_000


def test_only_the_papers_cases_that_voted_can_be_explained(studied: Evaluation) -> None:
    cases = choose_cases(studied.scene.settings, CASES)[0]
    with pytest.raises(MapvoteError, match="'surfaces' cannot be explained"):
        evaluate(studied.scene, cases, study=Study(explained=("surfaces",)))
