"""info, doctor, import, export and config, as a user types them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial import cKDTree

from command_line import typed
from faults import sound_street
from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import encode
from mapvote.core.point_map import all_points, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, CellState, MapvoteError
from mapvote.formats import DriveWriter, read_map, write_map, write_pcd
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import write_las
from stores import NewStore


def cloud() -> F64:
    return np.random.default_rng(1).uniform([-50, -50, 0], [50, 50, 5], (4000, 3))


def test_import_then_info_then_export_keeps_every_point(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", Cloud(cloud()))
    assert "4000 points in 4 tiles" in typed("import", tmp_path / "a.pcd", tmp_path / "m")
    told = typed("info", tmp_path / "m")
    assert "mapvote map" in told
    assert "never learned" in told, "free space"
    assert "4,000" in told
    for name in ("b.pcd", "b.las", "b.ply", "autoware"):
        told = typed("export", tmp_path / "m", tmp_path / name)
        assert "4000 points" in told
        assert "dropped: ground heights" in told
        away, partner = cKDTree(all_points(read_map(tmp_path / name))).query(all_points(read_map(tmp_path / "m")))
        assert away.max() < 1e-4
        assert len(set(partner.tolist())) == 4000
        assert "4,000" in typed("info", tmp_path / name)
    with pytest.raises(MapvoteError, match="three numbers"):
        typed("export", tmp_path / "m", tmp_path / "c.pcd", "--offset", "1,2")
    typed("export", tmp_path / "m", tmp_path / "c.ply", "--offset", "100,0,0")
    assert all_points(read_map(tmp_path / "c.ply"))[:, 0].max() < 0


def test_points_that_a_guess_refuses_are_imported_unchecked_and_then_taken_by_every_verb(tmp_path: Path) -> None:
    """A street hanging from a ceiling, half of whose points are not finite."""
    points = sound_street((0, 100), (-25, 25), 50, (8, 22), longest=10, slope=0.01) * [1, -1, -1]
    write_pcd(tmp_path / "a.pcd", Cloud(points))
    with pytest.raises(MapvoteError, match=r"upside down.* mapvote import '.*a\.pcd' MAP --unchecked"):
        typed("import", tmp_path / "a.pcd", tmp_path / "m")
    with pytest.raises(MapvoteError, match="--unchecked"):
        typed("export", tmp_path / "a.pcd", tmp_path / "a.ply")
    assert "upside down" in typed("import", tmp_path / "a.pcd", tmp_path / "m", "--unchecked")
    assert f"{len(points)} points" in typed("export", tmp_path / "m", tmp_path / "a.ply")
    write_map(map_from_points(points), tmp_path / "by hand")
    with pytest.raises(MapvoteError, match="--unchecked"):
        typed("export", tmp_path / "by hand", tmp_path / "b.ply")
    typed("import", tmp_path / "by hand", tmp_path / "taken", "--unchecked")
    typed("export", tmp_path / "taken", tmp_path / "b.ply")
    points[::2] = np.nan
    write_pcd(tmp_path / "b.pcd", Cloud(points))
    with pytest.raises(MapvoteError, match=r"not finite or no coordinates, more than 5%.* --unchecked"):
        typed("import", tmp_path / "b.pcd", tmp_path / "n")
    typed("import", tmp_path / "b.pcd", tmp_path / "n", "--unchecked")


def test_marks_of_points_are_dropped_as_asked(tmp_path: Path) -> None:
    flags = np.where(np.arange(4000) < 500, 4, 8).astype(np.uint8)
    write_las(tmp_path / "a.las", Cloud(cloud(), fields={"las_flags": flags}))
    told = typed("import", tmp_path / "a.las", tmp_path / "m")
    assert "3500 points" in told
    assert "dropped: 500 points that the file marks as withheld" in told
    assert "kept: 3500 points that the file marks as overlap" in told
    assert "4000 points" in typed("import", tmp_path / "a.las", tmp_path / "n", "--drop", "none")
    assert "500 points" in typed("import", tmp_path / "a.las", tmp_path / "o", "--drop", "overlap")
    with pytest.raises(MapvoteError, match="'walls' is no mark of points"):
        typed("import", tmp_path / "a.las", tmp_path / "p", "--drop", "walls")


def test_info_of_a_drive_and_doctor(tmp_path: Path) -> None:
    writer = DriveWriter(tmp_path / "d", "car-7", SENSORS["vlp16"], start_ns=10**18).open()
    for i in range(4):
        writer.write_scan(i, cloud().astype(np.float32))
    writer.close(10**18 + np.arange(4) * 10**8)
    told = typed("info", tmp_path / "d")
    for word in ("car-7", "vlp16, 16 beams, 10 Hz", "4 in 0.3 s", "prior       │ none"):
        assert word in told
    told = typed("doctor", tmp_path / "d", code=1)
    assert "no prior" in told
    assert "scan 1 is the same as the one before it (3 such scans of 4)" in told
    with pytest.raises(MapvoteError, match=r"z is never negative.* Check --columns"):
        typed("build", tmp_path / "d", "--out", tmp_path / "m")
    (tmp_path / "d" / "velodyne" / "000000.bin").write_bytes(b"12345")
    assert "not a multiple of 16" in typed("doctor", tmp_path / "d", code=1)


@pytest.mark.slow
def test_the_doctor_takes_maps_stores_and_no_server(tmp_path: Path, new_store: NewStore) -> None:
    write_pcd(tmp_path / "a.pcd", Cloud(1000.0 * cloud()))
    assert "millimetres, or centimetres?" in typed("doctor", tmp_path / "a.pcd", code=1)
    with pytest.raises(MapvoteError, match="give the points in metres"):
        typed("import", tmp_path / "a.pcd", tmp_path / "m")
    new_store(name="fleet.db")
    assert "no operator has a valid key" in typed("doctor", tmp_path / "fleet.db")
    with pytest.raises(MapvoteError, match="mapvote check http"):
        typed("doctor", "http://127.0.0.1:1")


def test_info_of_a_ballot(tmp_path: Path) -> None:
    cells = {(r, c): CellState.CHANGED_OCCUPIED for r in range(3) for c in range(7)}
    ballot = make_ballot(two_walls(), {(0, 0): Say(states_plane(cells))}, "v9", "d")
    ballot = replace(ballot, scans=10, scans_localised=9)
    (tmp_path / "b.ballot").write_bytes(encode(ballot))
    told = typed("info", tmp_path / "b.ballot")
    for word in ("v9", "9 of 10 voted", "changed occupied", "21 cells"):
        assert word in told


def test_info_of_nonsense_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "x.bin").write_bytes(b"nonsense")
    with pytest.raises(MapvoteError, match="neither map nor drive, and no ballot"):
        typed("info", tmp_path / "x.bin")
    with pytest.raises(MapvoteError, match="nothing is there"):
        typed("info", tmp_path / "y")


def test_config_tells_value_and_source(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("[paper]\nn_min = 7\n")
    told = typed("config", "--config", tmp_path / "s.toml")
    line = next(line for line in told.splitlines() if "paper.n_min" in line)
    assert " 7 " in line
    assert "default" not in line
    toml = typed("config", "--toml")
    (tmp_path / "all.toml").write_text(toml)
    assert typed("config", "--toml", "--config", tmp_path / "all.toml") == toml
