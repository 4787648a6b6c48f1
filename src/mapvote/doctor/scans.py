"""Findings from one look at every scan of a drive, its times and its prior, without registering anything.

A scan that is cut off, empty, doubled or half missing; columns or units that are mistaken; points in the map's frame;
holes in the times; jumps of the prior. A verb looks while it reads the scans (:func:`looked_at`). No scipy here: its
import takes longer than a look.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.mount import mount_of_prior
from mapvote.core.record import record
from mapvote.core.sampling import evenly
from mapvote.core.types import F32, F64, Drive, MapvoteError, Scan, TimesTold
from mapvote.doctor import Finding, Severity, any_error, usable
from mapvote.doctor.lean import check_lean
from mapvote.formats.drives.options import source_of_times
from mapvote.formats.drives.sensor_estimate import contradiction


@record()
@dataclass(frozen=True, slots=True)
class ScanCheck:
    """Numbers of the checks of single scans."""

    sectors: int = 36
    """Sectors of a turn."""
    points: int = 12_000
    """Points of a scan that are checked."""
    range_bins: int = 400
    """Bins of the histogram of ranges."""
    bin_m: float = 0.5
    """Width of such a bin, metres."""
    quanta_m: tuple[float, ...] = (1.0, 0.5, 0.25, 0.1, 0.05)
    """Steps to which coordinates may have been rounded, metres."""
    cut_share: float = 0.6
    """Points of a scan as a share of its neighbours' below which it is cut off."""
    empty_sector: float = 0.05
    """Points of a sector as a share of an even one's below which it is empty."""
    spoilt_share: float = 0.05
    """Share of spoilt scans up to which a drive can be used as it is, with a warning."""
    period_points: int = 50_000
    """Points of a scan by which its period is measured."""
    far_m: float = 50.0
    """Distance of the mean of the points from the sensor that no scan reaches, metres."""
    first_scans: int = 24
    """Scans checked before a drive is used: defects of all scans show, for a tenth of a second."""
    fastest_mps: float = 70.0
    """Fastest vehicle, metres per second."""


SCAN_CHECK = ScanCheck()
IN_MAP_FRAME = Finding(
    "error",
    "the points are in the map's frame already: they move along with the prior",
    "give them in the sensor's frame: p_lidar = inverse(T_map_lidar) p_map, one pose a scan",
)
NO_PRIOR = Finding(
    "warning",
    "no prior: the vehicle must find itself in the map",
    "give poses with --prior: a file (3 x 4 rows T_map_lidar, TUM, CSV) or a topic of a bag; or give the first pose",
)
_LOOK = np.dtype(
    [
        ("index", "i8"),  # which scan
        ("count", "i8"),  # points
        ("low", "f8", 3),  # least coordinate along each axis
        ("high", "f8", 3),
        ("mean", "f8", 3),
        ("range_m", "f8", 3),  # ranges from the origin: of a tenth, half and 99 % of the points
        (
            "sectors",
            "f8",
            SCAN_CHECK.sectors,
        ),  # share of the points in each ten degrees of azimuth about the vertical, from -180
        ("near", "f8"),  # share within 2 m of the origin
        ("unit", "f8", 3),  # share of each coordinate that lies in [0, 1]
        ("rounded", "f8", len(SCAN_CHECK.quanta_m)),  # share of the points whose x, y and z are multiples of quanta_m
        ("turns", "f8"),  # how often the points, in their order, go round counter-clockwise
        ("digest", "f8"),  # a number that two different scans hardly share
    ]
)


_WEIGHTS = np.arange(2 * SCAN_CHECK.points) % 97 + 1.0
"""Weights of the points in the digest of a scan."""


