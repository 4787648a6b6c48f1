"""Points with named fields (scan files, PCD, PointCloud2) as a Scan: positions, attributes, ring, time of each point.

Points that are no measurements are dropped, counted and reported.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.geometry import azimuth
from mapvote.core.kernel import kernel
from mapvote.core.points import Values, point_fields
from mapvote.core.record import record
from mapvote.core.sensors import UPRIGHT, Sensor
from mapvote.core.types import F32, I32, U16, MapvoteError, Scan, TimesTold, read_only
from mapvote.formats.drives.compressed_cloud import decompressed
from mapvote.formats.drives.point_times import (
    ClockDifference,
    FieldTimes,
    FoundTimes,
    TimeOrigin,
    TimeRules,
    find_times,
    known_time_field,
    no_times,
)
from mapvote.formats.maps.cloud import xyz_view
from mapvote.formats.maps.field_names import known_fields, plain

log = logging.getLogger("mapvote.formats")


@record()
@dataclass(frozen=True, slots=True)
class PointRule:
    """Limits of sound points and rates of scans."""

    most_bad_share: float = 0.05
    """A scan or map with a larger share of broken points is refused: it is damaged, or of another format."""
    far_m: float = 2000.0
    """Points farther than this are broken, metres: no LiDAR measures farther, float64 read as float32 does."""
    least_rate_hz: float = 8.0
    """Scans that come less often than this may have been left out, hertz."""
    greatest_rate_hz: float = 34.0
    """Scans that come more often than this are parts of a revolution, hertz."""


POINT_RULE = PointRule()
_AZIMUTHS_AT_ONCE = 512
_POINT_FIELD = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/PointField's types of numbers."""


@dataclass(slots=True)
class BadPoints:
    """Running count over one drive. Warns at the 1st, 2nd, 4th, 8th ... scan concerned: noticed, without a flood."""

    where: str
    what: str = f"are not finite or beyond {POINT_RULE.far_m:.0f} m"
    points: int = 0
    seen: set[int] = field(default_factory=set)

    def count(self, index: int, n: int) -> None:
        if n == 0 or index in self.seen:
            return
        self.seen.add(index)
        self.points += n
        if len(self.seen) & (len(self.seen) - 1) == 0:
            message = "%s: dropped %d points that %s, in %d scans so far"
            log.warning(message, self.where, self.points, self.what, len(self.seen))


def tell_without_points(source: str, scans: int, names: Sequence[str]) -> str:
    """Log that scans without a point, by their ``names``, are left out; returns the sentence. MapvoteError if all
    ``scans`` are."""
    if len(names) == scans:
        raise MapvoteError(f"{source}: none of its {scans} scans holds a point; record it again")
    listed = ", ".join(names[:3]) + (", .." if len(names) > 3 else "")
    sentence = f"{len(names)} of {scans} scans hold no point and are left out: {listed}"
    log.warning("%s: %s", source, sentence)
    return sentence


