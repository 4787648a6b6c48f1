"""The header of a table of poses: roles and units of its columns.

Headers of EuRoC (``#timestamp [ns], p_RS_R_x [m], .., q_RS_w [], q_RS_x []``), of ``rostopic echo -p``
(``%time,field.pose.pose.position.x``), of TUM files with a comment, of CSV. Whatever order they name is obeyed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

_UNITS_OF_POSES = {
    "m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "feet": 0.3048,
    "rad": 1.0, "radian": 1.0, "radians": 1.0, "deg": 0.017453292519943295, "degree": 0.017453292519943295,
    "degrees": 0.017453292519943295, "s": 1e9, "sec": 1e9, "seconds": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0,
}  # fmt: skip
"""Metres, radians or nanoseconds in one."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table."""

    index: int
    name: str
    """Name as in the header."""
    unit: str
    """"deg" of "yaw [deg]" or of "yaw_deg"; "" without one."""

    @property
    def scale(self) -> float | None:
        """Metres, radians or nanoseconds in one; None if the header names no unit."""
        return _UNITS_OF_POSES.get(self.unit)


@dataclass(frozen=True, slots=True)
class Header:
    """The line of a table that names its columns."""

    line: int
    """From 1."""
    names: tuple[str, ...]
    columns: dict[str, Column]
    """By role: x, y, z, qx, .., roll, .., latitude, time."""


def split_row(line: str) -> list[str]:
    """The values of one line, between commas, semicolons, tabs or blanks; quotes are taken off. Commas within numbers
    that semicolons or tabs part are decimal points."""
    text = line.strip()
    apart = next((mark for mark in ";\t" if mark in text), "," if "," in text else None)
    words = [word.strip().strip("\"'").strip() for word in text.split(apart)]
    if apart in (";", "\t"):
        words = [re.sub(r"^([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)$", r"\1.\2", word) for word in words]
    return words


def find_header(lines: Sequence[str]) -> Header | None:
    """The last line before the first row of numbers that names at least three columns; comments may do so. None if no
    line does."""
    best = None
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        words = split_row(line)
        if words and is_number(words[0]):
            break
        header = _header_of(number, line)
        if header is None and best is not None and _are_units(words, best):
            return _with_units(best, number, words)
        best = header or best
        if header is None and not line.lstrip().startswith(("#", "%", "//")):
            break
    return best


_UNITLESS = ("", "-", "1", "none", "unitless")


def _are_units(words: Sequence[str], header: Header) -> bool:
    """Whether a row below the header gives the units of its columns."""
    stripped = [word.strip("[]()").lower() for word in words]
    all_units = all(word in _UNITS_OF_POSES or word in _UNITLESS for word in stripped)
    return all_units and len(words) == len(header.names) and any(word in _UNITS_OF_POSES for word in stripped)


def _with_units(header: Header, line: int, words: Sequence[str]) -> Header:
    """The header, which ends at ``line``, with the units that the row there gives."""
    units = [word.strip("[]()").lower() for word in words]
    columns = {
        role: column if column.unit or units[column.index] in _UNITLESS else replace(column, unit=units[column.index])
        for role, column in header.columns.items()
    }
    return replace(header, line=line, columns=columns)


def _header_of(number: int, line: str) -> Header | None:
    text = re.sub(r"\s+([\[(])", r"\1", line.lstrip("\ufeff#%/ \t"))
    names = split_row(text)
    columns: dict[str, Column] = {}
    for index, name in enumerate(names):
        role, unit = _role(name)
        if role and role not in columns:
            columns[role] = Column(index, name, unit)
    if "stamp" in columns:  # of the header: when it was measured, not when it was received
        columns["time"] = columns.pop("stamp")
    return Header(number, tuple(names), columns) if len(columns) >= 3 else None


@cache
def _roles() -> list[tuple[str, str]]:
    """Roles and patterns of their names, in the order in which they are tried."""
    axes = {"x": "x|east|easting", "y": "y|north|northing", "z": "z|up|altitude|alt|height"}
    place = r"(?:.*_)?(?:position|pos|translation|trans|location|loc)(?:_[a-z]+)*?_?"
    turn = r"(?:.*_)?(?:quaternion|quat|orientation|ori|rotation|rot)(?:_[a-z]+)*?_?"
    return [
        *((axis, rf"(?:utm_?|map_?|world_?|enu_?)?(?:{names})|t_?{axis}|p{axis}|p(?:_[a-z]+)*_{axis}|{place}{axis}")
          for axis, names in axes.items()),
        *((f"q{axis}", rf"q_?{axis}|q(?:_[a-z]+)*_{axis}|{turn}{axis}") for axis in "xyzw"),
        *((angle, rf"(?:.*_)?{angle}") for angle in ("roll", "pitch", "yaw")),
        ("heading", "(?:.*_)?(?:heading|azimuth|course)"),
        ("down", "down"),
        ("latitude", "(?:.*_)?lat(?:itude)?"),
        ("longitude", "(?:.*_)?(?:lon|lng|long|longitude)"),
        ("sigma", "(?:.*_)?(?:sigma|std|stddev|accuracy)(?:_(?:h|xy|horizontal|position))?"),
        ("status", "(?:.*_)?status"),
        ("nanoseconds", "(?:.*_)?(?:nsecs?|nanosecs?|nanoseconds)"),
        ("stamp", "header_stamp(?:_secs?|_seconds)?"),
        ("time", "(?:ros|gps|unix)?_?(?:timestamp|time|stamp)|t|secs?|seconds"),
    ]  # fmt: skip


def _role(name: str) -> tuple[str, str]:
    """(the role of a column or "", the unit that its name tells)."""
    bracket = re.search(r"[\[(]([^\])]*)[\])]", name)
    unit = bracket.group(1).strip().lower() if bracket else ""
    word = re.sub(r"[^a-z0-9]+", "_", re.sub(r"[\[(].*", "", name).lower()).strip("_").removeprefix("field_")
    last = word.rpartition("_")
    if (not unit and last[0] and last[2] in _UNITS_OF_POSES and last[2] not in ("s", "m")) or re.fullmatch(
        r".+_[ms]", word
    ):
        word = last[0]
        unit = last[2]
    if re.search(
        r"(?:^|_)(?:v|vel|velocity|twist|linear|angular|acc|acceleration|bias|b|cov|covariance)(?:_|\d|$)", word
    ):
        return "", ""  # no pose, but its change, its bias or its error
    return next((role for role, pattern in _roles() if re.fullmatch(pattern, word)), ""), unit


def number_in(text: str) -> float:
    """The number that a word of a table is, also as Fortran writes doubles (1.5D+00); NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return float(re.sub(r"(\d|\.)[dD]([-+]?\d+)$", r"\1e\2", text))
    except ValueError:
        return float("nan")


def is_number(text: str) -> bool:
    """Whether a word of a table is a number; NaN and infinity, spelt out, are."""
    return not math.isnan(number_in(text)) or text.strip().lstrip("+-").lower() == "nan"
