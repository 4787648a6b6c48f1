"""The doctor names what is wrong with a drive, one fault and two at once, and calls healthy drives sound.

The street: a road, two rows of walls with gaps; the car turns gently, so that a mirror would show.
"""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from faults import TIME_MENDS, Recording, broken, kinds_of, mounted, serious, sound_street, state, verdict
from mapvote.core import geometry
from mapvote.core.grid import Lattice
from mapvote.core.point_map import PointMap, cut_tiles, map_from_points
from mapvote.core.sensors import NAMED, SENSORS
from mapvote.core.tile import Tile
from mapvote.core.types import F64, Drive, Scan
from mapvote.doctor.diagnosis import diagnose, examine_drive
from mapvote.doctor.drive_evidence import DriveEvidence
from mapvote.doctor.map_fit import MapEvidence, check_on_map, in_another_unit, peak_of
from mapvote.doctor.maps import examine_points
from mapvote.doctor.reading_on_map import ReadOnMap, confirmed
from mapvote.doctor.scans import NO_PRIOR
from mapvote.formats.drives.scan_folder import write_poses
from mapvote.formats.maps.cloud import Cloud
from mapvote_lab.simulation import simulate
from streets import drive_along, path

N = 24


def poses() -> F64:
    """A gentle left turn at 8 m/s, the sensor 1.8 m above the road."""
    T = [geometry.from_xyz_rpy(0, 0, 1.8)]
    for _ in range(N - 1):
        T.append(T[-1] @ geometry.from_xyz_rpy(0.8, 0, 0, yaw=0.03))
    return np.stack(T)


@pytest.fixture(scope="module")
def sound() -> Recording:
    return seen_along(poses())


def seen_along(T_map_lidar: F64) -> Recording:
    """Scans of the street at poses (24, 4, 4)."""
    rng = np.random.default_rng(9)
    points = sound_street()
    scans = []
    for T in T_map_lidar:
        local = geometry.transform(geometry.inverse(T), points)
        away = np.linalg.norm(local, axis=1)
        near = local[(away < 40) & (away > 3)]
        chosen = near[rng.random(len(near)) < 0.5]
        seen = chosen + rng.normal(0, 0.02, chosen.shape)
        scans.append(np.column_stack([seen, rng.random(len(seen))]))
    about = {"sensor": "hdl32e", "motion_compensated": True, "prior_sigma_m": 0.1}
    return Recording(scans, T_map_lidar, np.linspace(0.0, 2.3, N), about)


def test_a_healthy_drive_is_sound(tmp_path: Path, sound: Recording) -> None:
    sound.write(tmp_path / "d")
    found = diagnose(tmp_path / "d").findings
    assert serious(found) == []
    assert any("mistakes of the prior show from " in f.what for f in found), found
    assert serious(diagnose(tmp_path / "d", None, map_from_points(sound_street())).findings) == []