@dataclass(slots=True)
class PointReader:
    """Makes scans of points with named fields, for one drive or one LiDAR, whatever its format."""

    where: str
    rules: TimeRules = field(default_factory=TimeRules)
    step_s: float | None = None
    """Between two scans (median), seconds, if known."""
    zero_is_no_return: bool = True
    """Whether a point exactly at the sensor is a ray without return; else it is a defect."""
    bad_points: BadPoints = field(init=False)
    bad_times: BadPoints = field(init=False)
    clocks: ClockDifference = field(default_factory=ClockDifference)

    def __post_init__(self) -> None:
        self.bad_points = BadPoints(self.where)
        self.bad_times = BadPoints(self.where, "hold no time of their scan")

    def scan(self, source: str, index: int, stamp_ns: int, table: NDArray[np.void], sensor: Sensor) -> Scan:
        """A Scan of the usable points of a structured array (n,), in their order.

        Dropped without a message, as the format defines: rays without return (not finite or exactly at the sensor), and
        points nearer than the sensor can measure. Dropped and counted: not finite, beyond 2 km, or with a time that is
        none of this scan. MapvoteError if the counted ones are more than 5 %, if nothing is left, or if a field that
        should hold times does not.
        """
        points = xyz_view(source, table).astype(np.float32, copy=False)
        names = table.dtype.names or ()
        spelled = {plain(name): name for name in reversed(names)}
        beams = ("ring", "channel", "laserid", "lasernumber", "line")  # names of a beam's number
        ring = next((spelled[name] for name in beams if name in spelled), None)
        # Points that are measurements.
        near_m = sensor.min_range_m - 5.0 * sensor.range_sigma_m
        usable = np.empty(len(points), np.int32)
        copied = np.empty((len(points), 3), np.float32)
        n, measured, bad = _sort_out(
            read_only(points), self.zero_is_no_return, near_m, POINT_RULE.far_m, usable, copied
        )
        if bad > POINT_RULE.most_bad_share * max(measured, 1):
            raise MapvoteError(
                f"{source}: {bad} of {measured} points are not finite or beyond {POINT_RULE.far_m:.0f} m, more than "
                f"{POINT_RULE.most_bad_share:.0%}: {_likely_cause(points)}"
            )
        self.bad_points.count(index, bad)
        if n == 0:
            raise MapvoteError(f"{source}: {_why_none_is_usable(points, near_m)}")
        keep: slice | I32 = slice(None) if n == len(points) else usable[:n]
        # Their times; where a point has none it is dropped.
        time_s, times_told = self._times(source, index, stamp_ns, table, keep, copied[:n], sensor)
        xyz = copied[:n]
        if time_s is not None and not np.isfinite(time_s).all():
            good = np.isfinite(time_s)
            keep = np.arange(len(points), dtype=np.int32)[keep][good]
            xyz = np.ascontiguousarray(xyz[good])
            time_s = time_s[good]
        return Scan(
            stamp_ns=stamp_ns,
            points=xyz,
            time_s=time_s,
            fields=_attributes(source, table, keep),
            ring=None if ring is None else _ring(table[ring][keep]),
            times=times_told,
        )

    def _times(
        self,
        source: str,
        index: int,
        stamp_ns: int,
        table: NDArray[np.void],
        keep: slice | I32,
        points: F32,
        sensor: Sensor,
    ) -> tuple[F32 | None, TimesTold]:
        """(seconds after the stamp of the kept points (n, 3), NaN where there is none; how they are known)."""
        names = table.dtype.names or ()
        if self.rules.motion_compensated:
            return None, TimesTold("compensated", "stated: points are motion-compensated")
        axes = {name for axis, name in known_fields(names).items() if axis in "xyz"}
        columns = _Columns(table, [n for n in names if n not in axes and table.dtype[n].shape == ()], keep)
        try:
            field_times = find_times(columns, points, stamp_ns, self._rate_hz(sensor), self.rules)
        except MapvoteError as error:
            raise MapvoteError(f"{source}: {error}") from error
        if field_times.times is not None:
            return self._from_field(source, index, field_times.times, field_times.surprising)
        self._refuse_known(source, field_times)
        if self.rules.motion_compensated is False:
            rate_hz = self._turning_rate_hz(source, sensor)
            if sensor.azimuth_axes != UPRIGHT:
                points = np.ascontiguousarray(points @ np.array(sensor.azimuth_axes).T, dtype=np.float32)
            time_s = spinning_time_s(points, rate_hz, clockwise=sensor.clockwise)
            return time_s, TimesTold("azimuth", f"from the azimuths, at {rate_hz:g} Hz")
        doubtful = bool(field_times.candidates) or any(refusal.varies for refusal in field_times.refused.values())
        return None, TimesTold("none", no_times(field_times, names), doubtful, field_times.candidates)

    def _from_field(self, source: str, index: int, times: FieldTimes, surprising: bool) -> tuple[F32, TimesTold]:
        lost = int(np.isnan(times.after_stamp).sum())
        if lost > POINT_RULE.most_bad_share * len(times.after_stamp):
            raise MapvoteError(
                f"{source}: {lost} of {len(times.after_stamp)} points hold no time of this scan in the field "
                f"{times.name}, more than {POINT_RULE.most_bad_share:.0%}; record it again, leave the scan out "
                f'with --scans, or drop the field (time_field = "none" in drive.toml)'
            )
        self.clocks.check(source, index, times)
        self.bad_times.count(index, lost)
        doubtful = surprising and self.rules.time_field is None
        times_told = TimesTold(
            "field", times.told, doubtful, (times.name,), other_clock=times.origin == TimeOrigin.ANOTHER
        )
        return times.after_stamp.astype(np.float32), times_told

    def _refuse_known(self, source: str, field_times: FoundTimes) -> None:
        """MapvoteError if a field with the name of a time holds something else."""
        name = known_time_field(field_times)
        if name is not None and self.rules.time_field is None:
            raise MapvoteError(
                f"{source}: the field {name} {field_times.refused[name].why}. In drive.toml name the field with the "
                f'times (time_field = "NAME"), or "none" if there is none'
            )

    def _rate_hz(self, sensor: Sensor) -> float:
        """Revolutions per second: as stated, else as scans come, else the sensor's."""
        if self.rules.rate_stated or not self.step_s:
            return sensor.rate_hz
        return float(np.clip(1.0 / self.step_s, 0.1, 100.0))

    def _turning_rate_hz(self, source: str, sensor: Sensor) -> float:
        """The same, for times from azimuths. MapvoteError if scans may have been left out, or the sensor does not
        spin."""
        rate_hz = self._rate_hz(sensor)
        if not sensor.rings:
            raise MapvoteError(
                f"{source}: motion_compensated = false, but no field tells the times of the points, and azimuths do "
                f"not: the points lie on no rings. Record the times, or describe the sensor in drive.toml"
            )
        if not self.rules.rate_stated and not POINT_RULE.least_rate_hz <= rate_hz <= POINT_RULE.greatest_rate_hz:
            raise MapvoteError(
                f"{source}: motion_compensated = false, and scans come every {1.0 / rate_hz:.3g} s: state how often "
                f"the sensor turns (rate_hz in drive.toml), for scans may have been left out"
            )
        return rate_hz