@dataclass(frozen=True, slots=True)
class Looks:
    """Results of a look at each of some scans."""

    rows: NDArray[np.void]
    """(m,) of ``_LOOK``: of every scan that could be read, in their order."""
    times: Counter[TimesTold]
    """How the times of points are known, and of how many scans."""
    has_intensity: bool
    refused: dict[int, str]
    """Why a scan could not be read."""

    def __getitem__(self, column: str) -> NDArray[Any]:
        """(m, ..) of every scan that could be read."""
        return self.rows[column]

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def median_m(self) -> float:
        """Range of half of the points."""
        return float(np.median(self["range_m"][:, 1]))

    @property
    def leaps(self) -> F64:
        """(m - 1,) by how much the directions in which a scan sees something differ from those of the one before."""
        leaps: F64 = np.abs(np.diff(self["sectors"], axis=0)).sum(axis=1)
        return leaps


class Looking:
    """A drive of which every scan is checked at its first read."""

    def __init__(self, drive: Drive) -> None:
        self.drive = replace(drive, read_scan=self._read)
        """The same drive, checked while it is read."""
        self._unseen = drive
        T = drive.T_map_lidar_prior
        mount = None if T is None or not len(T) else mount_of_prior(T)
        self._R = None if mount is None else mount.C[:3, :3].astype(np.float32)
        self._rows: dict[int, np.void] = {}
        self._refused: dict[int, str] = {}
        self._times: Counter[TimesTold] = Counter()
        self._intensity = False

    def _read(self, i: int) -> Scan:
        try:
            scan = self._unseen.read_scan(i)
        except MapvoteError as error:
            self._refused[i] = str(error)
            raise
        if i not in self._rows:
            self._rows[i] = _look(i, scan.points, self._R)
            self._times[scan.times or _times_without_reader(scan)] += 1
            self._intensity |= "intensity" in scan.fields
        return scan

    def look(self, indices: Iterable[int], progress: Callable[[int, int], None] | None = None) -> Looks:
        """Read the scans that were not read yet; returns the looks of all that were read so far. ``progress`` gets
        (done, in all)."""
        left = [i for i in indices if i not in self._rows and i not in self._refused]
        for done, i in enumerate(left):
            with suppress(MapvoteError):  # it is kept among the refused
                self._read(i)
            if progress is not None:
                progress(done + 1, len(left))
        rows = np.array([self._rows[i] for i in sorted(self._rows)], dtype=_LOOK)
        return Looks(rows, Counter(self._times), self._intensity, dict(self._refused))

    def warnings(self, progress: Callable[[int, int], None] | None = None, *, unchecked: bool = False) -> list[Finding]:
        """The findings of all scans, read or not; MapvoteError with the first error, if there is one and they are not
        ``unchecked``."""
        findings = cheap_checks(self.drive, self.look(range(len(self.drive)), progress))
        serious = [f for f in findings if f.severity != "note"]
        return [f for f in (serious if unchecked else usable(str(self.drive.path), findings)) if f != NO_PRIOR]


def looked_at(drive: Drive, progress: Callable[[int, int], None] | None = None) -> Looking:
    """A drive that must be usable. Some of its scans are looked at before, the others when they are read: so none is
    read only to be looked at. MapvoteError with the first error that some of the scans show, as of all scans."""
    looking = Looking(drive)
    sample = evenly(0, len(drive) - 1, SCAN_CHECK.first_scans).tolist() if len(drive) else []
    if any_error(cheap_checks(drive, looking.look(sample, progress))):
        looking.warnings(progress)
    return looking


def _times_without_reader(scan: Scan) -> TimesTold:
    if scan.time_s is None:
        return TimesTold("none", "of a scan that was not read from fields")
    return TimesTold("field", "times of points")


