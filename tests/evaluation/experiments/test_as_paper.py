"""On the paper's street the paper is read, and its map is made, as the paper says, unless the user says otherwise."""

from __future__ import annotations

import pytest

from mapvote.config import Settings
from mapvote.core.types import MapvoteError
from mapvote_lab.evaluation.experiments.cases import as_paper


def test_an_occluded_scan_abstains_by_default_and_the_map_of_the_papers_street_keeps_whatever_stood_still() -> None:
    settings = as_paper(Settings(), "as_published")
    assert settings.paper.occluded == "abstains"
    assert not settings.mapping.drop_strays


def test_on_every_other_street_the_settings_stay_as_they_are() -> None:
    assert as_paper(Settings(), "street570") == Settings()
    assert as_paper(Settings(), "street570", reading="n_min=3").paper.n_min == 3


def test_what_the_user_set_stays() -> None:
    told = as_paper(Settings(), "as_published", ["paper.n_min", "mapping.drop_strays", "fuse.min_votes"])
    assert told == Settings()
    read = as_paper(Settings(), "as_published", ["paper.n_min"], "occluded=votes")
    assert read.paper.occluded == "votes"


def test_a_reading_there_is_not_is_refused() -> None:
    with pytest.raises(MapvoteError, match="occluded=abstains"):
        as_paper(Settings(), "as_published", reading="hidden=no")