class _Columns(Mapping[str, Values]):
    """Columns (n,) of the kept points by name. Each is copied when it is asked for: messages have up to ten."""

    def __init__(self, table: NDArray[np.void], names: list[str], keep: slice | I32) -> None:
        self._table = table
        self._names = names
        self._keep = keep

    def __getitem__(self, name: str) -> Values:
        if name not in self._names:
            raise KeyError(name)
        return _column(self._table, name, self._keep)

    def __contains__(self, name: object) -> bool:
        return name in self._names  # Mapping's would copy the column

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _column(table: NDArray[np.void], name: str, keep: slice | I32) -> Values:
    """One column (n,) of the kept points, copied: in a message its values lie 20 bytes and more apart."""
    return np.ascontiguousarray(table[name][keep])


def _attributes(source: str, table: NDArray[np.void], keep: slice | I32) -> dict[str, Values]:
    """The attributes of the kept points that the table (n,) has. MapvoteError if one holds what it cannot be."""
    names = table.dtype.names or ()
    map_fields = known_fields(names)
    spelled = {plain(name): name for name in reversed(names)}
    attributes = {}
    for name, row in point_fields().items():
        column = next((spelled[other] for other in (plain(name), *row.spellings) if other in spelled), None)
        column = map_fields.get(name, column)
        if column is None:
            continue
        try:
            attributes[name] = row.in_scan(_column(table, column, keep))
        except MapvoteError as error:
            raise MapvoteError(f"{source}: field {column}: {error}") from error
    return attributes


def _ring(values: NDArray[np.number]) -> U16:
    """(n,) beams; a number that uint16 cannot hold becomes the nearest that it can."""
    if values.dtype in (np.uint8, np.uint16):
        return values.astype(np.uint16)
    return np.clip(np.nan_to_num(values), 0, 65535).astype(np.uint16)


@kernel
def _sort_out(
    points: NDArray[np.floating], zero_is_no_return: bool, near_m: float, far_m: float, kept: I32, copied: F32
) -> tuple[int, int, int]:
    """(how many of the points (n, 3) are usable, how many were measured, how many of these are no measurements). The
    indices of the usable ones come into ``kept`` (n,), they themselves into ``copied`` (n, 3)."""
    n = 0
    measured = 0
    bad = 0
    for i in range(len(points)):
        x = np.float64(points[i, 0])
        y = np.float64(points[i, 1])
        z = np.float64(points[i, 2])
        squared = x * x + y * y + z * z
        if zero_is_no_return and (squared == 0.0 or not np.isfinite(squared)):
            continue
        measured += 1
        if not squared < far_m * far_m:  # True for NaN too
            bad += 1
        elif squared >= near_m * abs(near_m):
            kept[n] = i
            copied[n, 0] = x
            copied[n, 1] = y
            copied[n, 2] = z
            n += 1
    return n, measured, bad


