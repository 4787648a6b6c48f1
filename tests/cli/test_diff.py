"""The verbs of whole clouds, as a user calls them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from command_line import typed
from made_courts import CARS, made_court
from mapvote.codec.ballot import decode
from mapvote.core.geometry import from_xyz_rpy, transform
from mapvote.core.types import MapvoteError
from mapvote.formats import write_pcd
from mapvote.formats.maps.cloud import Cloud


def test_diff_says_where_b_lies_how_it_decided_and_what_left(tmp_path: Path) -> None:
    moved = transform(from_xyz_rpy(80.0, -20.0, 3.0, yaw=1.0), made_court(CARS[1:], seed=2))
    write_pcd(tmp_path / "a.pcd", Cloud(made_court()))
    write_pcd(tmp_path / "b.pcd", Cloud(moved))
    files = ["--out", str(tmp_path / "d.geojson"), "--csv", str(tmp_path / "d.csv"), "--html", str(tmp_path / "d.html")]
    said = typed("diff", tmp_path / "a.pcd", tmp_path / "b.pcd", *files)
    assert all(told in said for told in ("turned by -57.", "by geometry alone", "gone: 1 things"))
    assert [f["properties"]["kind"] for f in json.loads((tmp_path / "d.geojson").read_text())["features"]] == ["gone"]
    assert (tmp_path / "d.csv").read_text().startswith("id,kind,")
    assert "<canvas" in (tmp_path / "d.html").read_text()


@pytest.mark.slow
def test_a_map_without_ground_cannot_be_compared_and_says_so(tmp_path: Path) -> None:
    court = made_court()
    above = court[court[:, 2] - 0.01 * court[:, 0] - 0.005 * court[:, 1] > 0.4]
    write_pcd(tmp_path / "a.pcd", Cloud(np.concatenate([above, above + 0.05])))
    write_pcd(tmp_path / "b.pcd", Cloud(court))
    with pytest.raises(MapvoteError, match="no ground"):
        typed("diff", tmp_path / "a.pcd", tmp_path / "b.pcd")


@pytest.mark.slow
def test_a_cloud_votes_by_its_file_and_says_that_no_free_space_is_learned(tmp_path: Path) -> None:
    write_pcd(tmp_path / "map.pcd", Cloud(made_court()))
    write_pcd(tmp_path / "robot.pcd", Cloud(made_court(CARS[1:], seed=2)))
    ballot = tmp_path / "robot.ballot"
    said = typed("vote", tmp_path / "robot.pcd", "--map", tmp_path / "map.pcd", "--out", ballot)
    assert "no free space is learned" in said
    assert decode(ballot.read_bytes()).vehicle == "robot"