STRAIGHT = ["inverse poses", "rows in reverse order", "points facing backwards", "y of positions negated"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", STRAIGHT)
def test_a_map_decides_what_a_straight_drive_leaves_open(tmp_path: Path, kind: str) -> None:
    """The map lies about the middle of the drive: a prior that is read otherwise lays scans elsewhere."""
    T = np.array([geometry.from_xyz_rpy(0.8 * (k - N // 3), 3.0, 1.8) for k in range(N)])
    (named,), change = kinds_of("drives")[kind]
    broken(seen_along(T), change, tmp_path / "d")
    found = diagnose(tmp_path / "d", None, map_from_points(sound_street())).findings
    errors = [finding.what for finding in found if finding.severity == "error"]
    assert len(errors) == 1, errors
    assert re.search(named, errors[0])
    assert "scans checked fit the map" in errors[0]
    assert "; or " not in errors[0]


def test_a_map_confirms_a_reading_that_fits_alone_or_where_it_has_the_scans() -> None:
    def lies(fit: int, total: float, off_m: float) -> ReadOnMap:
        return ReadOnMap(fit, 6, total, off_m)

    nowhere, here, beside = lies(0, 0.4, np.inf), lies(6, 6.2, 0.1), lies(6, 6.2, 9.0)
    assert confirmed([nowhere, beside, nowhere], 0.5) == 1, "alone, though the prior's frame is off"
    assert confirmed([beside, here], 0.5) == 1, "the next street looks alike"
    assert confirmed([here, here], 0.5) is None
    assert confirmed([lies(3, 3.0, 0.1), nowhere], 0.5) is None, "too few scans fit"


MOUNTS = [(180, 0, 0), (90, 0, 45), (0, 135, 0), (0, 270, 0), (45, 45, 45), (0, 0, 90), (20, 100, 200)]
"""Roll, pitch and yaw of the points, degrees."""


@pytest.mark.slow
@pytest.mark.parametrize("rpy_deg", MOUNTS)
def test_a_mount_that_prior_and_points_agree_on_is_sound(
    tmp_path: Path, sound: Recording, rpy_deg: tuple[float, float, float]
) -> None:
    mounted(sound, rpy_deg).write(tmp_path / "d")
    assert serious(diagnose(tmp_path / "d").findings) == []
    assert serious(diagnose(tmp_path / "d", None, map_from_points(sound_street())).findings) == []


@pytest.mark.parametrize(("rpy_deg", "name"), [((180, 0, 0), "upside down"), ((-90, 0, 0), "axis .y points up")])
def test_a_mount_that_the_prior_does_not_know_is_an_error(
    tmp_path: Path, sound: Recording, rpy_deg: tuple[float, float, float], name: str
) -> None:
    replace(mounted(sound, rpy_deg), T=sound.T).write(tmp_path / "d")
    assert re.search(name, " ".join(serious(diagnose(tmp_path / "d").findings)))


def test_a_prior_that_turns_a_sensor_over_which_stands_upright_is_named(tmp_path: Path, sound: Recording) -> None:
    replace(mounted(sound, (180, 0, 0)), scans=sound.scans).write(tmp_path / "d")
    what = " ".join(serious(diagnose(tmp_path / "d").findings))
    assert "the prior tilts the sensor by 180 deg, but the points show no road below it" in what


def test_further_faults_of_a_sensor_upside_down_are_named(tmp_path: Path, sound: Recording) -> None:
    r = mounted(sound, (180, 0, 0))
    r.T[:, :3, 3] /= 0.3048
    r.write(tmp_path / "d")
    what = " ".join(serious(diagnose(tmp_path / "d").findings))
    assert "too large" in what
    assert "upside down" not in what


FAST = {
    "points in the vehicle's left-handed axes", "points upside down, turned over", "points facing backwards",
    "points in camera axes", "points in millimetres", "with the vehicle's own roof", "one point in sixty",
    "one scan full of NaN", "inverse poses", "rotations transposed", "prior in camera axes",
    "heading as a compass bearing", "positions in kilometres", "spikes of 25 m", "the prior does not move",
    "times in milliseconds", "times divided by 1000", "rotations scaled", "headings off by 20 deg + positions in feet",
    "one scan empty + rotations transposed", "nanoseconds of points under an unknown name",
    "times of points that are columns", "scans that are not those of their stamps",
}  # fmt: skip
LESS = {
    "as it is": "sound",
    "absolute values of y": "vague",
    "without the lower beams": "wrong",
    "scans sorted as text": "vague",
    "a jump of 3.0 m": "vague",
    "rows 12 scans late": "sound",
    "points in millimetres + inverse poses": "part",
}
"""Faults that do not show on 18 m of a street of points in no order, without rings; of points that no reader takes for
metres, only the unit."""


SOME_KINDS = [
    kind for k, kind in enumerate(kinds_of("drives")) if k % 6 == 0 or kind in FAST or os.environ.get("FAULTS") == "all"
]
"""A sixth of them, for CI has twenty minutes; `FAULTS=all pytest -m slow` and benchmarks/doctor.py take all."""


@pytest.mark.parametrize(
    "kind", [kind if kind in FAST else pytest.param(kind, marks=pytest.mark.slow) for kind in SOME_KINDS]
)
@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")  # numbers of another type
def test_faults_of_a_drive_are_named_one_and_two(tmp_path: Path, sound: Recording, kind: str) -> None:
    rights, change = kinds_of("drives")[kind]
    found = diagnose(broken(sound, change, tmp_path / "drive")).findings
    assert verdict(rights, found) == LESS.get(kind, "right"), found


@pytest.mark.parametrize(
    "kind",
    [k if k.startswith(("nano", "times of points that are a c")) else pytest.param(k, marks=pytest.mark.slow)
     for k in TIME_MENDS],
)  # fmt: skip
def test_advice_on_times_of_points_mends_them(tmp_path: Path, sound: Recording, kind: str) -> None:
    _, change = kinds_of("drives")[kind]
    folder = broken(sound, change, tmp_path / "drive")
    (key, value), *_ = TIME_MENDS[kind].items()
    said = " ".join(f"{f.what} {f.mend}" for f in diagnose(folder).findings)
    assert key in said
    assert str(value) in said
    state(folder, **TIME_MENDS[kind])
    assert serious(diagnose(folder).findings) == []


LIES = {
    "shifted by 0.5 m": r"error: the map is shifted by 0\.50 m \(x \+0\.40, y \+0\.30",
    "shifted by 5 m": r"shifted by 5\.00 m \(x \+3\.00, y \+4\.00, z .0\.00; \+-0\.07\) against the prior",
    "shifted by 300 km": r"the map covers \(299904, -77\) to \(300134, 77\), 299887 m away",
    "turned by 10 deg": r"turned about z by 10\.00 deg \(\+-0\.37\) against .* \(4 places\)",
    "pitched by 3 deg + scaled by 1.03": r"tilted by 3\.00 deg \(\+-0\.50\), scaled by 1\.0300 \(\+-0\.0019\)",
    "mirrored, y negated": "the map is mirrored against the scans: 4 mirrored scans fit it, unmirrored none",
    "in feet": "the map is in feet: made metres, it fits 6 of 6 scans checked",
    "bent": "the drive fits the map nowhere: the best fit is 0.33",
}
"""How maps lie on the drive, in words."""
ON_MAP = [kind for kind in kinds_of("maps") if " + " in kind or "shifted" in kind or kind in LIES]


QUICK = "shifted by 0.5 m", "pitched by 3 deg + scaled by 1.03"


@pytest.mark.parametrize("kind", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in ON_MAP])
def test_faults_of_a_map_show_by_a_drive_and_are_measured(sound: Recording, kind: str) -> None:
    rights, change = kinds_of("maps")[kind]
    found, point_map = examine_points("map", Cloud(change(sound_street())))
    assert point_map is not None
    found += check_on_map(drive_of(sound), poses(), point_map)[0]
    assert verdict(rights, found) == "right", found
    assert any(re.search(LIES.get(kind, ""), f"{f.severity}: {f.what}") for f in found), found


def test_the_best_scale_lies_at_the_peak_of_a_parabola_and_without_one_uphill() -> None:
    for peak in (-0.4, 0.0, 0.3):
        assert peak_of(*(0.9 - 0.1 * (step - peak) ** 2 for step in (-1, 0, 1))) == pytest.approx(peak)
    assert [peak_of(0.1, 0.2, 0.4), peak_of(0.4, 0.2, 0.1), peak_of(0.5, 0.5, 0.5)] == [1.0, -1.0, 0.0]


def drive_of(sound: Recording) -> Drive:
    stamps_ns = np.arange(N) * 100_000_000
    scans = [scan[:, :3].astype(np.float32) for scan in sound.scans]
    return Drive(Path("d"), "v", "d", SENSORS["hdl32e"], stamps_ns, lambda i: Scan(0, scans[i]), prior_sigma_m=0.1)


def test_a_broken_prior_does_not_hide_other_ills(tmp_path: Path, sound: Recording) -> None:
    _, upside_down = kinds_of("drives")["points upside down, turned over"]
    folder = broken(sound, upside_down, tmp_path / "d")
    write_poses(folder / "prior.txt", 2 * poses())
    what = " ".join(serious(diagnose(folder).findings))
    assert "not orthonormal" in what
    assert "upside down" in what


@pytest.mark.parametrize(
    ("weave_m", "sigma_m"),
    [(1.0, 0.3), *(pytest.param(*how, marks=pytest.mark.slow) for how in ((0.3, 0.0), (2.0, 1.0)))],
)
def test_a_healthy_drive_through_another_street_raises_no_alarm(weave_m: float, sigma_m: float) -> None:
    """Nearly straight on and weaving; scans are bent by 10 m/s, and the prior errs as it states."""
    T = path(40, weave_m=weave_m)
    prior = T.copy()
    prior[:, :3, 3] += np.random.default_rng(1).normal(0, sigma_m, 3)
    assert serious(examine_drive(drive_along(T, 1, prior, sigma_m=max(sigma_m, 0.05)))[0]) == []


def test_a_healthy_drive_without_a_prior_gets_that_note_only() -> None:
    assert serious(examine_drive(drive_along(path(24), 2))[0]) == [NO_PRIOR.what]


@pytest.mark.parametrize(
    ("cone_deg", "every", "swapped", "finding"),
    [(70, 4, False, ""), (70, 8, False, "note: .*do not show its motion"), (360, 1, True, "error: the scans leap")],
)
def test_scans_without_rings_are_an_alarm_only_where_they_show_the_motion(
    cone_deg: float, every: int, swapped: bool, finding: str
) -> None:
    """Of a sparse cone the registration errs by .7 m a step, which says nothing of the order of its scans."""
    whole = drive_along(path(24), 2)
    order = np.arange(24).reshape(-1, 2)[:, ::-1].ravel() if swapped else np.arange(24)

    def read_scan(i: int) -> Scan:
        scan = whole.read_scan(int(order[i]))
        assert scan.time_s is not None
        azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
        chosen = np.flatnonzero(np.abs(azimuth) < 0.5 * cone_deg)[::every]
        return Scan(scan.stamp_ns, scan.points[chosen], scan.time_s[chosen])

    evidence = DriveEvidence(replace(whole, sensor=NAMED["rosette70"], read_scan=read_scan))
    findings = [f"{f.severity}: {f.what}" for f in evidence.leaps]
    assert len(findings) == bool(finding)
    assert all(re.match(finding, one) for one in findings), findings
    assert evidence.can_be_registered == (every < 8)


@pytest.mark.slow
def test_healthy_simulated_drives_and_those_of_kitti_raise_no_alarm(tmp_path: Path) -> None:
    simulate("corner", tmp_path / "corner", 971)
    kitti = Path(__file__).parents[2] / "../shared/data/kitti"
    folders = [*sorted((tmp_path / "corner").glob("[sv]*")), *sorted(kitti.glob("2011*"))]
    assert len(folders) >= 5
    assert {folder.name: serious(diagnose(folder).findings) for folder in folders} == {f.name: [] for f in folders}


@pytest.mark.parametrize(
    ("numbers", "name"),
    [
        (1 / 0.0254, "in inches"),
        pytest.param(0.3048, "converted as if they were feet", marks=pytest.mark.slow),
    ],
)
def test_the_unit_of_a_map_that_is_not_in_metres_is_named(sound: Recording, numbers: float, name: str) -> None:
    points = sound_street()
    points = points[(np.abs(points[:, :2] - [8.0, 5.0]) < 30.0).all(axis=1)]
    tiles = {}
    for index, mine in cut_tiles(numbers * points, Lattice()):
        empty = Tile.empty(Lattice().tile(index))
        tiles[index] = empty.but(points=empty.window.from_map(numbers * points[mine]))
    found = in_another_unit(MapEvidence(drive_of(sound), poses(), PointMap("m", Lattice(), tiles)))
    assert found is not None
    assert name in found.what
    assert "fits 6 of 6 scans" in found.what


def test_nothing_there_is_one_error() -> None:
    found = diagnose(Path("/nowhere")).findings
    assert [f.severity for f in found] == ["error"]
