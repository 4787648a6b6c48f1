"""Every scan that could be localised becomes one observation, in order, with its number in the drive."""

from __future__ import annotations

import numpy as np
import pytest

from hand_made import AtOnce, make_map, make_tile, wall
from mapvote.config import MovingSettings
from mapvote.core.geometry import from_xyz_rpy, rows_from
from mapvote.core.point_map import PointMap
from mapvote.core.reference import LocalMap
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, F64, Bool, MapvoteError, PosePrior, Registration, Scan
from mapvote.matching.localiser import GivenPoses, Localise
from mapvote.matching.odometry import Fix
from mapvote.perception.frontend import Frontend, Observation
from mapvote.perception.moving_objects import MovingFilter
from mapvote.perception.placement import ONE_LIDAR, LidarPart
from mapvote.perception.raycast import cast_rays

SECOND = 10**9
SENSOR = from_xyz_rpy(30.0, 30.0, 1.8)
POINTS = np.array([[5.0, 0.1, -0.3], [5.0, 0.4, -0.3], [3.0, 0.0, -1.8], [60.0, 0.0, 0.0]], np.float32)
"""Two points of a wall, one of the road, one beyond the window."""


def street() -> PointMap:
    road = wall([(r, c) for r in range(60, 140) for c in range(60, 140)], [0.0])
    return make_map({(0, 0): make_tile(np.concatenate([road, wall([(100, 116)], [0.75, 1.05])]))})


