"""Messages whose stamps are missing, doubled, out of order or of two passes are read in order, and counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bag_recorder import START, Recorder
from mapvote.core.geometry import from_xyz_rpy
from mapvote.doctor.bags import check_bag
from mapvote.formats import open_drive
from mapvote.formats.drives.stamp_order import in_order_of_stamps

N = 40
EVEN = START + np.arange(N) * 10**8


def order_of(stamps_ns: list[int] | np.ndarray) -> tuple[list[int], str]:
    order = in_order_of_stamps(np.array(stamps_ns, dtype=np.int64), START + np.arange(len(stamps_ns)) * 10**8)
    assert (np.diff(order.stamps_ns) > 0).all()
    return order.chosen.tolist(), " | ".join(order.told)


@given(st.permutations(range(N)))
def test_stamps_in_any_order_are_sorted_and_none_is_lost(numbers: list[int]) -> None:
    order = in_order_of_stamps(EVEN[numbers], EVEN)
    assert order.stamps_ns.tolist() == EVEN.tolist()
    assert [numbers[i] for i in order.chosen] == list(range(N))
    assert ("out of order" in " ".join(order.told)) == (list(numbers) != list(range(N)))


def test_the_first_stamps_before_a_clock_is_set_are_left_out_and_counted() -> None:
    for early in (np.zeros(5, dtype=np.int64), 10**8 * np.arange(3, 8)):  # no /clock yet; seconds since the boot
        chosen, told = order_of(np.concatenate([early, EVEN]))
        assert chosen == list(range(5, N + 5))
        assert "has 5 stamps of another day" in told
        assert ("use_sim_time" in told) == (early[0] == 0)


def test_a_simulation_that_begins_at_zero_is_whole() -> None:
    assert order_of(np.arange(N) * 10**8) == (list(range(N)), "")


def test_headers_without_stamps_get_the_times_of_receipt() -> None:
    chosen, told = order_of(np.zeros(N, dtype=np.int64))
    assert chosen == list(range(N))
    assert "no stamps in its headers" in told


def test_equal_stamps_are_dropped_and_counted() -> None:
    chosen, told = order_of(np.repeat(EVEN, 2))
    assert chosen == list(range(0, 2 * N, 2))
    assert f"has {N} stamps that an earlier message has too" in told


def test_the_longest_of_two_passes_over_the_same_time_is_read() -> None:
    shifted = EVEN[:30] + 37_000_000  # a second drive of that morning would lie between the scans of the first
    chosen, told = order_of(np.concatenate([EVEN, shifted]))
    assert chosen == list(range(N))
    assert "set back 1 times" in told
    assert "30 messages are left out" in told


def test_files_joined_in_another_order_are_all_read() -> None:
    chosen, told = order_of(np.concatenate([EVEN[20:], EVEN[:20]]))
    assert chosen == [*range(20, 40), *range(20)]
    assert "sorted" in told


@pytest.mark.parametrize("where", ["clouds", "poses", "both"])
def test_a_bag_with_stamps_out_of_order_is_the_drive_that_was_driven(tmp_path: Path, where: str) -> None:
    """Pairs of messages are swapped, one comes twice, and the first two have the stamp 0."""
    recorder = Recorder(tmp_path / "bag")
    rng = np.random.default_rng(1)
    clouds = [rng.uniform(3, 40, (300, 3)) for _ in range(N)]
    numbers = [1, 0, 3, 2, *range(4, N)]
    for k, i in enumerate(numbers):
        of_clouds, of_poses = (i if where in (one, "both") else k for one in ("clouds", "poses"))
        received = START + k * 10**8 + 5_000_000
        rows = np.ascontiguousarray(clouds[of_clouds], dtype="<f4").view([(axis, "<f4") for axis in "xyz"])[:, 0]
        message = recorder.cloud_of(rows, int(EVEN[of_clouds]))
        recorder.write("/points", "sensor_msgs/msg/PointCloud2", received, message)
        if i == 7:
            recorder.write("/points", "sensor_msgs/msg/PointCloud2", received + 1, message)
            unset = recorder.cloud_of(rows, 0)
            recorder.write("/points", "sensor_msgs/msg/PointCloud2", received + 2, unset)
        recorder.pose("/odom", int(EVEN[of_poses]), from_xyz_rpy(0.5 * of_poses, 0, 0), received)
    recorder.bag.close()
    drive = open_drive(tmp_path / "bag", prior="/odom", sensor="hdl32e")
    assert drive.stamps_ns.tolist() == EVEN.tolist()
    assert drive.T_map_lidar_prior is not None
    assert np.allclose(drive.T_map_lidar_prior[:, 0, 3], 0.5 * np.arange(N))
    for scan, sound in zip(drive, clouds, strict=True):
        assert np.allclose(scan.points, sound, atol=1e-5)
    told = " ".join(f"{f.severity}: {f.what} {f.mend}" for f in check_bag(tmp_path / "bag", prior="/odom"))
    assert "error" not in told
    assert "times.txt" not in told
    assert "use_sim_time" in told
