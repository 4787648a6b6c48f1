"""Readings swept on the smallest street: a look-up decides as the vote did."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.config import Settings
from mapvote.rules.paper import read, readings_of
from mapvote_lab.evaluation.cases import choose_cases, decided, paper_cases, read_kept
from mapvote_lab.evaluation.evaluate import Evaluation, evaluate
from mapvote_lab.evaluation.scene import Scene, pass_folder
from mapvote_lab.evaluation.tables import as_text
from mapvote_lab.evaluation.truths import Jury

pytestmark = pytest.mark.slow

CASES = "1,2,3,4,5,1 column"
SLOWER = {"rate_hz": 4.0}


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    settings = Settings()
    settings = settings.model_copy(update={"paper": read(settings.paper, "occluded=abstains")})
    scene = Scene("corner", 3, settings, tmp_path_factory.mktemp("cache"), SLOWER)
    return evaluate(scene, choose_cases(settings, CASES)[0], readings="all")


def test_a_reading_looked_up_decides_every_cell_as_the_vote_did(studied: Evaluation) -> None:
    scene, settings = studied.scene, studied.scene.settings
    cases = choose_cases(settings, CASES)[0]
    jury = Jury(studied.first_map, studied.truth)
    kept = [read_kept(pass_folder(scene, cases, name, True)) for name in scene.drive_names("v")]
    for name, (server, own) in decided(kept, jury.first_map.counts > 0, cases).items():
        np.testing.assert_array_equal(server, studied.outcomes[name].states, err_msg=f"case {name}")
        for mine, voted in zip(own, studied.outcomes[name].vehicle_states, strict=True):
            np.testing.assert_array_equal(mine, voted, err_msg=f"a vehicle's own, case {name}")


def test_the_sweep_holds_what_the_tables_hold_and_every_other_reading(studied: Evaluation) -> None:
    swept = studied.result.readings
    assert list(swept) == list(readings_of(studied.scene.settings.paper))
    for number in paper_cases(studied.scene.settings):
        if number in "12345":
            assert swept["as set"][number]["strict"] == studied.result.cases[number].strict
    assert swept["line_of_sight column"]["1"]["strict"] == studied.result.cases["1 column"].strict
    assert swept["occluded votes"]["1"] != swept["as set"]["1"]


def test_readings_are_shown_in_the_tables(studied: Evaluation) -> None:
    text = as_text(studied.result)
    for shown in ("Readings of the paper", "occluded votes"):
        assert shown in text