def _look(index: int, points: F32, R: F32 | None = None) -> np.void:
    """One row of :class:`Looks`: of every so many of the points (n, 3). ``R`` (3, 3) turns them to z up."""
    # Coordinates lie in rows: numpy takes ten times as long along rows of three.
    axes = points[:: max(1, len(points) // SCAN_CHECK.points)].T.astype(np.float64, order="C")
    n = axes.shape[1]
    share = 1.0 / max(n, 1)
    level = axes if R is None else R @ axes
    squared = axes**2
    distance = np.sqrt(squared[0] + squared[1] + squared[2])
    azimuth = np.arctan2(level[1], level[0])
    seen = np.cumsum(
        np.bincount(
            np.minimum(distance / SCAN_CHECK.bin_m, SCAN_CHECK.range_bins - 1.0).astype(np.int64),
            minlength=SCAN_CHECK.range_bins,
        )
    )
    sectors = ((azimuth + np.pi) / (2.0 * np.pi) * SCAN_CHECK.sectors).astype(np.int64) % SCAN_CHECK.sectors
    steps = np.diff(azimuth)
    steps -= 2.0 * np.pi * np.round(steps / (2.0 * np.pi))
    rounded = []
    for quantum in SCAN_CHECK.quanta_m:
        steps_of_x = axes[0] / quantum
        whole = np.abs(steps_of_x - np.round(steps_of_x)) < 1e-3  # of x, which is mostly no multiple
        off = axes[:, whole] / quantum
        rounded.append((np.abs(off - np.round(off)) < 1e-3).all(axis=0).sum() / max(n, 1))
    row = np.zeros(1, dtype=_LOOK)[0]
    row["index"] = index
    row["count"] = len(points)
    row["low"] = axes.min(axis=1, initial=np.inf)
    row["high"] = axes.max(axis=1, initial=-np.inf)
    row["mean"] = axes.sum(axis=1) * share
    row["range_m"] = [(np.searchsorted(seen, part * n) + 0.5) * SCAN_CHECK.bin_m for part in (0.1, 0.5, 0.99)]
    row["sectors"] = np.bincount(sectors, minlength=SCAN_CHECK.sectors) * share
    row["near"] = np.count_nonzero(distance < 2.0) * share
    row["unit"] = np.count_nonzero((axes >= 0.0) & (axes <= 1.0), axis=1) * share
    row["rounded"] = rounded
    row["turns"] = steps[np.abs(steps) < 1.0].sum() / (2.0 * np.pi)
    row["digest"] = (_WEIGHTS[:n] * distance).sum()
    return row


def cheap_checks(drive: Drive, looks: Looks) -> list[Finding]:
    """Findings from ``looks`` at a drive's scans, its times and its prior."""
    T = drive.T_map_lidar_prior
    if T is not None and len(looks) and _in_map_frame(T, looks):
        return [IN_MAP_FRAME]
    findings = [*_check_times(drive), *_check_scans(drive, looks)]
    if T is None:
        return [*findings, NO_PRIOR] if len(drive) >= 2 else findings
    if len(looks):
        findings += check_lean(drive, int(looks["index"][len(looks) // 2]))
    return [*findings, *_check_track(drive, T)] if len(T) >= 2 else findings


def _in_map_frame(T: F64, looks: Looks) -> bool:
    """Whether the points lie around the prior, or move along with it: then they are in the map's frame already."""
    position = T[looks["index"], :3, 3]
    mean = looks["mean"]
    away_m = float(np.median(np.linalg.norm(position, axis=1)))
    off_m = float(np.median(np.linalg.norm(mean - position, axis=1)))
    if away_m > SCAN_CHECK.far_m and off_m < 0.5 * away_m:
        return True
    p = position[:, :2]
    if len(p) < 5 or np.linalg.norm(p.max(axis=0) - p.min(axis=0)) < 8.0:
        return False
    spread = p - p.mean(axis=0)
    centre = mean[:, :2] - mean[:, :2].mean(axis=0)
    slope = float((spread * centre).sum() / (spread**2).sum())
    off = np.linalg.norm(centre - spread, axis=1)
    return 0.8 < slope < 1.2 and float(np.median(off)) < 0.4 * float(np.median(np.linalg.norm(spread, axis=1)))


def _check_times(drive: Drive) -> Iterator[Finding]:
    if len(drive) < 3:
        yield Finding("warning", f"only {len(drive)} scans", "a vote needs many scans of a place")
        return
    step_s = np.diff(drive.stamps_ns) * 1e-9
    median_s = float(np.median(step_s))
    for factor, unit in ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")):
        large = median_s > 5.0
        small = median_s < 0.01
        if (large and 0.02 <= median_s / factor <= 2.0) or (small and 0.02 <= median_s * factor <= 2.0):
            wrong = f"are {unit}, not seconds" if large else f"were divided by {factor:g}"
            problem = f"scans are {median_s:g} s apart: the times {wrong}"
            yield Finding("error", problem, f"convert {source_of_times(drive.path)}")
            return
    sensor = drive.sensor
    if not 0.8 < median_s * sensor.rate_hz < 1.25:
        problem = f"scans are {median_s:.3f} s apart, but a {sensor.name} turns at {sensor.rate_hz:g} Hz"
        times = source_of_times(drive.path)
        mend = f"if scans were left out, all is well; else {times} or rate_hz (--rate, drive.toml) are wrong"
        yield Finding("warning", problem, mend)
    holes = int((step_s > 1.8 * median_s).sum())
    longest = int(np.argmax(step_s))
    if holes:
        problem = f"{holes} holes in the times, the longest {step_s[longest]:.2f} s after scan {longest}"
        grave: Severity = "warning" if step_s[longest] > 5.0 * median_s else "note"
        yield Finding(grave, problem, "chosen with --scans, or lost while recording?")
    uneven = float(np.median(np.abs(step_s - median_s))) / median_s
    if uneven > 0.1:
        problem = f"the times are uneven: half of the steps are more than {uneven:.0%} off {median_s:.3f} s"
        yield Finding("warning", problem, "are they times of arrival? Take the sensor's own stamps")


def _check_track(drive: Drive, T: F64) -> Iterator[Finding]:
    """Jumps of the prior, rows that stand still, rounding."""
    steps_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    way_m = float(steps_m.sum())
    usual_m = float(np.median(steps_m))
    if way_m < 0.5:
        problem = f"the prior does not move ({way_m:.2f} m in {len(T)} scans)"
        yield Finding("warning", problem, "if the vehicle did, the file is not its trajectory; else all is well")
    else:
        speed_mps = float(np.median(steps_m / (np.diff(drive.stamps_ns) * 1e-9)))
        if speed_mps > SCAN_CHECK.fastest_mps:
            mend = "check the unit of its positions (metres) and of the times (seconds)"
            yield Finding("error", f"the prior moves at {speed_mps:.0f} m/s", mend)
        if drive.prior_sigmas is None:  # the priors of satellite fixes step with each fix, and state by how much
            yield from _jumps_and_stops(steps_m, usual_m)
        values = np.abs(T[:, :2, 3] - T[0, :2, 3])
        for quantum in (1.0, 0.5, 0.25, 0.1):
            whole = np.abs(values / quantum - np.round(values / quantum)) < 1e-3
            if way_m > 5.0 and whole.mean() > 0.95:
                problem = f"the prior's positions are rounded to {quantum:g} m"
                yield Finding("warning", problem, "float32 of large coordinates? Write double")
                break


def _jumps_and_stops(steps_m: F64, usual_m: float) -> Iterator[Finding]:
    jumps = int((steps_m > 5 * usual_m + 1.0).sum())
    if 0 < jumps < 0.2 * len(steps_m) and usual_m > 0:
        problem = f"the prior jumps {jumps} times, most at scan {int(np.argmax(steps_m)) + 1} ({steps_m.max():.1f} m)"
        # No error: a map fits all its priors, and a vehicle localises in the map; both reject outliers.
        yield Finding("warning", problem, "GNSS outliers: smooth them, or give prior_sigma_m in drive.toml")
    stuck = steps_m < 1e-6
    if 3 <= stuck.sum() < len(steps_m) and usual_m > 0.05:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], stuck.astype(np.int8), [0]])))
        longest = int((edges[1::2] - edges[::2]).max()) + 1
        problem = f"the prior stands still for {longest} rows, at full speed before or after"
        yield Finding("warning", problem, "was it held while GNSS or the filter was away? Leave those rows out")
    elif usual_m <= 1e-6 < steps_m.sum() and stuck.sum() > 0.4 * len(stuck):
        problem = f"{stuck.mean():.0%} of the prior's rows repeat the one before"
        yield Finding("warning", problem, "it is slower than the scans, or was held: interpolate it")


