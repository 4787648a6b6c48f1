"""The whole evaluation on the smallest street: from nothing to tables, twice the same, and once more from the cache."""

from __future__ import annotations

import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import asdict

from command_line import typed
from mapvote.config import Settings
from mapvote.core.types import MapvoteError
from mapvote.formats import read_map
from mapvote_lab.evaluation import tables
from mapvote_lab.evaluation.cases import choose_cases
from mapvote_lab.evaluation.evaluate import Evaluation, evaluate, running_server
from mapvote_lab.evaluation.scene import Scene
from mapvote_lab.evaluation.scores import EvaluationResult, to_json
from mapvote_lab.evaluation.tables import ReportSection, page

SLOWER = {"rate_hz": 4.0, "sensor": "vlp16"}
"""Fewer scans and beams than the paper has: a test asks whether it works, not how well."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def corner(cache: Path) -> Evaluation:
    settings = Settings()
    with pytest.MonkeyPatch.context() as here:
        here.setattr(os, "cpu_count", lambda: 1)  # the tests run side by side as it is: processes cost their start
        return evaluate(Scene("corner", 3, settings, cache, SLOWER), choose_cases(settings, "1,3,5,surfaces")[0])


def without_timings(result: EvaluationResult) -> str:
    return to_json({name: value for name, value in asdict(result).items() if name != "timings"})


def test_the_json_is_as_designed_and_never_nan(corner: Evaluation) -> None:
    result = json.loads(to_json(corner.result))
    assert result["cells"] == corner.truth.strict.size
    assert 0.0 < result["coverage"] <= 1.0
    for case in ("1", "3", "5", "surfaces"):
        entry = result["cases"][case]
        assert len(entry["bytes_per_vehicle"]) == 3
        for truth in ("strict", "provenance"):
            for metric in ("precision", "recall", "f1"):
                values = entry[truth][metric]
                assert set(values) == {"unchanged", "changed_occupied", "changed_empty"}
                assert all(math.isfinite(v) and 0 <= v <= 1 for v in values.values())
            assert entry[truth]["macro_f1"] == pytest.approx(np.mean(list(entry[truth]["f1"].values())))


def test_a_second_run_comes_from_the_cache_and_says_the_same(corner: Evaluation, cache: Path) -> None:
    stages: list[str] = []
    again = evaluate(
        corner.scene, choose_cases(Settings(), "1,3,5,surfaces")[0], progress=lambda s, *_: stages.append(s)
    )
    assert without_timings(again.result) == without_timings(corner.result)
    assert not {"simulating", "mapping"} & set(stages)


def test_one_stage_costs_more_bytes_than_two_and_surfaces_find_what_changed(corner: Evaluation) -> None:
    cases = corner.result.cases
    assert min(cases["3"].state_bytes_per_vehicle or [0]) > 5 * max(cases["1"].state_bytes_per_vehicle or [0]) > 0
    surfaces = cases["surfaces"]
    assert all(surfaces.objects.found)
    assert surfaces.map is not None
    assert surfaces.map.stale_deleted > 0.5
    assert surfaces.map.valid_deleted < 0.01


def test_tables_show_every_case_and_the_papers_figures(corner: Evaluation) -> None:
    text = tables.as_text(corner.result)
    for shown in ("Table II", "Table III", "Table IV", "case 5", "surfaces", "0.850", "0.645", "Purpose of the map"):
        assert shown in text


def test_a_misspelt_case_is_named() -> None:
    with pytest.raises(MapvoteError, match="no case 'colums'"):
        choose_cases(Settings(), "1,colums")
    with pytest.raises(MapvoteError, match="beside a vote"):
        choose_cases(Settings(), "yardsticks")


def of_elsewhere(html: str) -> list[str]:
    """Files that a page would load; the scripts inside it may name addresses."""
    return re.findall(r"""(?:\b(?:src|href)\s*=|\bfrom|\bimport\(|\bfetch\(|url\()\s*["']?https?://[^"')\s]*""", html)


def test_the_page_needs_nothing_else_and_escapes_what_it_is_given() -> None:
    html = page("A <b> title", "lead & more", [("3", "facts")], [ReportSection("One", ["<script>alert(1)</script>"])])
    assert "<script" not in html
    assert "A &lt;b&gt; title" in html
    assert "http://" not in html
    assert of_elsewhere(html) == []


@pytest.mark.slow
def test_the_demo_tells_its_story(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from html import escape

    from mapvote_lab.evaluation import demo

    told: list[tuple[Evaluation, demo.Story]] = []
    run = demo.demo

    def watched(*words: Any, **options: Any) -> tuple[Evaluation, demo.Story]:
        told.append(run(*words, **options))
        return told[-1]

    monkeypatch.setattr(demo, "demo", watched)
    monkeypatch.chdir(tmp_path)
    said = typed("demo").splitlines()
    evaluation, story = told[0]
    assert said.index("first picture: out/pictures/scans.png") < said.index("What changed") < said.index("Next steps")
    assert not (tmp_path / "out" / "work").exists()
    assert story.drives_bytes > sum(file.stat().st_size for file in (tmp_path / "out").rglob("*") if file.is_file())
    assert all(story.objects.found)
    assert story.objects.found
    for name in ("report.html", "tables.txt", "results.json", "map_before.pcd", "map_after.pcd"):
        assert (tmp_path / "out" / name).stat().st_size > 100
    html = (tmp_path / "out" / "report.html").read_text()
    assert "Beside the paper&#x27;s own table" in html
    assert evaluation.result.settings["paper"]["occluded"] == "abstains"
    assert all(escape(sentence) in html for sentence in demo.WHY_HARDER)
    assert len(html) < 12_000_000
    assert "Table IV: F1, mean of the three classes" in html
    assert html.count("data:image/png;base64,") == len(list((tmp_path / "out" / "pictures").glob("*.png")))
    assert of_elsewhere(html) == []
    assert evaluation.result.poses == "ndt"


@pytest.mark.slow
def test_a_recorded_street_is_mapped_and_voted_on_by_the_same_drive(tmp_path: Path) -> None:
    from mapvote_lab.evaluation.demo import demo_drive

    drive = Path("../shared/data/kitti/2011_09_26_0001")
    if not drive.exists():
        pytest.skip("needs the KITTI drive of ../shared/data")
    shown: list[Path] = []
    lines = demo_drive(drive, tmp_path / "out", lambda *_: None, shown.append)
    assert shown == [tmp_path / "out" / "pictures" / "scan.png"]
    found, of = map(int, re.findall(r"new bodies.*: (\d+) of (\d+)", lines[0])[0])
    assert 2 * found > of > 6, "most of what was cast into the scans is found"
    html = (tmp_path / "out" / "report.html").read_text()
    assert html.count("data:image/png;base64,") == 3
    assert read_map(tmp_path / "out" / "map").n_points > 10_000


@pytest.mark.slow
def test_a_server_that_cannot_start_says_why(tmp_path: Path) -> None:
    with (
        pytest.raises(MapvoteError, match="did not start"),
        running_server(tmp_path / "s.db", tmp_path / "no map", tmp_path / "log"),
    ):
        pass
