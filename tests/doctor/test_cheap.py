"""A drive that is being used is looked at on the way: every scan once, and nothing wrong with it goes unsaid."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, Drive, MapvoteError, Scan
from mapvote.doctor.scans import Looking, cheap_checks, looked_at

N = 120
UNSAMPLED = 60
"""No scan from here to UNSAMPLED + 3 is among the first looks."""


def ring(i: int, n: int = 3_000) -> F32:
    """Points all round, some 20 m away, on no grid."""
    rng = np.random.default_rng(i)
    azimuth, away = np.sort(rng.uniform(-np.pi, np.pi, n)), rng.uniform(5.0, 60.0, n)
    return np.column_stack([away * np.cos(azimuth), away * np.sin(azimuth), rng.uniform(-1.8, 4.0, n)]).astype("f4")


class Recording:
    """A drive of N scans, of which some are spoilt; counts how often each is read."""

    def __init__(self, cut: range = range(0), torn: int | None = None) -> None:
        self.cut, self.torn, self.reads = cut, torn, np.zeros(N, dtype=int)

    def read(self, i: int) -> Scan:
        self.reads[i] += 1
        if i == self.torn:
            raise MapvoteError(f"{i:06d}.bin: 7 bytes, no whole number of points")
        points = ring(i)
        return Scan(stamp_ns=i * 100_000_000, points=points[:1_000] if i in self.cut else points)

    def drive(self) -> Drive:
        T = np.stack([from_xyz_rpy(0.8123 * i, 0.0, 1.8) for i in range(N)])
        stamps_ns = np.arange(N) * 100_000_000
        return Drive(Path("d"), "v", "d", SENSORS["vlp16"], stamps_ns, self.read, T_map_lidar_prior=T)


def test_no_scan_is_read_only_to_be_looked_at_but_a_few_at_first() -> None:
    recording = Recording()
    watched = looked_at(recording.drive())
    first = recording.reads.sum()
    assert first == 28  # 24, one of them again for its columns, three for their beams
    for _ in watched.drive:
        pass
    assert watched.warnings() == []
    assert recording.reads.sum() == first + N + 4


@pytest.mark.parametrize("read", [N, 0])
def test_warnings_at_the_end_are_those_of_a_look_at_every_scan_read_or_not(read: int) -> None:
    spoilt = Recording(cut=range(UNSAMPLED, UNSAMPLED + 3))
    watched = looked_at(spoilt.drive())
    for i in range(read):
        watched.drive.read_scan(i)
    found = cheap_checks(spoilt.drive(), Looking(spoilt.drive()).look(range(N)))
    said = [f.what for f in watched.warnings()]
    assert said == [f.what for f in found if f.severity == "warning"]
    assert [line for line in said if "cut off?" in line] == [
        "scan 60 holds 1000 points, those around it 3000: cut off? (3 such scans)"
    ]


def test_a_file_torn_in_the_middle_stops_whoever_reads_it_and_is_told_at_the_end_too() -> None:
    watched = looked_at(Recording(torn=UNSAMPLED).drive())
    with pytest.raises(MapvoteError, match=r"000060\.bin"):
        for _ in watched.drive:
            pass
    with pytest.raises(MapvoteError, match=r"d: 000060.bin: 7 bytes"):
        watched.warnings()


def test_a_fault_of_many_scans_stops_before_the_work_begins() -> None:
    with pytest.raises(MapvoteError, match=r"000000.bin: 7 bytes"):
        looked_at(Recording(torn=0).drive())
    with pytest.raises(MapvoteError, match=r"scan 4 holds 1000 points, those around it 3000: cut off\?.*29 such scans"):
        looked_at(Recording(cut=range(0, N, 4)).drive())


def test_a_drive_whose_sensor_is_stated_wrongly_is_refused_and_a_measured_one_is_not_asked() -> None:
    elevation, azimuth = (a.ravel() for a in np.meshgrid(np.linspace(10.67, -30.67, 32), np.arange(-180, 180, 0.4)))
    away = 20.0 + 10.0 * np.sin(np.radians(5.0 * azimuth))
    c = np.cos(np.radians(elevation))
    ray = np.column_stack(
        [c * np.cos(np.radians(azimuth)), c * np.sin(np.radians(azimuth)), np.sin(np.radians(elevation))]
    )
    drive = Recording().drive()
    seen = replace(drive, read_scan=lambda i: Scan(i, ((away + 0.01 * i)[:, None] * ray).astype("f4")))
    with pytest.raises(MapvoteError, match=r"32 beams from .* as a hdl32e has, but a vlp16 has 16 from"):
        looked_at(seen)
    for stated in ({"sensor": SENSORS["hdl32e"]}, {"sensor_told": "measured: by its rings"}):
        looked_at(replace(seen, **stated))