def _check_scans(drive: Drive, looks: Looks) -> Iterator[Finding]:
    """Everything that shows without registering anything; of every scan."""
    yield from _refused(drive, looks)
    if not len(looks):
        return
    columns = list(_columns(drive, looks, drive.read_scan(int(looks["index"][len(looks) // 2]))))
    units = list(_units(looks))
    yield from columns or units or _beams(drive, looks)
    yield from _counts(drive, looks)
    yield from _doubled(looks)
    own = float(np.median(looks["near"]))
    if own > 0.05 and looks.median_m >= 1.5:
        problem = f"{own:.0%} of the points are within 2 m of the sensor: the vehicle's own body?"
        yield Finding("warning", problem, "mask it: it would be mapped as a wall that follows the car")
    if not columns and not units:
        yield from _sectors(drive, looks)
        far_m = float(np.median(looks["range_m"][:, 2]))
        if far_m < 15.0:
            mend = "cut to a small range? Votes need what stands beside the road, 20 m and more"
            yield Finding("warning", f"99 % of the points lie within {far_m:.0f} m", mend)
    coarse = [
        q for q, share in zip(SCAN_CHECK.quanta_m, np.median(looks["rounded"], axis=0), strict=True) if share > 0.95
    ]
    if coarse:
        problem = f"coordinates are rounded to {coarse[0]:g} m"
        yield Finding("error" if coarse[0] > 0.2 else "warning", problem, "write them in millimetres or as float32")
    yield from _times_of_points(looks.times)
    if not looks.has_intensity:
        yield Finding("note", "no intensity field", "the method does not need it")


def _times_of_points(times: Counter[TimesTold]) -> Iterator[Finding]:
    """The assumption on the times of points, where the user stated none."""
    state = "if they are not, set motion_compensated = false in drive.toml; if they are, true"
    for kind in times:
        named = " or ".join(kind.fields)
        if kind.how == "none" and kind.fields:
            problem = f"no field has the name of a time of points, but {named} lasts about one revolution"
            yield Finding(
                "warning", problem, f'set time_field = "{kind.fields[0]}" in drive.toml, or "none" if it is no time'
            )
        elif kind.how == "none":
            problem = f"points carry no times: scans are taken as motion-compensated ({kind.told})"
            yield Finding("warning" if kind.doubtful else "note", problem, state)
        elif kind.doubtful:
            problem = f"the times of points are taken from {kind.told}: it lasts one revolution, its name is not known"
            yield Finding("warning", problem, f'set time_field = "{named}" in drive.toml, or "none" if it is no time')
        elif kind.other_clock:
            problem = f"the times of points ({kind.told}) and the stamps of scans are of two clocks"
            yield Finding("note", problem, "the first point is taken to lie at the stamp")
    without = sum(n for kind, n in times.items() if kind.how == "none")
    if 0 < without < times.total():
        problem = (
            f"{without} of {times.total()} scans, or one of several LiDARs, carry no times of points, the others do"
        )
        yield Finding("warning", problem, "record all of them in the same way, or state motion_compensated")


def _severity(spoilt: int, scans: int) -> Severity:
    return "error" if spoilt > SCAN_CHECK.spoilt_share * scans else "warning"


def _refused(drive: Drive, looks: Looks) -> Iterator[Finding]:
    if not looks.refused:
        return
    i, refusal = min(looks.refused.items())
    others = f" (and {len(looks.refused) - 1} more of {len(drive)} scans)" if len(looks.refused) > 1 else ""
    T = drive.T_map_lidar_prior
    mend = ""
    if "not finite or beyond" in refusal and T is not None and np.linalg.norm(T[i, :3, 3]) > 2000.0:
        mend = "are the points in the map's frame already? Then take them back: p_lidar = inverse(T_map_lidar) p"
    yield Finding("error", refusal + others, mend)


def _beams(drive: Drive, looks: Looks) -> Iterator[Finding]:
    """Findings on the stated sensor by the rings of some scans: rays that it never fired would delete walls."""
    if drive.sensor_told.startswith("measured"):
        return
    sample = (drive.read_scan(int(looks["index"][k])) for k in sorted({0, len(looks) // 2, len(looks) - 1}))
    mount = None if drive.T_map_lidar_prior is None else mount_of_prior(drive.T_map_lidar_prior)

    def contradicted(scan: Scan) -> str:
        own = contradiction(drive.sensor, scan.by_lidar()[0][1])
        # Clouds in the axes of the vehicle have the rings of the sensor about the vertical, however it is mounted.
        upright = own if mount is None else contradiction(drive.sensor, mount.in_steps().scan(scan).by_lidar()[0][1])
        return own if upright else ""

    problem = next(filter(None, map(contradicted, sample)), "")
    if problem:
        yield Finding("error", problem, "leave out --sensor, and the sensor in drive.toml: it is measured then")


def _columns(drive: Drive, looks: Looks, scan: Scan) -> Iterator[Finding]:
    """A coordinate that is something else: an intensity, a constant."""
    period, width = _period(scan)
    if period != width:
        problem = (
            f"the numbers of a scan repeat themselves after {period}, not after the {width} columns that were read"
        )
        yield Finding("error", problem, "name all columns in their order: --columns x,y,z,intensity,ring")
        return
    unit = np.median(looks["unit"], axis=0)
    spread = np.median(looks["high"] - looks["low"], axis=0)
    for axis, name in enumerate("xyz"):
        if spread[axis] == 0.0:
            problem = f"{name} is {looks['low'][0, axis] + 0.0:g} in every point: the scans are flat"
            yield Finding("error", problem, "a 3D LiDAR is needed; is the column order x, y, z? (--columns)")
        elif unit[axis] > 0.98:
            problem = f"{name} lies within [0, 1] in {unit[axis]:.0%} of the points: it looks like an intensity"
            yield Finding("error", problem, "name the columns in their order: --columns x,y,z,intensity")
        elif np.median(looks["low"][:, axis]) >= 0.0 and np.median(looks["rounded"][:, 0]) < 0.9:
            # A sensor without rings may look ahead only. Points that go round it, but only part of the way, are half of
            # a revolution: that is reported as the sectors that are missing.
            goes_round = name != "z" and abs(np.median(looks["turns"])) > 0.3
            if goes_round or (name == "x" and not drive.sensor.rings):
                continue
            halved = "an absolute value, a range, or half of the azimuth is missing (180 deg)"
            problem = f"{name} is never negative: {'no LiDAR sees nothing below itself' if name == 'z' else halved}"
            yield Finding("error", problem, "is it a range, an intensity, an absolute value? Check --columns")


def _period(scan: Scan) -> tuple[int, int]:
    """(after how many numbers a scan repeats itself, how many columns were read): neighbouring points are alike, column
    by column."""
    points = scan.points[: SCAN_CHECK.period_points].astype(np.float64)
    # Intensities may have been scaled when they were read: their column only keeps its place.
    flat = (
        points if "intensity" not in scan.fields else np.pad(points, ((0, 0), (0, 1)), constant_values=np.nan)
    ).ravel()
    width = len(flat) // max(len(points), 1)
    if len(flat) < 1000:
        return width, width
    unlike = {
        k: np.nanmean(np.minimum(np.abs(flat[k:] - flat[:-k]), 20.0)) for k in range(2, 16) if k == width or k % width
    }
    period = min(unlike, key=lambda k: unlike[k])
    return (width if unlike[period] > 0.5 * unlike[width] else period), width


def _units(looks: Looks) -> Iterator[Finding]:
    if looks.median_m > 150.0 or np.isinf(looks.median_m):
        problem = f"points are {looks.median_m:.0f} m away in the median: no LiDAR in a street sees so"
        mend = "convert the points to metres (they look like centimetres), or are they in the map's frame?"
        yield Finding("error", problem, mend)
    elif looks.median_m < 1.5:
        problem = f"points are {looks.median_m:.2f} m away in the median"
        yield Finding("error", problem, "convert the points to metres, or mask the vehicle's own body")


def _counts(drive: Drive, looks: Looks) -> Iterator[Finding]:
    count = looks["count"]
    sensor = drive.sensor
    around = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(count, 4, mode="edge"), 9), axis=1)
    cut = np.flatnonzero(count < SCAN_CHECK.cut_share * around)
    if len(cut):
        k = int(cut[np.argmin(count[cut] / around[cut])])
        problem = f"scan {looks['index'][k]} holds {count[k]} points, those around it {around[k]:.0f}: cut off?"
        more = f" ({len(cut)} such scans)" if len(cut) > 1 else ""
        yield Finding(_severity(len(cut), len(count)), problem + more, "copy it again, or leave it out with --scans")
    usual = float(np.median(count))
    if usual < 0.1 * sensor.beams * sensor.azimuths or usual < 1500:
        problem = f"{usual:.0f} points a scan, few for a {sensor.name}"
        yield Finding("warning", problem, "is it another sensor (--sensor), or a down-sampled recording?")


def _doubled(looks: Looks) -> Iterator[Finding]:
    same = np.flatnonzero((np.diff(looks["digest"]) == 0.0) & (np.diff(looks["count"]) == 0))
    if len(same):
        problem = f"scan {looks['index'][same[0] + 1]} is the same as the one before it"
        more = f" ({len(same)} such scans of {len(looks)})" if len(same) > 1 else ""
        mend = "the recording stood still or was written twice: leave the copies out"
        yield Finding(_severity(len(same), len(looks)), problem + more, mend)


def _sectors(drive: Drive, looks: Looks) -> Iterator[Finding]:
    """Directions in which hardly any scan sees anything, and scans that lack what the others see."""
    sectors = looks["sectors"]
    mean = sectors.mean(axis=0)
    empty = mean * SCAN_CHECK.sectors < SCAN_CHECK.empty_sector
    blind_deg = 360.0 / SCAN_CHECK.sectors * int(empty.sum())
    if blind_deg >= 60.0:
        start_deg = -180.0 + 10.0 * int(np.argmax(empty & ~np.roll(empty, 1)))
        problem = f"nothing is seen over {blind_deg:.0f} deg of azimuth (from {start_deg:.0f} deg counter-clockwise)"
        mend = "part of every revolution is missing? Sound only for a sensor that sees no more, or is hidden there"
        middle = np.radians(-175.0 + 10.0 * np.arange(SCAN_CHECK.sectors))
        facing = np.arctan2(mean @ np.sin(middle), mean @ np.cos(middle))
        looks_ahead = not drive.sensor.rings and abs(facing) < np.radians(30.0)
        yield Finding("note" if looks_ahead else "warning", problem, mend)
    lost_deg = ((sectors < SCAN_CHECK.empty_sector * mean) & (mean * SCAN_CHECK.sectors > 0.3)).sum(axis=1) * 10.0
    bad = np.flatnonzero(lost_deg >= 60.0)
    if 0 < len(bad) < 0.5 * len(lost_deg):
        k = int(bad[np.argmax(lost_deg[bad])])
        problem = f"scan {looks['index'][k]} lacks {lost_deg[k]:.0f} deg of azimuth that the others see"
        mend = "packets were lost, or the file is cut off: leave these scans out"
        yield Finding(_severity(len(bad), len(lost_deg)), f"{problem} ({len(bad)} such scans)", mend)