def _why_none_is_usable(points: F32, near_m: float) -> str:
    """Possible causes why no point of a scan (n, 3) is a measurement, and what to do."""
    if len(points) == 0:
        return "it holds no points; leave this scan out with --scans"
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(points.astype(np.float64), axis=1)
    distance = distance[np.isfinite(distance) & (distance > 0.0)]
    if len(distance) == 0:
        return f"none of {len(points)} rays has a return (a covered sensor?); leave this scan out with --scans"
    none = f"no usable point among {len(points)}, all nearer than {near_m:.1f} m"
    if float(np.median(distance)) > 0.001 and float(distance.max()) < POINT_RULE.far_m / 1000.0:
        return f"{none}: they look like kilometres (the farthest {distance.max():.3f}); multiply x, y, z by 1000"
    return f"{none}: are they metres? Else leave this scan out with --scans"


def _likely_cause(points: F32) -> str:
    with np.errstate(invalid="ignore"):  # damaged numbers
        distance = np.linalg.norm(points.astype(np.float64), axis=1)
    finite = distance[np.isfinite(distance)]
    farthest = float(np.quantile(finite, 0.99)) if len(finite) else 0.0
    if len(finite) > 0.9 * len(distance) and POINT_RULE.far_m < farthest < 300_000.0:
        unit, factor = ("millimetres", 1000) if farthest > 15_000.0 else ("centimetres", 100)
        return f"they look like {unit} (the farthest {farthest:.0f}); divide x, y, z by {factor}"
    return "the file is damaged, or not float32 x, y, z, intensity"


def spinning_time_s(points: F32, rate_hz: float, *, clockwise: bool = True) -> F32:
    """When each point (n, 3) was measured, relative to the middle of the revolution, by its azimuth.

    The sensor faces forward at the stamp: -azimuth / (2 pi rate) if it turns clockwise seen from above.
    """
    out, (x, y) = np.empty(len(points), np.float32), np.empty((2, _AZIMUTHS_AT_ONCE), np.float32)
    _spinning_time_s(read_only(points), np.float32((-2.0 if clockwise else 2.0) * np.pi * rate_hz), x, y, out)
    return out


@kernel
def _spinning_time_s(points: F32, turn_per_s: np.float32, x: F32, y: F32, out: F32) -> None:
    """:func:`spinning_time_s` into ``out`` (n,), block by block: x and y, which lie three numbers apart in ``points``,
    are copied into ``x`` and ``y`` (_AZIMUTHS_AT_ONCE,) first, so that the loop vectorises."""
    for start in range(0, len(points), _AZIMUTHS_AT_ONCE):
        n = min(_AZIMUTHS_AT_ONCE, len(points) - start)
        for i in range(n):
            x[i] = points[start + i, 0]
            y[i] = points[start + i, 1]
        for i in range(n):
            out[start + i] = azimuth(y[i], x[i]) / turn_per_s


def point_cloud_table(source: str, message: Any) -> NDArray[np.void]:
    """The points of a PointCloud2 or CompressedPointCloud2 as a structured array (n,), little-endian.

    ``message``: rosbags', rclpy's or any object with its fields. MapvoteError if its sizes contradict each other, or
    its points are compressed in a format that is not read.
    """
    sent = decompressed(source, message) if hasattr(message, "compressed_data") else message.data
    raw = sent if isinstance(sent, np.ndarray) else bytes(sent)  # an array is not copied
    data = np.frombuffer(raw, dtype=np.uint8)
    row = message.width * message.point_step
    if message.height > 1 and message.row_step != row and len(data) == message.height * message.row_step:
        data = np.ascontiguousarray(data.reshape(message.height, message.row_step)[:, :row]).ravel()
    if len(data) != message.height * row or message.point_step <= 0:
        raise MapvoteError(
            f"{source}: {len(data)} bytes, but its header says {message.height * row}: the message is cut off"
        )
    order = ">" if message.is_bigendian else "<"
    try:
        numeric = [f for f in message.fields if f.datatype in _POINT_FIELD]
        record = np.dtype(
            {
                "names": [f.name for f in numeric],
                "formats": [(order + _POINT_FIELD[f.datatype], (f.count,) if f.count > 1 else ()) for f in numeric],
                "offsets": [f.offset for f in numeric],
                "itemsize": message.point_step,
            }
        )
    except (ValueError, TypeError) as error:
        raise MapvoteError(f"{source}: its fields do not fit its point_step ({error}); is the driver sound?") from error
    table = data.view(record)
    return table.astype(record.newbyteorder("<")) if message.is_bigendian else table


