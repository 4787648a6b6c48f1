"""ROS 2 messages as DDS carries them: CDR bytes, read and written by the definitions of their types.

Plain CDR (OMG DDS-XTypes 1.3, 7.4.3): four bytes of header, then every number aligned to its size, counted from behind
the header; strings and sequences have their length in front. Sequences of numbers are views of the bytes: the points of
a cloud are not copied.
"""

from __future__ import annotations

import re
import struct
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from mapvote.core.types import MapvoteError

_DEFINITIONS = """
builtin_interfaces/msg/Time: int32 sec, uint32 nanosec
std_msgs/msg/Header: Time stamp, string frame_id
geometry_msgs/msg/Point: float64 x, float64 y, float64 z
geometry_msgs/msg/Vector3: float64 x, float64 y, float64 z
geometry_msgs/msg/Quaternion: float64 x, float64 y, float64 z, float64 w
geometry_msgs/msg/Pose: Point position, Quaternion orientation
geometry_msgs/msg/PoseStamped: Header header, Pose pose
geometry_msgs/msg/PoseWithCovariance: Pose pose, float64[36] covariance
geometry_msgs/msg/PoseWithCovarianceStamped: Header header, PoseWithCovariance pose
geometry_msgs/msg/Twist: Vector3 linear, Vector3 angular
geometry_msgs/msg/TwistWithCovariance: Twist twist, float64[36] covariance
geometry_msgs/msg/Transform: Vector3 translation, Quaternion rotation
geometry_msgs/msg/TransformStamped: Header header, string child_frame_id, Transform transform
nav_msgs/msg/Odometry: Header header, string child_frame_id, PoseWithCovariance pose, TwistWithCovariance twist
tf2_msgs/msg/TFMessage: TransformStamped[] transforms
sensor_msgs/msg/PointField: string name, uint32 offset, uint8 datatype, uint32 count
sensor_msgs/msg/PointCloud2: Header header, uint32 height, uint32 width, PointField[] fields, bool is_bigendian,
    uint32 point_step, uint32 row_step, uint8[] data, bool is_dense
sensor_msgs/msg/NavSatStatus: int8 status, uint16 service
sensor_msgs/msg/NavSatFix: Header header, NavSatStatus status, float64 latitude, float64 longitude, float64 altitude,
    float64[9] position_covariance, uint8 position_covariance_type
sensor_msgs/msg/Imu: Header header, Quaternion orientation, float64[9] orientation_covariance, Vector3 angular_velocity,
    float64[9] angular_velocity_covariance, Vector3 linear_acceleration, float64[9] linear_acceleration_covariance
diagnostic_msgs/msg/KeyValue: string key, string value
diagnostic_msgs/msg/DiagnosticStatus: byte level, string name, string message, string hardware_id, KeyValue[] values
diagnostic_msgs/msg/DiagnosticArray: Header header, DiagnosticStatus[] status
"""
NUMBERS = {
    "bool": "?", "byte": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_ENCODINGS = {0: (">", 8), 1: ("<", 8), 6: (">", 4), 7: ("<", 4)}
"""Byte order and largest alignment by the header's second byte: CDR, and the plain encoding of XCDR2."""
_STRUCTS = {(order, code): struct.Struct(order + code) for order in "<>" for code in NUMBERS.values()}
_HEADER = b"\0\1\0\0"
"""CDR, little-endian."""


class Field(NamedTuple):
    """One member of a message."""

    name: str
    kind: str
    """A number's type, ``string``, or the full name of a message type."""
    length: int | None
    """None: one value; 0: a sequence of any length; more: an array of so many."""


TYPES: dict[str, list[Field]] = {}
"""The members of each known message type, by its full name such as sensor_msgs/msg/PointCloud2."""


def define(definitions: str) -> None:
    """Add message types, a line each, after the types they use: ``package/msg/Name: type member, type[] member``."""
    for line in re.sub(r"\n +", " ", definitions.strip()).splitlines():
        name, members = line.split(": ", 1)
        by_short_name = {known.rsplit("/", 1)[1]: known for known in TYPES}
        fields = []
        for member in members.split(", "):
            kind, called = member.split()
            base, bracket, length = kind.rstrip("]").partition("[")
            plain = base in NUMBERS or base == "string"
            fields.append(Field(called, base if plain else by_short_name[base], int(length or 0) if bracket else None))
        TYPES[name] = fields


define(_DEFINITIONS)


def blank_message(kind: str, **members: Any) -> Any:
    """A message of this type: zeros and empty strings, but for ``members``."""
    out = SimpleNamespace(**{field.name: _blank(field) for field in TYPES[kind]})
    for name, value in members.items():
        if not hasattr(out, name):
            raise TypeError(f"{kind} has no member {name}")
        setattr(out, name, value)
    return out


def _blank(field: Field) -> Any:
    if field.length is not None:
        return np.zeros(field.length) if field.length else []
    return 0 if field.kind in NUMBERS else "" if field.kind == "string" else blank_message(field.kind)


def from_cdr(kind: str, data: bytes | memoryview) -> Any:
    """The message, its members as attributes; numbers of a sequence as an array that is a view of ``data``.

    MapvoteError if the bytes end too early or are in an encoding that ROS 2 does not use.
    """
    if len(data) < 4 or data[0] != 0 or data[1] not in _ENCODINGS:
        raise MapvoteError(f"{kind}: {data[:4].hex(' ') or 'no bytes'} begins no plain CDR; was ROS 2 the sender?")
    try:
        return _Reader(data, *_ENCODINGS[data[1]]).message(kind)
    except (struct.error, ValueError, UnicodeDecodeError, MemoryError) as error:
        raise MapvoteError(f"{kind}: a message of {len(data)} bytes is cut off or damaged ({error})") from error


def to_cdr(kind: str, message: Any) -> bytes:
    """The message in little-endian CDR. Sequences of numbers may be given as bytes or arrays."""
    out = bytearray()
    _write(out, kind, message)
    return _HEADER + bytes(out) + bytes(-len(out) % 4)


def stamp_ns(header: Any) -> int:
    """The time in a std_msgs/Header, nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def header_of(time_ns: int, frame_id: str) -> Any:
    """A std_msgs/Header."""
    time = blank_message("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return blank_message("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


class _Reader:
    """Reads one message from front to back."""

    def __init__(self, data: bytes | memoryview, order: str, most_aligned: int) -> None:
        self.data, self.order, self.most_aligned, self.at = data, order, most_aligned, 4

    def align(self, size: int) -> None:
        self.at += -(self.at - 4) % min(size, self.most_aligned)

    def number(self, code: str) -> Any:
        one = _STRUCTS[self.order, code]
        self.align(one.size)
        (value,) = one.unpack_from(self.data, self.at)
        self.at += one.size
        return value

    def string(self) -> str:
        length = self.number("I")
        if length > len(self.data) - self.at:
            raise ValueError(f"a string of {length} bytes")
        text = self.data[self.at : self.at + max(length - 1, 0)]
        self.at += length
        return str(text, "utf-8", "replace")

    def numbers(self, code: str, count: int) -> Any:
        size = struct.calcsize(code)
        if count:
            self.align(size)
        out = np.frombuffer(self.data, np.dtype(self.order + code), count, self.at) if count else np.empty(0, code)
        self.at += size * count
        return out

    def value(self, kind: str) -> Any:
        if kind in NUMBERS:
            return self.number(NUMBERS[kind])
        return self.string() if kind == "string" else self.message(kind)

    def member(self, field: Field) -> Any:
        if field.length is None:
            return self.value(field.kind)
        count = field.length or self.number("I")
        if field.kind in NUMBERS:
            return self.numbers(NUMBERS[field.kind], count)
        if count > len(self.data) - self.at:  # each takes a byte at least
            raise ValueError(f"a sequence of {count}")
        return [self.value(field.kind) for _ in range(count)]

    def message(self, kind: str) -> Any:
        out = SimpleNamespace()
        for field in TYPES[kind]:
            setattr(out, field.name, self.member(field))
        return out


def _write(out: bytearray, kind: str, value: Any) -> None:
    if kind in NUMBERS:
        _pad(out, struct.calcsize(NUMBERS[kind]))
        out += struct.pack("<" + NUMBERS[kind], value)
    elif kind == "string":
        text = value.encode() + b"\0"
        _write(out, "uint32", len(text))
        out += text
    else:
        for field in TYPES[kind]:
            _write_member(out, field, getattr(value, field.name))


def _write_member(out: bytearray, field: Field, value: Any) -> None:
    if field.length is None:
        _write(out, field.kind, value)
        return
    if field.length == 0:
        _write(out, "uint32", len(value))
    elif len(value) != field.length:
        raise ValueError(f"{field.name}: {len(value)} values, not {field.length}")
    if field.kind not in NUMBERS:
        for part in value:
            _write(out, field.kind, part)
    elif len(value):
        code = np.dtype("<" + NUMBERS[field.kind])
        _pad(out, code.itemsize)
        out += value if isinstance(value, bytes | memoryview) else np.ascontiguousarray(value, code).tobytes()


def _pad(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)
