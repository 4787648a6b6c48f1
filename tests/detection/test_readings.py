"""The paper's open sentences are data: each is a setting, and each reading is one that the setting takes."""

from __future__ import annotations

from typing import Literal, get_args, get_origin

import pytest

from mapvote.config import PaperSettings
from mapvote.detection.paper import OPEN_SENTENCES, OpenSentence, readings_of


def test_every_setting_of_the_paper_has_its_sentence() -> None:
    assert [sentence.setting for sentence in OPEN_SENTENCES] == list(PaperSettings.model_fields)


@pytest.mark.parametrize("sentence", OPEN_SENTENCES, ids=lambda sentence: sentence.setting)
def test_a_sentence_is_quoted_and_its_readings_are_those_that_can_be_set(sentence: OpenSentence) -> None:
    assert len(sentence.quotation) > 40
    field = PaperSettings.model_fields[sentence.setting]
    assert field.default in sentence.readings
    if get_origin(field.annotation) is Literal:
        assert set(sentence.readings) == set(get_args(field.annotation))
    for value in sentence.readings:
        assert getattr(PaperSettings.model_validate({sentence.setting: value}), sentence.setting) == value


def test_a_sweep_reads_one_sentence_otherwise_at_a_time() -> None:
    base = PaperSettings()
    swept = readings_of(base)
    assert swept["as set"] == base
    assert swept["occluded votes"] == PaperSettings(occluded="votes")
    assert len(swept) == 1 + sum(len(s.readings) - 1 for s in OPEN_SENTENCES)
    for name, paper in swept.items():
        differs = [key for key in PaperSettings.model_fields if getattr(paper, key) != getattr(base, key)]
        assert len(differs) == (0 if name == "as set" else 1)