def livox_table(source: str, data: bytes | memoryview, *, ros2: bool) -> NDArray[np.void]:
    """The points (n,) of a serialised CustomMsg of Livox's drivers: offset_time in ns since the stamp, x, y, z,
    reflectivity, tag, line.

    Before them stand header, timebase (uint64), number of points (uint32), lidar_id (uint8) and rsvd (uint8[3]). CDR
    (ROS 2) pads each point to 20 bytes; ROS 1 has 19. MapvoteError if the message is cut off.
    """
    try:
        # header.frame_id, after the stamp; CDR counts its alignment from the fifth byte
        length = struct.unpack_from("<I", data, 12)[0]
        at = 16 + length
        if ros2:
            at = 4 + -(-(at - 4) // 8) * 8
        count = struct.unpack_from("<I", data, at + 16)[0]
    except struct.error as error:
        raise MapvoteError(f"{source}: a CustomMsg of {len(data)} bytes has no header; copy the bag again") from error
    size = 20 if ros2 else 19
    start = at + 20
    if len(data) - start < count * size - (size - 19 if count else 0):
        raise MapvoteError(
            f"{source}: {len(data)} bytes for {count} points: the message is cut off; copy the bag again"
        )
    record = np.dtype(
        {
            "names": ["offset_time", "x", "y", "z", "reflectivity", "tag", "line"],
            "formats": ["<u4", "<f4", "<f4", "<f4", "u1", "u1", "u1"],
            "offsets": [0, 4, 8, 12, 16, 17, 18],
            "itemsize": size,
        }
    )
    whole = bytes(data[start : start + count * size]).ljust(count * size, b"\0")
    return np.frombuffer(whole, dtype=record)


def serialised_stamp_ns(source: str, data: bytes | memoryview, *, ros2: bool) -> int:
    """The stamp in the header of a serialised message, nanoseconds, without reading the rest. MapvoteError if the
    message is too short."""
    if len(data) < 12:
        raise MapvoteError(f"{source}: a message of {len(data)} bytes has no header; copy the bag again")
    seconds, nanoseconds = struct.unpack_from(f"{_order(data, ros2)}II", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def serialised_frame(data: bytes | memoryview, *, ros2: bool) -> str:
    """The frame in the header of a serialised message, without reading the rest; "" if the message is too short."""
    length = struct.unpack_from(f"{_order(data, ros2)}I", data, 12)[0] if len(data) >= 16 else 0
    return bytes(data[16 : 16 + length]).rstrip(b"\0").decode(errors="replace")


def _order(data: bytes | memoryview, ros2: bool) -> str:
    """The order of bytes for struct: CDR (ROS 2) states it, ROS 1 is little-endian."""
    return "<" if not ros2 or data[1] & 1 else ">"


def stamp_of(message: Any) -> int:
    """Nanoseconds of the stamp in a message's header."""
    stamp = message.header.stamp
    return int(getattr(stamp, "sec", 0)) * 10**9 + int(getattr(stamp, "nanosec", 0))


def scan_from_point_cloud2(message: Any, sensor: Sensor, reader: PointReader | None = None) -> Scan:
    """A live sensor_msgs/PointCloud2 as a Scan: of rclpy, rosbags, or any object with its fields.

    Its stamp is the message's; a field of times makes it be de-skewed, attributes and ``ring`` are kept. ``reader``:
    of the LiDAR, with what is stated of its times. MapvoteError if the message is cut off, has no x, y, z, or holds no
    usable point.
    """
    stamp_ns = stamp_of(message)
    source = f"PointCloud2 in {message.header.frame_id or 'no frame'} at {stamp_ns}"
    table = point_cloud_table(source, message)
    return (reader or PointReader(source)).scan(source, stamp_ns, stamp_ns, table, sensor)
