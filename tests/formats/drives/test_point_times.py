"""Times of points: one path from the fields of every format to a scan, by names, units, origins and what is stated.

The scans are those of a spinning LiDAR between walls, so that the azimuth of every point tells its time.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drive_formats import WRITERS, write_drive
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, F64, MapvoteError, Scan
from mapvote.doctor.scans import Looking, cheap_checks
from mapvote.formats import open_drive
from mapvote.formats.drives.point_fields import PointReader
from mapvote.formats.drives.point_times import (
    FieldTimes,
    Refusal,
    TimeOrigin,
    TimeRules,
    read_times,
)

STAMP = 1_700_000_000_123_456_789
RATE_HZ = 10.0
N = 3
STAMPS = STAMP + 100_000_000 * np.arange(N)
Of = Callable[[F64, int], NDArray[Any]]
"""The values of a field, of times after the stamp (n,), seconds, and the stamp, nanoseconds."""


def revolution(seed: int = 0, columns: int = 720, beams: int = 8) -> tuple[F32, F64]:
    """(points (n, 3) between two walls, in no order; their times after the stamp, in the middle of the revolution)."""
    rng = np.random.default_rng(seed)
    azimuth = np.repeat(np.pi - 2.0 * np.pi * (np.arange(columns) + 0.5) / columns, beams)
    elevation = np.radians(np.tile(np.linspace(10.0, -20.0, beams), columns))
    flat_m = np.minimum(np.abs(9.0 / np.sin(azimuth)), 40.0)
    points = np.column_stack([flat_m * np.cos(azimuth), flat_m * np.sin(azimuth), flat_m * np.tan(elevation)])
    order = rng.permutation(len(points))
    return points[order].astype(np.float32), (-azimuth / (2.0 * np.pi * RATE_HZ))[order]


def table(points: F32, **fields: NDArray[Any]) -> NDArray[np.void]:
    kinds = [*((axis, "<f4") for axis in "xyz"), *((name, column.dtype) for name, column in fields.items())]
    out = np.zeros(len(points), dtype=kinds)
    out["x"], out["y"], out["z"] = points.T
    for name, column in fields.items():
        out[name] = column
    return out


def read(
    rules: TimeRules | None = None,
    stamp_ns: int = STAMP,
    others: Mapping[str, NDArray[Any]] | None = None,
    **fields: NDArray[Any],
) -> Scan:
    """The scan of :func:`revolution` with these fields."""
    reader = PointReader("scan", rules or TimeRules(), 1.0 / RATE_HZ)
    return reader.scan("scan", 0, stamp_ns, table(revolution()[0], **(others or {}), **fields), SENSORS["hdl32e"])


POINTS, TIMES = revolution()
TIMES.setflags(write=False)
ROUNDED: dict[str, Of] = {
    "seconds, float32": lambda t, _: t.astype("f4"),
    "seconds, float64": lambda t, _: t.copy(),
    "milliseconds, float32": lambda t, _: (1e3 * t).astype("f4"),
    "microseconds, int32": lambda t, _: np.rint(1e6 * t).astype("i4"),
    "nanoseconds, int32": lambda t, _: np.rint(1e9 * t).astype("i4"),
    "nanoseconds, int64": lambda t, _: np.rint(1e9 * t).astype("i8"),
    "nanoseconds, float32": lambda t, _: (1e9 * t).astype("f4"),
    "nanoseconds, uint32, below zero": lambda t, _: (np.rint(1e9 * t).astype("i8") % 2**32).astype("u4"),
    "seconds since 1970, float64": lambda t, s: s * 1e-9 + t,
    "milliseconds since 1970, float64": lambda t, s: s * 1e-6 + 1e3 * t,
    "microseconds since 1970, uint64": lambda t, s: (s // 1000 + np.rint(1e6 * t).astype("i8")).astype("u8"),
    "nanoseconds since 1970, uint64": lambda t, s: (s + np.rint(1e9 * t).astype("i8")).astype("u8"),
    "nanoseconds since 1970, float64": lambda t, s: s + 1e9 * t,
    "nanoseconds since 1970, uint32": lambda t, s: ((s + np.rint(1e9 * t).astype("i8")) % 2**32).astype("u4"),
    "seconds, big-endian": lambda t, _: t.astype(">f4"),
}


@pytest.mark.parametrize("unit", ROUNDED)
def test_times_are_understood_in_every_unit_type_and_origin(unit: str) -> None:
    scan = read(t=ROUNDED[unit](TIMES, STAMP))
    assert scan.time_s is not None
    assert np.allclose(scan.time_s, TIMES, atol=1.5e-6)
    assert scan.times is not None
    assert scan.times.how == "field"
    assert not scan.times.doubtful


@pytest.mark.parametrize("late_s", [-0.05, 0.0, 0.05], ids=["stamp at the end", "in the middle", "at the start"])
@pytest.mark.parametrize("direction", [1.0, -1.0], ids=["clockwise", "counter-clockwise"])
def test_the_stamp_may_lie_anywhere_in_the_revolution(late_s: float, direction: float) -> None:
    scan = read(t=(direction * TIMES + late_s).astype("f4"))
    assert scan.time_s is not None
    assert np.allclose(scan.time_s, direction * TIMES + late_s, atol=1e-6)


@pytest.mark.parametrize("stamp_s", [0.0, 0.1, 0.3, 5.0])
def test_stamps_that_begin_at_zero_tell_absolute_from_relative(stamp_s: float) -> None:
    stamp_ns = round(stamp_s * 1e9)
    for values in (TIMES + 0.05, TIMES + 0.05 + stamp_s):
        scan = read(stamp_ns=stamp_ns, time=values)
        assert scan.time_s is not None
        assert np.allclose(scan.time_s, TIMES + 0.05, atol=1e-6)


@given(
    off_s=st.floats(-0.05, 0.05),
    unit=st.sampled_from([1.0, 1e-3, 1e-6, 1e-9]),
    wrong=st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=40),
    absolute=st.booleans(),
)
def test_values_of_a_few_points_change_no_other_time(
    off_s: float, unit: float, wrong: list[float], absolute: bool
) -> None:
    values = (TIMES + off_s + (STAMP * 1e-9 if absolute else 0.0)) / unit
    values[: len(wrong)] = wrong
    times = read_times("t", values, POINTS, STAMP, RATE_HZ)
    assert isinstance(times, FieldTimes)
    assert times.origin == (TimeOrigin.AS_STAMP if absolute else TimeOrigin.SINCE_STAMP)
    assert np.allclose(times.after_stamp[len(wrong) :], TIMES[len(wrong) :] + off_s, atol=1e-6)
    kept = times.after_stamp[: len(wrong)]
    assert (np.abs(kept[np.isfinite(kept)]) < 0.3).all()


@pytest.mark.parametrize(
    ("value", "of"),
    [
        (0.0, "seconds since 1970, float64"),
        (50.0, "seconds, float32"),
        (2_200_000, "microseconds, int32"),
        (np.nan, "seconds, float32"),
        (np.inf, "seconds, float64"),
    ],
)
def test_a_wrong_time_is_dropped_with_its_point_and_counted(
    value: float, of: str, caplog: pytest.LogCaptureFixture
) -> None:
    values = ROUNDED[of](TIMES, STAMP)
    values[[7, 5000]] = value
    with caplog.at_level(logging.WARNING):
        scan = read(t=values, intensity=np.arange(len(TIMES), dtype="f4") / 1e5)
    good = np.delete(np.arange(len(TIMES)), [7, 5000])
    assert np.array_equal(scan.points, POINTS[good])
    assert scan.time_s is not None
    assert np.allclose(scan.time_s, TIMES[good], atol=1e-6)
    assert np.allclose(scan.fields["intensity"], good / 1e5, atol=1e-6)
    assert "dropped 2 points that hold no time of their scan" in caplog.text
    values[: len(values) // 10] = value
    with pytest.raises(MapvoteError, match=r"points hold no time of this scan in the field t, more than 5%"):
        read(t=values)


def test_a_ray_without_return_may_hold_any_time() -> None:
    points = POINTS.copy()
    points[::3] = 0.0
    values = TIMES + STAMP * 1e-9
    values[::3] = 0.0
    reader = PointReader("scan", TimeRules(), 0.1)
    scan = reader.scan("scan", 0, STAMP, table(points, timestamp=values), SENSORS["hdl32e"])
    assert scan.time_s is not None
    assert np.allclose(scan.time_s, np.delete(TIMES, np.s_[::3]), atol=1e-6)


COLUMN = np.rint((TIMES + 0.05) * 1024 * RATE_HZ)
NO_TIMES: dict[str, tuple[NDArray[Any], str]] = {
    "a counter of points": (np.arange(len(TIMES)).astype("u4"), "a counter, a column or a ring"),
    "a column": (COLUMN.astype("u2"), "grows by 1024 in a revolution, which is a LiDAR's in no unit"),
    "a column as float": (COLUMN.astype("f4"), "grows by 1024 in a revolution"),
    "a packet": (np.floor((TIMES + 0.05) * 1800).astype("u2"), "a counter, a column or a ring"),
    "a ring": (np.tile(np.arange(32), len(TIMES))[: len(TIMES)].astype("u1"), "a counter, a column or a ring"),
    "seconds since 1970 as float32": ((TIMES + STAMP * 1e-9).astype("f4"), "float32, which cannot tell points apart"),
    "a revolution of 69 ms": (0.69 * TIMES, "a revolution takes 0.069 s, but scans come every 0.1 s"),
    "a revolution of 2 s": (20 * TIMES, "grows by 2 in a revolution"),
}


@pytest.mark.parametrize("kind", NO_TIMES)
def test_a_field_with_the_name_of_a_time_that_holds_none_is_an_error(kind: str) -> None:
    values, why = NO_TIMES[kind]
    with pytest.raises(MapvoteError, match=rf"the field timestamp .*{why}.*time_field = \"NAME\""):
        read(timestamp=values)
    scan = read(TimeRules(time_field="none"), timestamp=values)
    assert scan.time_s is None
    beside = read(timestamp=values, t_us=np.rint(1e6 * TIMES).astype("i4"))
    assert beside.time_s is not None
    assert np.allclose(beside.time_s, TIMES, atol=1e-6)


@pytest.mark.parametrize("values", [np.zeros(len(TIMES)), np.full(len(TIMES), np.nan), np.full(len(TIMES), 1e9)])
def test_a_field_with_one_value_tells_nothing(values: F64) -> None:
    scan = read(time=values)
    assert scan.time_s is None
    assert scan.times is not None
    assert scan.times.how == "none"
    turned = read(TimeRules(motion_compensated=False), time=values)
    assert turned.time_s is not None
    assert np.allclose(turned.time_s, TIMES, atol=1e-6)


def test_times_of_some_points_only_are_times_of_these(caplog: pytest.LogCaptureFixture) -> None:
    """The others hold 0, which is the time of the stamp."""
    known = np.arange(len(TIMES)) % 25 != 0
    with caplog.at_level(logging.WARNING):
        scan = read(t=np.where(known, TIMES, 0.0))
    assert scan.time_s is not None
    assert np.allclose(scan.time_s, TIMES[known], atol=1e-6)
    assert "dropped 231 points that hold no time of their scan" in caplog.text
    with pytest.raises(MapvoteError, match=r"2880 of 5760 points hold no time of this scan in the field t"):
        read(t=np.where(np.arange(len(TIMES)) % 2, TIMES, 0.0))


@pytest.mark.parametrize("name", ["time_offset_ns", "relative_timestamp", "T", "scalar_GpsTime", "dt", "a", "delta"])
def test_a_field_of_any_name_that_lasts_a_revolution_is_taken_for_the_times(name: str) -> None:
    ring = np.tile(np.arange(8), len(TIMES) // 8).astype("u2")
    other = {"azimuth": np.degrees(np.arctan2(POINTS[:, 1], POINTS[:, 0])), "ring": ring, "range": POINTS[:, 0] + 50.0}
    scan = read(others={**other, name: np.rint(1e9 * TIMES).astype("i4")})
    assert scan.time_s is not None
    assert np.allclose(scan.time_s, TIMES, atol=1e-6)
    assert scan.times is not None
    assert scan.times.fields == (name,)
    assert scan.times.doubtful == (name not in ("T", "scalar_GpsTime"))
    assert read(others=other).time_s is None  # the azimuth itself is no time


def test_times_in_two_fields_are_joined_across_the_second() -> None:
    stamp_ns = 1_700_000_000_010_000_000  # the revolution begins before the full second
    ns = stamp_ns + np.rint(1e9 * TIMES).astype("i8")
    scan = read(stamp_ns=stamp_ns, sec=(ns // 10**9).astype("u4"), nsec=(ns % 10**9).astype("u4"))
    assert scan.time_s is not None
    assert np.allclose(scan.time_s, TIMES, atol=1e-6)


def test_another_clock_is_told_and_must_keep_its_distance() -> None:
    reader = PointReader("drive", TimeRules(), 0.1)
    points, t = revolution()
    for i, off_s in enumerate((0.0, 0.2)):  # the clock drifts a little
        values = 1000.0 + 0.1 * i + off_s + t
        scan = reader.scan("scan", i, STAMP + i * 10**8, table(points, timestamp=values), SENSORS["hdl32e"])
        assert scan.time_s is not None
        assert np.allclose(scan.time_s, t - t.min(), atol=1e-6)
        assert scan.times is not None
        assert scan.times.other_clock
    with pytest.raises(MapvoteError, match="stamps and points belong to different scans"):
        reader.scan("scan", 2, STAMP + 2 * 10**8, table(points, timestamp=1005.0 + t), SENSORS["hdl32e"])
    times = read_times("t", 1000.0 + t, points, STAMP, RATE_HZ)
    assert isinstance(times, FieldTimes)
    assert times.origin == TimeOrigin.ANOTHER


@pytest.mark.parametrize(("every", "rate_hz"), [(2, 5.0), (3, 10.0 / 3), (10, 1.0), (47, 10.0 / 47)])
def test_scans_may_be_left_out(every: int, rate_hz: float) -> None:
    for values in (TIMES, 1e6 * TIMES, np.rint(1e9 * TIMES).astype("i8")):
        times = read_times("t", values, POINTS, STAMP, rate_hz)
        assert isinstance(times, FieldTimes), (every, times)
        assert np.allclose(times.after_stamp, TIMES, atol=1e-6)


def test_a_sensor_that_does_not_spin_is_read_by_the_length_of_the_scan() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(5, 40, (20_000, 3)).astype("f4")
    t = np.sort(rng.uniform(0.0, 0.1, len(points)))
    for name, values in (("offset_time", np.rint(1e9 * t).astype("u4")), ("since", 1e3 * t)):
        reader = PointReader("scan", TimeRules(), 0.1)
        scan = reader.scan("scan", 0, STAMP, table(points, **{name: values}), SENSORS["hdl32e"])
        assert scan.time_s is not None
        assert np.allclose(scan.time_s, t, atol=1e-6)
    shuffled = rng.permutation(1e3 * t)
    reader = PointReader("scan", TimeRules(), 0.1)
    scan = reader.scan("scan", 0, STAMP, table(points, since=shuffled), SENSORS["hdl32e"])
    assert scan.time_s is None
    assert scan.times is not None
    assert scan.times.fields == ("since",)
    assert isinstance(read_times("t", 25 * t, points, STAMP, RATE_HZ), Refusal)


def test_a_stated_field_wins() -> None:
    nothing = read(t=TIMES, t2=1e3 * TIMES)
    assert nothing.times is not None
    assert nothing.times.fields == ("t",)
    assert read(TimeRules(motion_compensated=True), t=TIMES).time_s is None
    named = read(TimeRules(time_field="t2"), t=TIMES, t2=1e3 * TIMES)
    assert named.times is not None
    assert named.times.fields == ("t2",)
    assert not named.times.doubtful
    stated = read(TimeRules(time_field="t", time_unit="s"), t=0.69 * TIMES)
    assert stated.time_s is not None
    assert np.allclose(stated.time_s, 0.69 * TIMES, atol=1e-6)
    with pytest.raises(MapvoteError, match=r"time_field = 'u': no such field; the fields are t"):
        read(TimeRules(time_field="u"), t=TIMES)
    with pytest.raises(MapvoteError, match=r"time_field = 't': the field holds 1 different value in a scan; state"):
        read(TimeRules(time_field="t"), t=0.0 * TIMES)


def test_azimuths_tell_times_only_of_a_sensor_that_spins_at_a_known_rate() -> None:
    rules = TimeRules(motion_compensated=False)
    spinning = SENSORS["hdl32e"]
    twice = PointReader("scan", rules, 0.05).scan("scan", 0, 0, table(POINTS), spinning)
    assert twice.time_s is not None
    assert np.allclose(twice.time_s, TIMES / 2, atol=1e-6)  # scans come 20 times a second
    with pytest.raises(MapvoteError, match=r"scans come every 0\.2 s: state how often the sensor turns \(rate_hz"):
        PointReader("scan", rules, 0.2).scan("scan", 0, 0, table(POINTS), spinning)
    stated = PointReader("scan", replace(rules, rate_stated=True), 0.2).scan("scan", 0, 0, table(POINTS), spinning)
    assert stated.time_s is not None
    assert np.allclose(stated.time_s, TIMES, atol=1e-6)
    with pytest.raises(MapvoteError, match="the points lie on no rings"):
        PointReader("scan", rules, 0.1).scan("scan", 0, 0, table(POINTS), replace(spinning, rings=False))


FORMATS = (*WRITERS, "bag", "livox")


def in_format(path: Path, suffix: str, name: str | None, of: Of, **toml: object) -> Path:
    """A drive of N revolutions in a format, with a field of times and rings."""
    ring = (np.arange(len(TIMES)) % 8).astype("u2")
    rest = {"reflectivity": ring.astype("u1"), "line": ring.astype("u1")} if suffix == "livox" else {"ring": ring}
    tables = []
    for i in range(N):
        points, t = revolution(i)
        times = {} if name is None else {name: of(t, int(STAMPS[i]))}
        tables.append(table(points, **times, **rest))
    T = np.tile(np.eye(4), (N, 1, 1))
    T[:, 0, 3] = np.arange(N)
    return write_drive(path, suffix, tables, STAMPS, T, sensor="hdl32e", **toml)


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_brings_times_rings_and_points(tmp_path: Path, suffix: str) -> None:
    """The stamp lies at the start of the revolution, as Livox's driver sets it."""
    name = "offset_time" if suffix == "livox" else "t"
    path = in_format(tmp_path / "d", suffix, name, lambda t, _: np.rint(1e9 * (t + 0.05)).astype("u4"))
    drive = open_drive(path)
    assert drive.stamps_ns.tolist() == STAMPS.tolist()
    for i, scan in enumerate(drive):
        points, t = revolution(i)
        assert np.allclose(scan.points, points, atol=2e-5)
        assert scan.time_s is not None
        assert np.allclose(scan.time_s, t + 0.05, atol=1e-6)
        assert scan.ring is not None
        assert suffix == "livox" or np.array_equal(scan.ring, np.arange(len(t)) % 8)


