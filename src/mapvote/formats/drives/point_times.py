"""When each point of a scan was measured: the field that tells it, its unit and the moment from which it counts.

Every format comes here: files with named fields, messages, columns of numbers. A field is judged by what it holds, on
the points that are kept, by its quartiles: one wrong value decides nothing. Three questions are answered in turn.

Unit. A spinning sensor turns 2.5 to 30 times a second: the azimuths of the points, in order of the field, tell how many
units a revolution takes, and at most one of s, ms, us and ns makes a revolution of that. Where azimuths do not go with
the field (sensors that do not spin, several LiDARs in one cloud), the unit is the one in which the scan lasts nearest
to one revolution. A counter, a column, a ring number are no time in any unit, and are refused.

Origin. Times near 0 count from the scan's stamp, those near the stamp from its epoch. Others count by another clock
(GPS, the sensor's start): then the first point lies at the stamp, and the difference must be the same in all scans.

Outliers. A value farther from the median than a scan can last is no time of this scan.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.record import record
from mapvote.core.types import F32, F64, I64, Bool, MapvoteError
from mapvote.formats.maps.field_names import plain

TIME_FIELDS = ("t", "time", "timestamp", "stamp", "offsettime", "pointtimeoffset", "timeoffset", "gpstime")
"""Names that drivers give the time of a point, plainly spelled: Ouster, Velodyne, Hesai and RoboSense, Autoware, Livox,
LAS."""
_OTHER_FIELDS = re.compile(
    r"^(x|y|z|w|i|rgba?|r|g|b|red|green|blue|.*(red|green|blue)|alpha|nir|ambient|intensity|reflectiv.*|reflectance|remission|ring|channel|"
    r"laser.*|line|row|col|column|range|distance|depth|azimuth|elevation|theta|phi|normal.*|n[xyz]|curvature|label|"
    r"class.*|instance|object.*|tag|return.*|number_of_returns|noise|confidence|near_ir|las_flags|user_data|scan_angle.*|"
    r"point_source_id|scanner_channel|key_point|synthetic|withheld|overlap|edge_of_flight_line|scan_direction_flag)$"
)
"""Names of fields that are no times, lower case."""
UNITS_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


class TimeOrigin(StrEnum):
    """From where the times of points count."""

    SINCE_STAMP = "since the stamp"
    AS_STAMP = "as the stamp counts"
    ANOTHER = "by another clock"


@record()
@dataclass(frozen=True, slots=True)
class TimeJudgement:
    """Numbers by which a field is recognised as the time of points."""

    least_values: int = 16
    """Different values a scan has at least."""
    shared: float = 0.01
    """A value that a larger share of the points has, and ``shared_ratio`` times as many as any other, is no time."""
    shared_ratio: float = 5.0
    """Ratio of the points with the most frequent value to those with the next one, see ``shared``."""
    sample: int = 1024
    """Points whose values and azimuths are read."""
    shortest_turn_s: float = 0.03
    """Shortest revolution of a spinning LiDAR, seconds."""
    longest_turn_s: float = 0.4
    """Longest revolution of a spinning LiDAR, seconds."""
    off_rate: float = 0.15
    """Share by which a revolution may differ from the time between two scans."""
    off_multiple: float = 0.12
    """Where scans were left out: share by which that time may differ from a whole number of revolutions, up to four."""
    goes_round: float = 0.8
    """Mean resultant length of the azimuths about a steady turn, from which the sensor is said to spin."""
    least_turn_rad: float = 5.0
    """Least azimuth that a spinning scan covers, radians."""
    longest_turn_rad: float = 7.6
    """Greatest azimuth that a spinning scan covers, radians."""
    shortest: float = 0.05
    """Least length of a scan where azimuths do not tell, revolutions."""
    longest: float = 2.2
    """Greatest length of a scan where azimuths do not tell, revolutions."""
    reach: float = 1.5
    """Distance from the median to an outlier, revolutions, or twice the interquartile range if that is longer."""
    near_stamp: float = 0.6
    """Greatest median of times that count from the stamp, revolutions."""
    apart_s: float = 1.0
    """Greatest time from the stamp to the median of times that count as the stamp does, and greatest change of the
    difference of two clocks during a drive, seconds."""


JUDGEMENT = TimeJudgement()


@dataclass(frozen=True, slots=True)
class TimeRules:
    """The user's statements on the times of points: drive.toml, or the options of a verb."""

    motion_compensated: bool | None = None
    """True: points have no times. False: points without a field of times get them from their azimuth. None: points are
    de-skewed if a field tells their times."""
    time_field: str | None = None
    """The name of the field, or "none"."""
    time_unit: str | None = None
    """A key of ``UNITS_NS``; None: it is found out."""
    rate_stated: bool = False
    """Whether the sensor's rate is stated, and not taken from the stamps."""


