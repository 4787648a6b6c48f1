"""The doctor names what is wrong with a file of points, and its mend, obeyed, makes it sound."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from faults import MAP_FILES, Bytes, serious, sound_street, verdict
from mapvote.doctor.maps import examine_map
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import write_las
from mapvote.formats.maps.pcd import write_pcd
from mapvote.formats.maps.ply import write_ply

WRITERS = {".las": write_las, ".laz": write_las, ".ply": write_ply, ".pcd": write_pcd}


def street(n: int = 4000) -> Cloud:
    points = sound_street((0, 30), (-12, 12), 30, (4, 10), longest=6)
    return Cloud(points[np.random.default_rng(0).permutation(len(points))[:n]])


@pytest.mark.parametrize(("name", "suffix", "right", "change", "mend"), MAP_FILES, ids=[one[0] for one in MAP_FILES])
def test_a_broken_file_is_named_and_sound_once_it_is_mended(
    tmp_path: Path, name: str, suffix: str, right: str, change: Bytes, mend: Bytes
) -> None:
    file = tmp_path / f"a{suffix}"
    WRITERS[suffix](file, street())
    whole = file.read_bytes()
    file.write_bytes(change(whole))
    assert file.read_bytes() != whole, name
    assert verdict([right], examine_map(file)[0]) == "right"
    file.write_bytes(mend(file.read_bytes()))
    assert file.read_bytes() == whole
    findings, point_map = examine_map(file)
    assert not any(finding.severity == "error" for finding in findings)
    assert point_map is not None
    assert point_map.n_points == 4000


def test_the_doctor_counts_marked_points_as_a_note(tmp_path: Path) -> None:
    cloud = street()
    flags = np.where(np.arange(4000) < 300, 4, 0).astype(np.uint8)
    write_las(tmp_path / "a.las", Cloud(cloud.points, fields={"las_flags": flags}))
    findings, point_map = examine_map(tmp_path / "a.las")
    assert [f.what for f in findings if "withheld" in f.what] == ["dropped: 300 points that the file marks as withheld"]
    assert not [what for what in serious(findings) if "withheld" in what]
    assert point_map is not None
    assert point_map.n_points == 3700