@pytest.mark.parametrize("suffix", [suffix for suffix in FORMATS if suffix != "livox"])
def test_every_format_obeys_what_is_stated_of_motion(tmp_path: Path, suffix: str) -> None:
    path = in_format(tmp_path / "d", suffix, None, ROUNDED["seconds, float32"], motion_compensated=False)
    for i, scan in enumerate(open_drive(path)):
        assert scan.time_s is not None
        assert np.allclose(scan.time_s, revolution(i)[1], atol=1e-6)
    assert open_drive(path, motion_compensated=True).read_scan(0).time_s is None
    timed = in_format(tmp_path / "t", suffix, "t", ROUNDED["seconds, float32"], motion_compensated=True)
    assert open_drive(timed).read_scan(0).time_s is None


def findings(path: Path) -> list[str]:
    drive = open_drive(path)
    looks = Looking(drive).look(range(len(drive)))
    return [f"{f.severity}: {f.what} ({f.mend})" for f in cheap_checks(drive, looks)]


@pytest.mark.parametrize("suffix", [".ply", ".pcd", "bag"])
def test_the_doctor_tells_what_it_took_for_times_or_which_fields_there_are(tmp_path: Path, suffix: str) -> None:
    unknown = in_format(tmp_path / "u", suffix, "time_offset_ns", ROUNDED["nanoseconds, int32"])
    assert any(
        f.startswith("warning: the times of points are taken from time_offset_ns, ns since the stamp")
        and 'time_field = "time_offset_ns"' in f
        for f in findings(unknown)
    )
    stated = in_format(
        tmp_path / "s", suffix, "time_offset_ns", ROUNDED["nanoseconds, int32"], time_field="time_offset_ns"
    )
    assert not any("times of points" in f for f in findings(stated))
    without = in_format(tmp_path / "w", suffix, "quality", lambda t, _: np.arange(len(t)).astype("f4"))
    assert any("carry no times" in f and "quality" in f for f in findings(without))
    compensated = in_format(tmp_path / "c", suffix, None, ROUNDED["seconds, float32"], motion_compensated=True)
    assert not any("times" in f for f in findings(compensated) if not f.startswith("warning: only"))