def drive(frontend: Frontend, scans: int) -> list[Observation]:
    seen = []
    for i in range(scans):
        seen += frontend.observe(Scan(i * SECOND // 4, POINTS))
    return seen


def localise(lost: tuple[int, ...] = ()) -> Localise:
    def known(scan: Scan, prior: PosePrior | None) -> Fix:
        registration = Registration(SENSOR, np.diag([0.04, 0.01, 0.01, 0, 0, 0]), 1.0, 1.0, 0, True)
        return Fix(scan, registration, np.zeros(6), scan.stamp_ns * 4 // SECOND not in lost)

    return AtOnce(known)


def frontend(lost: tuple[int, ...] = (), compared: LocalMap | None = None) -> Frontend:
    movers = MovingFilter(SENSORS["hdl32e"], MovingSettings())
    return Frontend(localise(lost), movers, LocalMap(street(), 40.0), compared)


def test_observations_come_in_order_a_second_late_and_the_end_of_the_drive_brings_the_rest() -> None:
    whole = frontend(lost=(2, 5))
    early = drive(whole, 9)
    assert [seen.scan.index for seen in early] == [0, 1, 3, 4], "scan 8 is a second after scan 4"
    assert [seen.scan.index for seen in whole.finish()] == [6, 7, 8]
    assert whole.finish() == []
    assert whole.report.lost == [2, 5]
    assert whole.report.scans == 9
    assert len(whole.report.T_map_lidar) == 9
    with pytest.raises(MapvoteError, match="has ended"):
        whole.observe(Scan(9 * SECOND, POINTS))


class InBursts:
    """A localiser that decides ``size`` scans at once, as a check of the pose does."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._held: list[Fix] = []

    def push(self, scan: Scan, prior: PosePrior | None) -> list[Fix]:
        self._held += localise().push(scan, prior)
        return self.flush() if len(self._held) == self._size else []

    def flush(self) -> list[Fix]:
        held, self._held = self._held, []
        return held


@pytest.mark.parametrize(("burst", "most"), [(4, 1), (12, 2), (40, 7)])
def test_the_scans_of_a_burst_are_worked_on_one_with_each_call_and_none_is_lost(burst: int, most: int) -> None:
    """A vehicle's computer has 0.1 s for each call: four scans at once took 3.6 times the mean."""
    whole = Frontend(InBursts(burst), AllMove(), LocalMap(street(), 40.0))
    taken, indices = [0], []
    for i in range(3 * burst):
        indices += [seen.scan.index for seen in whole.observe(Scan(i * SECOND // 10, POINTS))]
        taken.append(len(whole.report.T_map_lidar))
    assert np.diff(taken).max() <= most
    indices += [seen.scan.index for seen in whole.finish()]
    assert indices == list(range(3 * burst))


class TakesBack:
    """A localiser that gives scans out at once, and with scan 6 takes back those from 3 on."""

    def __init__(self) -> None:
        self._given: list[Fix] = []

    def push(self, scan: Scan, prior: PosePrior | None) -> list[Fix]:
        if len(self._given) == 6:
            for fix in self._given[3:]:
                fix.standing.holds = False
        self._given += localise().push(scan, prior)
        return self._given[-1:]

    def flush(self) -> list[Fix]:
        return []


def test_scans_that_are_taken_back_are_lost_and_no_witnesses_of_what_moves() -> None:
    movers = MovingFilter(SENSORS["hdl32e"], MovingSettings())
    whole = Frontend(TakesBack(), movers, LocalMap(street(), 40.0))
    seen = drive(whole, 7)
    assert [scan.stamp_ns * 4 // SECOND for scan in movers._window] == [0, 1, 2, 6]
    assert [one.scan.index for one in seen + whole.finish()] == [0, 1, 2, 6]
    assert whole.report.lost == [3, 4, 5]
    assert len(whole.report.T_map_lidar) == 7


def test_an_observation_tells_obstacles_from_the_road_and_how_sure_the_pose_was() -> None:
    one = frontend()
    drive(one, 1)
    [seen] = one.finish()
    assert seen.scan.obstacle.tolist() == [True, True, False, False]
    assert (seen.scan.cell >= 0).tolist() == [True, True, True, False]
    assert not seen.moving.any()
    assert one.report.sigmas_m().tolist() == [pytest.approx(0.2)], "the worst direction"
    np.testing.assert_allclose(seen.scan.points_map[0], [35.0, 30.1, 1.5], atol=1e-5)
    assert seen.view.counts.sum() == 2
    assert seen.reference is seen.scan.reference


def test_the_window_of_comparison_may_be_another_than_that_of_the_ground() -> None:
    narrow = frontend(compared=LocalMap(street(), 6.0))
    drive(narrow, 1)
    [seen] = narrow.finish()
    assert seen.scan.obstacle.tolist() == [True, True, False, False]
    assert seen.view.grid == seen.reference.grid
    assert seen.view.counts.sum() == 0, "the wall stands 5 m off, the window reaches 3 m"


class AllMove:
    """Whatever stands above the ground moves."""

    def push(
        self, rows: F32, origin_map: F64, obstacle: Bool, stamp_ns: int, lidars: tuple[LidarPart, ...] = ONE_LIDAR
    ) -> list[Bool]:
        return [obstacle]

    def flush(self) -> list[Bool]:
        return []

    def forget(self, count: int) -> None:
        assert count == 0


def test_moving_points_do_not_count_as_hits_and_given_poses_need_no_prior() -> None:
    poses = GivenPoses(np.array([0, SECOND]), np.array([SENSOR, SENSOR]))
    everything = Frontend(poses, AllMove(), LocalMap(street(), 40.0))
    [seen] = everything.observe(Scan(0, POINTS))
    assert seen.moving.sum() == 2
    assert seen.view.counts.sum() == 0
    assert seen.view.passed.any(), "its rays prove what they passed all the same"


def test_rays_without_return_are_followed_of_the_vehicles_first_lidar_alone() -> None:
    sensor = SENSORS["hdl32e"]
    azimuth, elevation = np.meshgrid(np.arange(0.0, 360.0, sensor.azimuth_step_deg), sensor.elevations_deg)
    a, e = np.radians(azimuth.ravel()), np.radians(elevation.ravel())
    road = (e < -0.05) & (e > -0.35)
    points = (
        1.8
        / np.sin(-e[road])[:, None]
        * np.column_stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])[road]
    )
    passed = {}
    for name, origin in (("first", None), ("second", np.zeros(3))):
        whole = Frontend(localise(), MovingFilter(sensor, MovingSettings()), LocalMap(street(), 40.0), sensor=sensor)
        seen = whole.observe(Scan(0, points.astype(np.float32), origin=origin)) + whole.finish()
        passed[name] = int(np.bitwise_count(seen[0].view.passed & ~np.uint64(0b1111111)).sum())
    assert passed["second"] == 0, "the road is far below"
    assert passed["first"] > 10_000


def test_a_sweep_of_two_lidars_is_one_observation_and_each_one_s_rays_begin_where_it_sits() -> None:
    rear = np.array([-3.0, 0.5, 0.2])
    points = POINTS + np.float32(0.05)  # off the sides of voxels, where rounding decides
    whole = frontend()
    assert whole.observe(Scan.sweep(0, [Scan(0, points), Scan(0, points, origin=rear)])) == []
    (seen,) = whole.finish()
    assert (whole.report.scans, len(whole.report.sigmas_m())) == (1, 1)
    np.testing.assert_allclose(seen.scan.origin_map, SENSOR[:3, 3])
    first, second = seen.scan.lidars
    np.testing.assert_allclose(first.origin_map(seen.scan.origin_map), SENSOR[:3, 3])
    np.testing.assert_allclose(second.origin_map(seen.scan.origin_map), SENSOR[:3, 3] + rear)
    views = []
    for part, origin in ((slice(0, 4), SENSOR[:3, 3].copy()), (slice(4, 8), SENSOR[:3, 3] + rear)):
        rows = rows_from(seen.scan.points_map[part], origin)
        views.append(cast_rays(rows, origin, seen.scan.obstacle[part], seen.moving[part], seen.reference))
    expected = views[0].joined(views[1])
    assert expected.hit.any()
    assert expected.passed.any()
    np.testing.assert_array_equal(seen.view.passed, expected.passed)
    np.testing.assert_array_equal(seen.view.hit, expected.hit)
    np.testing.assert_array_equal(seen.view.counts, expected.counts)
    np.testing.assert_array_equal(seen.view.sight, expected.sight)
