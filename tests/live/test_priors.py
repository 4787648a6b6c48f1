"""The pose of a scan by the odometry of a live vehicle, however often and in whatever order its poses come."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.types import F64
from mapvote.formats.drives.trajectory import sorted_trajectory
from mapvote.formats.geo.frame import MapFrame
from mapvote.live.priors import Priors, pose_in


def pose_at(x_m: float) -> F64:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


@pytest.mark.parametrize("rate_hz", [10, 200])
def test_a_pose_by_the_poses_around_a_scan_is_that_of_the_whole_trajectory(rate_hz: int) -> None:
    rng = np.random.default_rng(rate_hz)
    times_ns = np.arange(0, 4 * 10**9, 10**9 // rate_hz)
    times_ns[1::2] += rng.integers(0, 30_000_000, len(times_ns[1::2]))  # some overtake others
    T_map = np.stack([pose_at(x_m) for x_m in rng.normal(0.0, 5.0, len(times_ns))])
    whole = sorted_trajectory(times_ns, T_map, of_vehicle=True, frame=MapFrame())
    priors = Priors()
    for time_ns, T in zip(times_ns.tolist(), T_map, strict=True):
        assert priors.add(time_ns, T) == 0.0
    for stamp_ns in (
        0,
        1,
        *rng.integers(0, times_ns.max(), 50).tolist(),
        int(times_ns.max()),
        int(times_ns.max()) + 10**8,
    ):
        expected = whole.at(np.array([stamp_ns]), "odometry")[0]
        np.testing.assert_allclose(np.asarray(pose_in(priors.at(stamp_ns, np.eye(4)))), expected, atol=1e-12)
        assert priors.covers(stamp_ns) == (stamp_ns <= times_ns.max())


def test_a_hole_in_the_odometry_gives_no_pose() -> None:
    priors = Priors()
    for time_ns in (0, 100_000_000, 5_000_000_000, 5_100_000_000):
        priors.add(time_ns, np.eye(4))
    assert priors.at(2_000_000_000, np.eye(4)) is None
    assert priors.at(5_050_000_000, np.eye(4)) is not None
    assert priors.at(7_000_000_000, np.eye(4)) is None