@dataclass(slots=True)
class ClockDifference:
    """By how much the clock of the points is off that of the stamps; the same during a whole drive."""

    off_ns: int | None = None
    index: int = 0
    """The first scan that told it."""

    def check(self, source: str, index: int, times: FieldTimes) -> None:
        """MapvoteError if scan ``index`` tells another difference than the first scan that told one."""
        if times.origin == TimeOrigin.SINCE_STAMP:
            return
        off_ns = times.clock_off_ns
        if self.off_ns is None:
            self.off_ns = off_ns
            self.index = index
        change_ns = off_ns - self.off_ns
        if times.wraps_ns:
            change_ns = (change_ns + times.wraps_ns // 2) % times.wraps_ns - times.wraps_ns // 2
        if abs(change_ns) > JUDGEMENT.apart_s * 1e9:
            raise MapvoteError(
                f"{source}: the times of its points are {off_ns / 1e9:.3f} s off its stamp, those of scan {self.index} "
                f"{self.off_ns / 1e9:.3f} s: stamps and points belong to different scans, or one of two clocks "
                f'jumped. Correct the stamps, or drop the field (time_field = "none" in drive.toml)'
            )


@dataclass(frozen=True, slots=True)
class FieldTimes:
    """A field read as the times of points."""

    name: str
    unit: str
    after_stamp: F64
    """(n,) seconds after the scan's stamp; NaN where the value is no time of this scan."""
    origin: str
    """From where they count."""
    clock_off_ns: int
    """Offset of another clock: its time at the first point, less the stamp; else 0."""
    wraps_ns: int
    """After how long such a clock begins anew; 0: never."""
    spins: bool
    """Whether the azimuths of the points go with it."""
    turns: float
    """Revolutions that the scan lasts, at the sensor's rate; of a spinning sensor, how long one of its own takes."""

    @property
    def told(self) -> str:
        """In words."""
        return f"{self.name}, {self.unit} {self.origin}"


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a field is not the time of points, as the rest of a sentence about it."""

    why: str
    varies: bool = True
    """Whether its values differ from point to point: such a field has a meaning that is not understood."""


@dataclass(frozen=True, slots=True)
class _Values:
    """The values of a field, ready to be judged."""

    reference: Any
    """One of them."""
    steps: F64
    """(n,) all of them less that one."""
    is_number: Bool
    """(n,) whether it is a number, and not the one that stands for unknown."""
    sample: I64
    """Indices of those that are looked at."""


def _values(raw: NDArray[Any], stamp_ns: int) -> _Values | Refusal:
    """The values (n,) of a field, or why they hold nothing about single points."""
    if raw.ndim != 1 or raw.dtype.kind not in "iuf":
        return Refusal("holds no numbers", varies=False)
    # The values from one of them on: exact before anything becomes a float, and right across a wrap of uint32.
    is_number = np.isfinite(raw) if raw.dtype.kind == "f" else np.ones(len(raw), dtype=bool)
    numbers = int(np.count_nonzero(is_number))
    if numbers == 0:
        return Refusal("holds no number", varies=False)
    stride = max(1, numbers // JUDGEMENT.sample)
    if numbers == len(raw):  # nearly always: no list of all of them
        sample = np.arange(0, numbers, stride)
        reference = raw[numbers // 2]
    else:
        places = np.flatnonzero(is_number)
        sample = places[::stride]
        reference = raw[places[numbers // 2]]
    steps = _minus(raw, reference)
    distinct, counts = np.unique(steps[sample], return_counts=True)
    values = len(distinct)
    if values < JUDGEMENT.least_values and _is_lost(raw, reference, stamp_ns):
        return Refusal(
            f"holds times since 1970 as {raw.dtype.name}, which cannot tell points apart; record float64, "
            "or times since the stamp"
        )
    if values < JUDGEMENT.least_values:
        return Refusal(f"holds {values} different value{'s' if values > 1 else ''} in a scan", varies=False)
    # A value that many points share stands for "unknown".
    most = np.argsort(counts)[-2:]
    if counts[most[1]] > max(JUDGEMENT.shared * len(sample), JUDGEMENT.shared_ratio * counts[most[0]]):
        is_number &= steps != distinct[most[1]]
        sample = sample[is_number[sample]]
        if len(sample) < JUDGEMENT.least_values:
            return Refusal("has one value in nearly all points", varies=False)
    return _Values(reference, steps, is_number, sample)


def read_times(
    name: str,
    raw: NDArray[Any],
    points: F32,
    stamp_ns: int,
    rate_hz: float,
    unit: str | None = None,
) -> FieldTimes | Refusal:
    """The values (n,) of a field as times of ``points`` (n, 3), or why they are none.

    ``unit``: stated, then only the origin is found out. Integers stay exact: nanoseconds since 1970 have 61 bits.
    """
    values = _values(raw, stamp_ns)
    if isinstance(values, Refusal):
        return values
    reference = values.reference
    steps = values.steps
    sample = values.sample
    # The median and twice the interquartile range hold for any values of a quarter of the points.
    median = float(np.partition(steps[sample], len(sample) // 2)[len(sample) // 2])
    low, high = np.quantile(steps[sample], (0.25, 0.75))
    spread = 2.0 * float(high - low)
    if spread == 0.0:
        return Refusal("has one value in half of the points")
    # The unit, from the turn of the sensor or from the length of the scan.
    near = sample[np.abs(steps[sample] - median) <= JUDGEMENT.reach * spread]
    turn = _turn(steps[near], np.arctan2(points[near, 1], points[near, 0]))
    chosen = unit or _unit_of(spread, turn, rate_hz)
    if chosen is None:
        return Refusal(f"grows by {turn:.4g} in a revolution, which is a LiDAR's in no unit")
    to_s = UNITS_NS[chosen] * 1e-9
    # Outliers, by the longest duration of a scan.
    reach = JUDGEMENT.reach * max(1.0 / rate_hz / to_s if turn is None else turn, spread)
    kept = steps
    first, last = float(steps.min()), float(steps.max())
    all_good = first >= median - reach and last <= median + reach and bool(values.is_number.all())  # nearly always
    if not all_good:
        good = values.is_number & (np.abs(steps - median) <= reach)
        kept = steps[good]
        first, last = float(kept.min()), float(kept.max())
    length_s = (last - first) * to_s
    turns = (length_s if turn is None else turn * to_s) * rate_hz
    one_turn = abs(turns - 1.0) <= JUDGEMENT.off_rate and (turn is not None or chosen == "ms")
    if unit is None and not one_turn and _counts(kept, raw.dtype):
        return Refusal("holds whole numbers one after the other: a counter, a column or a ring, no time")
    refusal = _refusal(turn is not None, turns, length_s, rate_hz)
    if unit is None and refusal is not None:
        return refusal
    # The moment from which it counts.
    starts_ns = round(first * UNITS_NS[chosen])
    middle_ns = round(median * UNITS_NS[chosen])
    value_ns, wraps_ns = _value_ns(reference, raw.dtype, chosen)
    off_ns, origin = _origin((value_ns, wraps_ns), middle_ns, starts_ns, stamp_ns, rate_hz)
    after = np.multiply(steps, to_s, out=steps)
    after += off_ns * 1e-9
    if not all_good:
        after[~good] = np.nan
    clock_off_ns = value_ns + starts_ns - stamp_ns if origin == TimeOrigin.ANOTHER else 0
    return FieldTimes(name, chosen, after, origin, clock_off_ns, wraps_ns, turn is not None, turns)


def _is_lost(raw: NDArray[Any], reference: Any, stamp_ns: int) -> bool:
    """Whether values that hardly differ are times by the stamp's clock, rounded by their type."""
    if raw.dtype.kind != "f" or raw.dtype.itemsize > 4 or abs(float(reference)) < 2.0**17:
        return False
    step = float(np.spacing(np.float32(reference)))
    return any(abs(float(reference) * ns - stamp_ns) <= step * ns + 1e9 for ns in UNITS_NS.values())


def _minus(raw: NDArray[Any], reference: Any) -> F64:
    """(n,) values less one of them; of integers of 32 bits and more across their wrap too."""
    native = raw.astype(raw.dtype.newbyteorder("="), copy=False)
    if raw.dtype.kind == "f" or raw.dtype.itemsize < 4:
        return np.subtract(native, float(reference), dtype=np.float64)
    unsigned = np.dtype(f"u{raw.dtype.itemsize}")
    around = native.view(unsigned) - np.asarray(reference).astype(native.dtype).view(unsigned)
    return around.view(np.dtype(f"i{raw.dtype.itemsize}")).astype(np.float64)


def _turn(steps: F64, azimuth: F32) -> float | None:
    """The units of ``steps`` (m,) that a revolution takes, by the azimuths (m,) at those times; None if they do not go
    round with them."""
    if len(steps) < JUDGEMENT.least_values:
        return None
    order = np.argsort(steps, kind="stable")
    time = steps[order]
    angle = np.unwrap(azimuth[order].astype(np.float64))
    if not JUDGEMENT.least_turn_rad <= abs(angle[-1] - angle[0]) <= JUDGEMENT.longest_turn_rad:
        return None
    centred = time - time.mean()
    slope = float((centred * angle).sum() / (centred**2).sum())
    if slope == 0.0:
        return None
    off = angle - angle.mean() - slope * centred
    together = float(np.hypot(np.cos(off).mean(), np.sin(off).mean()))
    return 2.0 * np.pi / abs(slope) if together > JUDGEMENT.goes_round else None


def _counts(steps: F64, kind: np.dtype[Any]) -> bool:
    """Whether the values are whole numbers one after the other: a counter, a column, a ring number."""
    if np.ptp(steps) > 2.0 * len(steps) or (kind.kind == "f" and (steps != np.rint(steps)).any()):
        return False
    values = np.unique(steps)
    return bool(np.median(np.diff(values)) == 1.0)


def _unit_of(spread: float, turn: float | None, rate_hz: float) -> str | None:
    """The unit in which a revolution takes what a LiDAR's takes, or in which a scan lasts nearest to a revolution."""
    if turn is not None:
        shortest = JUDGEMENT.shortest_turn_s
        longest = JUDGEMENT.longest_turn_s
        return next((u for u, ns in UNITS_NS.items() if shortest <= turn * ns * 1e-9 <= longest), None)
    return min(UNITS_NS, key=lambda u: abs(float(np.log(spread * UNITS_NS[u] * 1e-9 * rate_hz))))


def _refusal(spins: bool, turns: float, length_s: float, rate_hz: float) -> Refusal | None:
    """Why times that last so many revolutions cannot be; None if they can."""
    if spins and abs(turns - 1.0) > JUDGEMENT.off_rate:
        left_out = 1.0 / turns
        multiple = left_out > 1.5 and (left_out > 4.0 or abs(left_out - round(left_out)) <= JUDGEMENT.off_multiple)
        if not multiple:
            return Refusal(
                f"says that a revolution takes {turns / rate_hz:.4g} s, but scans come every {1.0 / rate_hz:.4g} s "
                f"({rate_hz:.4g} Hz); correct the times of the scans or the rate, or state time_unit"
            )
    if not spins and not JUDGEMENT.shortest <= turns <= JUDGEMENT.longest:
        return Refusal(f"spans {length_s:.4g} s at best, which is no revolution at {rate_hz:.4g} Hz in any unit")
    return None


def _value_ns(value: Any, kind: np.dtype[Any], unit: str) -> tuple[int, int]:
    """(a value in nanoseconds, after how many nanoseconds its type begins anew; 0: never)."""
    if kind.kind == "f":
        return round(float(value) * UNITS_NS[unit]), 0
    wraps = 2 ** (8 * kind.itemsize) if kind.itemsize == 4 else 0
    return int(value) * UNITS_NS[unit], wraps * UNITS_NS[unit]


def _origin(
    reference: tuple[int, int], middle_ns: int, start_ns: int, stamp_ns: int, rate_hz: float
) -> tuple[int, str]:
    """(nanoseconds from the stamp to the reference value, in which sense). ``middle_ns``, ``start_ns``: from the
    reference to the median and to the first of the values."""
    value_ns, wraps_ns = reference
    revolution_ns = 1e9 / rate_hz
    readings = [(value_ns, TimeOrigin.SINCE_STAMP), (value_ns - stamp_ns, TimeOrigin.AS_STAMP)]
    if wraps_ns:
        readings = [((off + wraps_ns // 2) % wraps_ns - wraps_ns // 2, origin) for off, origin in readings]
    since_stamp = readings[0]
    if abs(since_stamp[0] + middle_ns) <= JUDGEMENT.near_stamp * revolution_ns:
        return since_stamp
    nearest = min(readings, key=lambda reading: abs(reading[0] + middle_ns))
    if abs(nearest[0] + middle_ns) <= JUDGEMENT.apart_s * 1e9:
        return nearest
    return -start_ns, TimeOrigin.ANOTHER


@dataclass(frozen=True, slots=True)
class FoundTimes:
    """Fields of a scan that hold times, or might."""

    times: FieldTimes | None
    refused: Mapping[str, Refusal] = field(default_factory=dict)
    """Fields that by their names should be times, and why they are none."""
    candidates: tuple[str, ...] = ()
    """Fields that last about one revolution in some unit, without more that speaks for them."""
    surprising: bool = False
    """Whether the field was taken for what it holds, not for its name."""


def find_times(
    columns: Mapping[str, NDArray[Any]], points: F32, stamp_ns: int, rate_hz: float, rules: TimeRules
) -> FoundTimes:
    """The field among ``columns`` (n,) that tells when ``points`` (n, 3) were measured: the stated one, else the first
    that can be it, names that are known before names that look like a time. A field of another name must go round with
    the azimuths, or forward with the order of the points, for one revolution.

    MapvoteError if the stated field is not there or no time, or a known name holds no time and no other field does.
    """
    if rules.time_field is not None:
        return FoundTimes(_stated(columns, points, stamp_ns, rate_hz, rules))
    joined = _joined(columns)
    named, alike = _named_like_times(columns)
    refused = {}
    for name in (*joined, *named, *alike):
        values = columns[name] if name in columns else joined[name]
        read = read_times(name, values, points, stamp_ns, rate_hz, rules.time_unit)
        if isinstance(read, FieldTimes):
            return FoundTimes(read, surprising=name in alike)
        refused[name] = read
    candidates = []
    for name in columns:
        if name in refused or _OTHER_FIELDS.match(_lower(name)):
            continue
        read = read_times(name, columns[name], points, stamp_ns, rate_hz)
        if isinstance(read, Refusal) or abs(read.turns - 1.0) > JUDGEMENT.off_rate:
            continue
        if read.spins or _goes_forward(read.after_stamp):
            return FoundTimes(read, refused, surprising=True)
        candidates.append(name)
    return FoundTimes(None, refused, tuple(candidates))


def _stated(
    columns: Mapping[str, NDArray[Any]], points: F32, stamp_ns: int, rate_hz: float, rules: TimeRules
) -> FieldTimes | None:
    """The field that the user names; None for "none"."""
    name = rules.time_field or "none"
    if name == "none":
        return None
    joined = _joined(columns)
    if name not in columns and name not in joined:
        raise MapvoteError(f"time_field = {name!r}: no such field; the fields are {', '.join((*joined, *columns))}")
    values = columns[name] if name in columns else joined[name]
    read = read_times(name, values, points, stamp_ns, rate_hz, rules.time_unit)
    if isinstance(read, Refusal):
        raise MapvoteError(f"time_field = {name!r}: the field {read.why}; state time_unit too, or another field")
    return read


def _named_like_times(columns: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """(fields whose names are known, in the order of ``TIME_FIELDS``; others whose names look like a time)."""
    spelled = {plain(name): name for name in reversed(list(columns))}
    named = [spelled[name] for name in TIME_FIELDS if name in spelled]
    like_time = r"time|stamp|(^|_)(t|dt|sec|nsec|usec|nanosec)(_|$)"
    alike = [name for name in columns if name not in named and re.search(like_time, _lower(name))]
    return named, alike


def _lower(name: str) -> str:
    """A name in small letters, with underscores for blanks, without CloudCompare's prefix."""
    return name.lower().removeprefix("scalar_").replace(" ", "_")


def _joined(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Times that are written in two fields, whole seconds and the rest: nanoseconds (n,) by the name "sec+nsec"."""
    lower = {name.lower(): name for name in columns}
    out = {}
    for small, name in lower.items():
        # The part of a time below a second; the other part has the same name without n or u.
        parts = re.fullmatch(r"(.*?)(n|nano|u|micro)(s|sec|secs|seconds?)", small)
        whole = (
            next((lower[parts[1] + s] for s in ("sec", "secs", "s") if parts[1] + s in lower), None) if parts else None
        )
        if (
            parts is None
            or whole is None
            or columns[whole].dtype.kind not in "iu"
            or columns[name].dtype.kind not in "iu"
        ):
            continue
        unit = 1 if parts[2].startswith("n") else 1000
        out[f"{whole}+{name}"] = columns[whole].astype(np.int64) * 10**9 + columns[name].astype(np.int64) * unit
    return out


def _goes_forward(after_stamp: F64) -> bool:
    """Whether nearly all points come in the order of these times."""
    good = after_stamp[np.isfinite(after_stamp)]
    steps = np.diff(good)
    return len(steps) > 0 and bool((steps >= 0.0).mean() > 0.99)


def no_times(field_times: FoundTimes, fields: tuple[str, ...]) -> str:
    """Why no field tells when points were measured, with the fields that are there."""
    listed = f"the fields are {', '.join(fields)}"
    if field_times.refused:
        reasons = "; ".join(f"{name} {refusal.why}" for name, refusal in field_times.refused.items())
        return f"{reasons} ({listed})"
    return listed


def known_time_field(field_times: FoundTimes) -> str | None:
    """The first field whose name is known and whose values differ from point to point, but are no times."""
    return next(
        (name for name, refusal in field_times.refused.items() if plain(name) in TIME_FIELDS and refusal.varies), None
    )
