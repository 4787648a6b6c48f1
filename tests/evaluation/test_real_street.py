"""Real streets, KITTI drives in the map of their own other blocks: where we are, and that nothing changed; the same
drive with worse beliefs or in the rain."""

import os
from pathlib import Path

import numpy as np
import pytest

from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.formats import DriveWriter, open_drive
from mapvote_lab.evaluation.cases import choose_cases
from mapvote_lab.evaluation.real_bench import built, ground_of, score, survey_site
from mapvote_lab.evaluation.real_street import (
    Edit,
    Street,
    biased,
    disturbed,
    drifting,
    every_other_beam,
    in_rain,
    late,
    lay_street,
    of_another_street,
    open_recording,
    part_of,
    split,
    unedited,
    vote_on,
)

KITTI = Path(__file__).parents[2] / "../shared/data/kitti/2011_09_26_0001"
needs_kitti = pytest.mark.skipif(not KITTI.is_dir(), reason="the KITTI scans are not at ../shared/data (licence)")


def laid(folder: Path) -> Street:
    recording, reference = open_recording(folder, Settings())
    return lay_street(recording, Settings(), reference)


def test_every_scan_is_mapped_or_voted_with_once() -> None:
    mapped, voting = split(50, 12)
    assert sorted(np.concatenate([mapped, *voting]).tolist()) == list(range(50))
    assert mapped.tolist() == [*range(12), *range(24, 36), *range(48, 50)]
    with pytest.raises(MapvoteError, match=r"blocks of 25 scans leave 5 of 30 scans to vote, but 12 are needed"):
        split(30, 25)


@needs_kitti
@pytest.mark.slow
@pytest.mark.parametrize(
    ("edit", "first_pose_only"), [(disturbed(), False), (unedited, True), (every_other_beam, False)]
)
def test_vehicles_find_themselves_within_10_cm_and_none_is_lost(edit: Edit, first_pose_only: bool) -> None:
    """Every third scan at 12 m/s is 4 m from the last: a motion not yet known must not settle one house too early."""
    cases, _ = choose_cases(Settings(), "1")
    street = laid(KITTI)
    run = vote_on(street, cases, edit=edit, first_pose_only=first_pose_only)
    assert len(run.error_m) == run.scans == 24
    assert np.median(run.error_m) <= 0.10
    assert run.error_m.max() <= 0.30
    assert run.error_m.max() < run.prior_error_m.max()


@needs_kitti
@pytest.mark.slow
@pytest.mark.parametrize("drive", ["0001", "0005"])
def test_hardly_anything_is_called_changed_where_nothing_changed(drive: str) -> None:
    """Movers apart .2 % of determined cells and a quarter of case 1's share at most, movers included 1 %."""
    cases, _ = choose_cases(Settings(), "1,surfaces")
    folder = KITTI.with_name(f"2011_09_26_{drive}")
    street = laid(folder)
    for edit in (unedited, every_other_beam):
        run = vote_on(street, cases, edit=edit)
        share = run.changed_share("surfaces", with_movers=False)
        assert share <= 0.002
        assert share <= 0.25 * run.changed_share("1", with_movers=False)
        assert run.changed_share("surfaces", with_movers=True) <= 0.01


@needs_kitti
@pytest.mark.slow
@pytest.mark.parametrize("drive", ["0001", "0005"])
def test_no_reflection_sinks_the_ground_under_the_driven_path(drive: str) -> None:
    """KITTI's sensor stands 1.73 m above the road. Before the path was asked, drive 0005's stood at 4.1 m."""
    folder = KITTI.with_name(f"2011_09_26_{drive}")
    ground = ground_of(laid(folder))
    assert abs(ground.sensor_height_m - 1.73) <= 0.05
    assert abs(ground.worst_off_m) <= 0.2
    assert ground.occupied_share <= 0.01


@needs_kitti
@pytest.mark.slow
@pytest.mark.skipif(not os.environ.get("RAIN"), reason="takes a minute: RAIN=1 runs it")
def test_in_rain_the_same_cells_are_asked_for_and_most_things_are_found_still() -> None:
    cases, _ = choose_cases(Settings(), "surfaces")
    street = laid(KITTI.with_name("2011_09_26_0005"))
    (dry, asked), (wet, asked_in_rain) = built(street, survey_site(street), cases, 1, 4)
    for one, other in zip(asked, asked_in_rain, strict=True):
        assert (one.kind, one.rays) == (other.kind, other.rays)
        np.testing.assert_array_equal(one.cells, other.cells)
    found = [sum(f.half for f in score(asked, run.states["surfaces"])) for run in (dry, wet)]
    assert found[1] >= 0.5 * found[0] > 0


SPEED = 10.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """40 scans at 10 Hz along x at 10 m/s; every scan a ring of points 30 m away."""
    out = tmp_path_factory.mktemp("drive") / "straight"
    angle = np.linspace(0.0, 2.0 * np.pi, 500, endpoint=False)
    ring = np.column_stack([30.0 * np.cos(angle), 30.0 * np.sin(angle), np.zeros(500)]).astype(np.float32)
    writer = DriveWriter(out, vehicle="v", sensor=SENSORS["hdl32e"], start_ns=10**18, prior_sigma_m=0.5).open()
    for i in range(40):
        writer.write_scan(i, ring)
    T = np.stack([from_xyz_rpy(SPEED * 0.1 * i, 0.0, 1.8) for i in range(40)])
    writer.close(10**18 + np.arange(40) * 10**8, T)
    return out


def believed(folder: Path, edit: Edit) -> F64:
    """(n, 3) positions of the prior of every third scan, after the change, less the true ones."""
    drive = open_drive(folder, scans="::3")
    T = part_of(edit(open_drive(folder)), np.arange(0, 40, 3)).T_map_lidar_prior
    assert T is not None
    assert drive.T_map_lidar_prior is not None
    return np.asarray(T[:, :3, 3] - drive.T_map_lidar_prior[:, :3, 3])


@pytest.mark.parametrize("seconds", [0.2, 1.0, 2.0])
def test_a_late_prior_lies_as_far_behind_as_was_driven_meanwhile_from_the_first_scan_on(
    folder: Path, seconds: float
) -> None:
    np.testing.assert_allclose(believed(folder, late(seconds))[:, 0], -SPEED * seconds, atol=1e-6)


def test_a_bias_is_constant_and_a_drift_grows_from_nothing(folder: Path) -> None:
    np.testing.assert_allclose(np.linalg.norm(believed(folder, biased(3.0)), axis=1), 3.0, atol=1e-6)
    drift = np.linalg.norm(believed(folder, drifting(5.0)), axis=1)
    assert drift[0] < 1e-6
    assert abs(drift[-1] - 5.0) < 0.01
    assert (np.diff(drift) > 0).all()


def test_another_street_crosses_this_one(folder: Path) -> None:
    drive = open_drive(folder)
    T = of_another_street()(drive).T_map_lidar_prior
    assert T is not None
    assert np.ptp(T[:, 0, 3]) < 1e-6
    assert abs(np.ptp(T[:, 1, 3]) - 39.0) < 1e-6


def test_rain_shortens_its_share_of_the_rays_and_turns_none(folder: Path) -> None:
    drive: Drive = open_drive(folder)
    dry, wet = drive.read_scan(3).points, in_rain(0.2)(drive).read_scan(3).points
    reach = np.linalg.norm(wet, axis=1) / np.linalg.norm(dry, axis=1)
    assert 0.12 < (reach < 0.99).mean() < 0.28
    np.testing.assert_allclose(wet / np.linalg.norm(wet, axis=1)[:, None], dry / 30.0, atol=1e-4)
