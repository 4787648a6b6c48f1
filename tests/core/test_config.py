"""Settings: defaults, then a file, then the environment; what is misspelt is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from mapvote.config import Settings, choose_case, load_settings, load_with_sources
from mapvote.core.types import MapvoteError


def test_the_environment_wins_over_the_file_and_each_source_is_known(tmp_path: Path) -> None:
    file = tmp_path / "s.toml"
    file.write_text("[paper]\nn_min = 7\n[voting]\na = 1.5\n")
    settings, sources = load_with_sources(file, {"MAPVOTE_PAPER__N_MIN": "4", "MAPVOTE_KEY": "secret", "HOME": "/"})
    assert load_settings(env={}) == Settings()
    assert (settings.paper.n_min, settings.voting.a, settings.voting.b) == (4, 1.5, 3.0)
    assert sources == {"paper.n_min": "MAPVOTE_PAPER__N_MIN", "voting.a": str(file)}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[votting]\nn_min = 7\n", "unknown section 'votting'; did you mean 'voting'"),
        ("[paper]\nn_minn = 7\n", r"unknown setting paper\.n_minn; did you mean 'n_min'"),
        ("[paper]\nn_min = 'many'\n", r"paper\.n_min = 'many'"),
        ("[paper]\noccluded = 'perhaps'\n", r"paper\.occluded = 'perhaps'.*'votes' or 'abstains'"),
        ("n_min = 7\n", "outside a section"),
        ("[voting\n", "cannot be read"),
    ],
)
def test_a_file_that_cannot_be_meant_is_an_error(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "s.toml"
    file.write_text(text)
    with pytest.raises(MapvoteError, match=message):
        load_settings(file, {})


def test_a_misspelt_variable_is_an_error() -> None:
    with pytest.raises(MapvoteError, match="MAPVOTE_VOTING__NMIN: unknown setting"):
        load_settings(env={"MAPVOTE_VOTING__NMIN": "3"})


def test_the_paper_cases_by_number_and_ours_by_name() -> None:
    assert choose_case(Settings(), "surfaces").voting.method == "surfaces"
    second = choose_case(Settings(), "2").voting
    assert (second.method, second.weighted, second.two_stage, second.skip_tall_cells) == ("paper", False, True, False)
    with pytest.raises(MapvoteError, match="choose one of paper, surfaces, 1, 2, 3, 4, 5"):
        choose_case(Settings(), "6")
