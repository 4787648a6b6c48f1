"""Fixes and headings that arrive over DDS give the priors that the recording of them gives, bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from bag_recorder import START, Recorder
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F64, MapvoteError
from mapvote.formats import open_drive
from mapvote.formats.drives.fixes import prior_at
from mapvote.formats.drives.frames import Frames
from mapvote.formats.drives.ros_types import GNSS, IMU, TF
from mapvote.formats.geo.frame import MapFrame
from mapvote.live.fix_topics import FixMemory, FixTopics
from mapvote.live.messages import from_cdr
from mapvote.live.play import frames_message
from receiver_messages import fix_message, imu_message

UTM = MapFrame("EPSG:32632", (457_000.0, 5_428_000.0, 0.0))
MOUNT = from_xyz_rpy(1.0, 0.0, 1.8, 0.0, 0.0, 0.1)
ANTENNA = from_xyz_rpy(-0.5, 0.1, 2.0)
STEP = 10**8


def drive_in_a_bend(n: int) -> tuple[F64, F64]:
    """Longitudes, latitudes and heights (n, 3), and yaws (n,), at 10 Hz."""
    yaw: F64 = 0.2 + 0.02 * np.arange(n, dtype=np.float64)
    way = np.cumsum(np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(n)]), axis=0)
    return UTM.to_lonlat(way), yaw


@pytest.mark.parametrize("north_known", [True, False])
def test_live_fixes_and_recorded_ones_give_equal_priors(tmp_path: Path, north_known: bool) -> None:
    lonlat, yaw = drive_in_a_bend(60)
    bag = Recorder(tmp_path / "bag")
    frames = Frames()
    live = FixTopics(UTM, frames, FixMemory(headings=50))
    static = frames_message(START, {"lidar": MOUNT, "gnss": ANTENNA})
    bag.write_raw("/tf_static", TF, START, static)
    frames.add_all(from_cdr(TF, static), fixed=True)
    cloud = np.random.default_rng(1).uniform((4, 4, 0), (30, 30, 5), (900, 3))
    priors = []
    for i in range(60):
        ns = START + i * STEP
        heading = imu_message(ns, float(yaw[i]), 0.02 if north_known else None)
        bag.write_raw("/imu", IMU, ns, heading)
        live.add_imu(from_cdr(IMU, heading))
        if i % 10 == 0:
            fix = fix_message(ns, lonlat[i], 0.5)
            bag.write_raw("/fix", GNSS, ns, fix)
            live.add_fix(from_cdr(GNSS, fix))
        bag.cloud("/points", "lidar", ns, cloud)
        priors.append(prior_at(live.fixes(), ns, live.T_antenna_lidar("lidar")))
    bag.bag.close()
    recorded = open_drive(tmp_path / "bag", sensor="hdl32e", as_live=True, frame=UTM)
    assert recorded.T_map_lidar_prior is not None
    assert recorded.prior_sigmas is not None
    for T, sigmas, prior in zip(recorded.T_map_lidar_prior, recorded.prior_sigmas, priors, strict=True):
        assert prior is not None
        assert_array_equal(T, prior.T_map_lidar)
        assert sigmas.tolist() == [prior.sigma_m, prior.sigma_rad]
    assert recorded.prior_sigmas[-1, 1] < 0.2


def test_messages_without_a_fix_are_refused_and_change_nothing(caplog: pytest.LogCaptureFixture) -> None:
    lonlat, _ = drive_in_a_bend(2)
    topics = FixTopics(UTM, Frames())
    topics.add_fix(from_cdr(GNSS, fix_message(START, lonlat[0], 1.0)))
    for wrong in (
        fix_message(START + STEP, lonlat[1], status=-1),
        fix_message(START + STEP, np.zeros(3)),
        fix_message(START + STEP, np.array([np.nan, 49.0, 1.0])),
    ):
        with pytest.raises(MapvoteError):
            topics.add_fix(from_cdr(GNSS, wrong))
    assert caplog.text == "", "who receives them counts and reports them"
    topics.add_fix(from_cdr(GNSS, fix_message(START - STEP, lonlat[1], 1.0)))  # late
    assert topics.fixes().times_ns.tolist() == [START]
    with pytest.raises(MapvoteError, match=r"--crs"):
        FixTopics(MapFrame(), Frames()).add_fix(from_cdr(GNSS, fix_message(START, lonlat[0])))


def test_memory_of_fixes_is_bounded() -> None:
    lonlat, _ = drive_in_a_bend(30)
    topics = FixTopics(UTM, Frames(), FixMemory(fixes=7))
    for i in range(30):
        topics.add_fix(from_cdr(GNSS, fix_message(START + i * STEP, lonlat[i])))
    assert len(topics.fixes().times_ns) == 7
    assert topics.fixes().times_ns[-1] == START + 29 * STEP
