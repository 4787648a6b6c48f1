"""Answers of the program to an operator's everyday questions and mistakes."""

from __future__ import annotations

import json
import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import typed
from hand_made import Say, make_ballot, states_plane, two_walls
from made_courts import made_court
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.point_map import all_points
from mapvote.core.types import CellState, MapvoteError
from mapvote.formats import write_map, write_pcd
from mapvote.formats.drives.pose_files import write_trajectory
from mapvote.formats.drives.trajectory import read_poses, read_trajectory
from mapvote.formats.maps.cloud import Cloud
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import send


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """Two versions: two vehicles voted a wall away and another thing in, in the same tile."""
    path = tmp_path / "fleet.db"
    before = two_walls()
    cells = {(10, c): CellState.CHANGED_EMPTY for c in (10, 11, 12)}
    cells |= {(40, c): CellState.CHANGED_OCCUPIED for c in (40, 41)}
    new = np.array([[12.1 + 0.3 * k, 12.1, 0.2 + 0.3 * z] for k in range(2) for z in range(5)])
    with closing(Store.create(f"sqlite:///{path}", before)) as opened:
        ballots = [make_ballot(before, {(0, 0): Say(states_plane(cells), new_points=new)}, name) for name in ("a", "b")]
        send(opened, *ballots)
        publish(opened, override=True)
    return path


def test_a_replay_announces_the_points_that_go_and_those_that_come_and_not_their_difference(store: Path) -> None:
    with closing(Store.open(f"sqlite:///{store}")) as opened:
        old, new = (set(map(tuple, all_points(opened.point_map(number)).tolist())) for number in (1, 2))
    come, go = len(old - new), len(new - old)
    assert come
    assert go
    assert f"{come} points added, {go} deleted" in typed("unvote", store, "a", "--replay")


def test_changes_are_a_table_and_geojson_only_when_it_is_asked_for(store: Path, tmp_path: Path) -> None:
    said = typed("log", store, "--from", 1)
    assert "2 changes from version 1 to 2" in said
    assert "demolished" in said
    assert "{" not in said
    collection = json.loads(typed("log", store, "--from", 1, "--geojson"))
    assert len(collection["features"]) == 2
    typed("log", store, "--from", 1, "--out", tmp_path / "c.geojson")
    assert json.loads((tmp_path / "c.geojson").read_text()) == collection


@pytest.mark.parametrize(("x", "y"), [("-12.5", "3.0"), ("12.5", "-3.0"), ("-12.5", "-3"), ("-.5", "-1e1")])
def test_a_negative_coordinate_is_a_coordinate_and_no_option(store: Path, x: str, y: str) -> None:
    assert f"cell {np.floor(float(y) / 0.3):.0f}, {np.floor(float(x) / 0.3):.0f}:" in typed("explain", store, x, y)


def test_a_place_off_the_map_is_not_called_empty(store: Path) -> None:
    assert "outside the map" in typed("explain", store, "5000", "5000")
    assert "outside the map" not in typed("explain", store, "3.2", "3.1")


@pytest.mark.parametrize(
    ("words", "refusal"),
    [
        (("log", "STORE", "--from", 1, "--out", "d.txt"), "--out d.txt: its format is .geojson"),
        (("log", "STORE", "--from", 1, "--html", "d.txt"), "--html d.txt: its format is .html"),
        (("coverage", "STORE", "--out", "d.csv"), "--out d.csv: its format is .geojson"),
        (("diff", "a.pcd", "b.pcd", "--out", "d.txt"), "--out d.txt: its format is .geojson"),
        (("diff", "a.pcd", "b.pcd", "--csv", "d.txt"), "--csv d.txt: its format is .csv"),
        (("vote", "drive", "--map", "m", "--out", "b", "--poses", "p.txt"), "--poses p.txt: its format is .tum"),
        (("update", "m", "b", "--dry-run", "--cells", "c.txt"), "--cells c.txt: its format is .npz"),
        (("build", "d", "--out", "m", "--report", "c.doc"), "--report c.doc: its format is .png"),
        (("doctor", "d", "--png", "c.doc"), "--png c.doc: its format is .png"),
        (("rollback", "STORE", 7), "there is no version 7; the newest is 2$"),
        (("policy", "STORE", "fuse.min_votes=abc"), "fuse.min_votes = 'abc': give a whole number$"),
        (("policy", "STORE", "fuse.min_votes=0"), "give a value that is greater than or equal to 1$"),
        (("export", "m", "a.las", "--offset", "1,2"), "--offset 1,2: give three numbers"),
        (("export", "m", "a.las", "--offset", "1,nan,2"), "--offset 1,nan,2: give three numbers"),
        (("vote", "drive", "--map", "http://127.0.0.1:1", "--out", "b", "--region", "a,b"), "--region a,b: give X0,Y0"),
    ],
)
def test_a_refusal_says_in_plain_words_what_to_give(
    store: Path, words: tuple[object, ...], refusal: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MapvoteError, match=refusal) as caught:
        typed(*(store if word == "STORE" else word for word in words))
    assert "unable to parse" not in str(caught.value)
    assert "invalid literal" not in str(caught.value)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["fleet.db"]


def test_a_second_key_of_one_name_is_told_on_stderr_and_not_with_the_key(store: Path) -> None:
    assert len(typed("keys", store, "issue", "car_1").split()) == 1
    assert "car_1 had 1 valid key before" in typed("keys", store, "issue", "car_1")


def test_a_page_of_no_change_says_so_and_holds_no_empty_stage(store: Path, tmp_path: Path) -> None:
    typed("log", store, "--from", 2, "--html", tmp_path / "log.html")
    write_pcd(tmp_path / "a.pcd", Cloud(made_court(spacing_m=0.3)))
    typed("diff", tmp_path / "a.pcd", tmp_path / "a.pcd", "--html", tmp_path / "diff.html")
    for page in ("log.html", "diff.html"):
        text = (tmp_path / page).read_text()
        assert "there is no change to show" in text
        assert "<canvas" not in text
        assert "<script" not in text


def test_a_map_is_named_after_its_folder_and_its_content(tmp_path: Path) -> None:
    write_map(replace(two_walls(), map_id="0123456789abcdef"), tmp_path / "first")
    typed("export", tmp_path / "first", tmp_path / "city.pcd")
    said = typed("import", tmp_path / "city.pcd", tmp_path / "north side")
    assert re.search(r"map north_side-[0-9a-f]{8}\n", said)


def test_poses_are_written_for_trajectory_tools_and_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    T = [from_xyz_rpy(389_000.0 + k, 5_820_000.0, 34.0, *rng.uniform(-1.0, 1.0, 3)) for k in range(6)]
    stamps_ns = [1_700_000_000_123_456_789 + 100_000_000 * k for k in range(6)]
    assert write_trajectory(tmp_path / "all.kitti", stamps_ns, T, {2}) == 6
    np.testing.assert_allclose(read_poses(tmp_path / "all.kitti"), T, atol=1e-8)
    assert write_trajectory(tmp_path / "some.tum", stamps_ns, T, {2}) == 5
    read = read_trajectory(tmp_path / "some.tum")
    kept = [0, 1, 3, 4, 5]
    assert np.abs(read.times_ns - np.array(stamps_ns)[kept]).max() < 1000  # the reader takes seconds as float64
    np.testing.assert_allclose(read.T_map, np.array(T)[kept], atol=1e-6)
