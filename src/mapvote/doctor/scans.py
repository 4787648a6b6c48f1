"""What one look at every scan of a drive shows, without registering anything.

A scan that is cut off, empty, doubled or half missing; columns or units that are mistaken; points in the map's frame. A
verb looks on the way, while it reads the scans (:class:`LookedAt`). No scipy here: its import takes longer than a look.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import F32, F64, I64, Drive, MapvoteError, Scan
from mapvote.doctor.finding import Finding, Severity, usable
from mapvote.doctor.prior import NO_PRIOR, check_prior, check_times
from mapvote.formats.drives.sensor_estimate import contradiction

SECTORS = 36
_POINTS = 12_000
"""Points of a scan that are checked."""
_BINS, _BIN_M = 400, 0.5
QUANTA_M = (1.0, 0.5, 0.25, 0.1, 0.05, 0.02)
"""Steps to which coordinates may have been rounded."""
_CUT_SHARE = 0.6
"""A scan with fewer points than this share of its neighbours' is cut off."""
_EMPTY_SECTOR = 0.05
"""A sector with less than this share of an even one's points is empty."""
_SOME_SCANS = 0.05
"""A drive of which no larger share is spoilt can be used as it is, and the doctor warns."""
_PERIOD_POINTS = 50_000
_FAR_M = 50.0
"""The mean of the points in the sensor's frame is never so far from the origin."""
_FIRST_LOOK = 24
"""Scans checked before a drive is used: defects of all scans show, for a tenth of a second."""
IN_MAP_FRAME = Finding(
    "error",
    "the points are in the map's frame already: they move along with the prior",
    "give them in the sensor's frame: p_lidar = inverse(T_map_lidar) p_map, one pose a scan",
)


@dataclass(frozen=True, slots=True)
class Looks:
    """Of every scan that could be read, one row; the others are in ``refused``."""

    index: I64
    """(m,) which scan."""
    count: I64
    """(m,) points."""
    low: F64
    """(m, 3) least coordinate along each axis."""
    high: F64
    """(m, 3)."""
    mean: F64
    """(m, 3)."""
    range_m: F64
    """(m, 3) ranges from the origin: of a tenth, half and 99 % of the points."""
    sectors: F64
    """(m, 36) share of the points in each ten degrees of azimuth, from -180 deg."""
    near: F64
    """(m,) share within 2 m of the origin."""
    unit: F64
    """(m, 3) share of each coordinate that lies in [0, 1]."""
    rounded: F64
    """(m, 6) share of the points whose x, y and z are multiples of QUANTA_M."""
    turns: F64
    """(m,) how often the points, in their order, go round counter-clockwise."""
    print_: F64
    """(m,) a number that two different scans hardly share."""
    has_times: bool
    has_intensity: bool
    refused: dict[int, str]
    """Why a scan could not be read."""

    @property
    def leaps(self) -> F64:
        """(m - 1,) by how much the directions in which a scan sees something differ from those of the one before."""
        leaps: F64 = np.abs(np.diff(self.sectors, axis=0)).sum(axis=1)
        return leaps


class Looking:
    """A drive of which every scan is checked at its first read."""

    def __init__(self, drive: Drive) -> None:
        self.drive = replace(drive, read_scan=self._read)
        """The same drive, checked while it is read."""
        self._unseen = drive
        self._rows: dict[int, F64] = {}
        self._counts: dict[int, int] = {}
        self._refused: dict[int, str] = {}
        self._times = self._intensity = False

    def _read(self, i: int) -> Scan:
        try:
            scan = self._unseen.read_scan(i)
        except MapvoteError as error:
            self._refused[i] = str(error)
            raise
        if i not in self._rows:
            self._rows[i] = _look(scan.points, max(1, len(scan.points) // _POINTS), np.array(QUANTA_M))
            self._counts[i] = len(scan.points)
            self._times |= scan.time_s is not None
            self._intensity |= scan.intensity is not None
        return scan

    def look(self, indices: Iterable[int], progress: Callable[[int, int], None] | None = None) -> Looks:
        """Read the scans that were not read yet; returns the findings of all that were read so far. ``progress`` gets
        (done, in all)."""
        left = [i for i in indices if i not in self._rows and i not in self._refused]
        for done, i in enumerate(left):
            with suppress(MapvoteError):  # it is kept among the refused
                self._read(i)
            if progress is not None:
                progress(done + 1, len(left))
        index = np.array(sorted(self._rows), dtype=np.int64)
        table: NDArray[np.float64] = np.array([self._rows[i] for i in index.tolist()]).reshape(len(index), _WIDTH)
        low, high, mean, range_m, sectors, near, unit, rounded, turns, print_ = np.split(
            table, np.cumsum(_PARTS)[:-1], axis=1
        )
        return Looks(
            index=index,
            count=np.array([self._counts[i] for i in index.tolist()], dtype=np.int64),
            low=low,
            high=high,
            mean=mean,
            range_m=range_m,
            sectors=sectors,
            near=near[:, 0],
            unit=unit,
            rounded=rounded,
            turns=turns[:, 0],
            print_=print_[:, 0],
            has_times=self._times,
            has_intensity=self._intensity,
            refused=dict(self._refused),
        )


def look_at_all(drive: Drive, progress: Callable[[int, int], None] | None = None) -> Looks:
    """Every scan of the drive read once. ``progress`` gets (done, in all)."""
    return Looking(drive).look(range(len(drive)), progress)


_PARTS = (3, 3, 3, 3, SECTORS, 1, 3, len(QUANTA_M), 1, 1)
_WIDTH = sum(_PARTS)


def _look(points: F32, stride: int, quanta: F64) -> F64:
    """One row of :class:`Looks`, its parts one after the other; every ``stride``-th of the points (n, 3)."""
    xyz = points[::stride].astype(np.float64)
    n = len(xyz)
    distance, azimuth = np.sqrt((xyz**2).sum(axis=1)), np.arctan2(xyz[:, 1], xyz[:, 0])
    bins = np.minimum(distance / _BIN_M, _BINS - 1.0).astype(np.int64)
    seen = np.cumsum(np.bincount(bins, minlength=_BINS))
    ranges = [(np.searchsorted(seen, share * n) + 0.5) * _BIN_M for share in (0.1, 0.5, 0.99)]
    sectors = np.bincount(((azimuth + np.pi) / (2.0 * np.pi) * SECTORS).astype(np.int64) % SECTORS, minlength=SECTORS)
    steps = np.diff(azimuth)
    steps -= 2.0 * np.pi * np.round(steps / (2.0 * np.pi))
    turns = steps[np.abs(steps) < 1.0].sum() / (2.0 * np.pi)
    rounded = []
    for quantum in quanta:
        whole = np.abs(xyz[:, 0] / quantum - np.round(xyz[:, 0] / quantum)) < 1e-3  # of x, which is mostly no multiple
        off = xyz[whole] / quantum
        rounded.append((np.abs(off - np.round(off)) < 1e-3).all(axis=1).sum() / max(n, 1))
    share = 1.0 / max(n, 1)
    return np.concatenate(
        [
            xyz.min(axis=0, initial=np.inf),
            xyz.max(axis=0, initial=-np.inf),
            xyz.sum(axis=0) * share,
            ranges,
            sectors * share,
            [(distance < 2.0).sum() * share],
            ((xyz >= 0.0) & (xyz <= 1.0)).sum(axis=0) * share,
            rounded,
            [turns, ((np.arange(n) % 97 + 1.0) * distance).sum()],
        ]
    )


def check_scans(drive: Drive, looks: Looks) -> list[Finding]:
    """Everything that shows without registering anything; of every scan."""
    found = _refused(drive, looks)
    if len(looks.index) == 0:
        return found
    scan = drive.read_scan(int(looks.index[len(looks.index) // 2]))
    units = _units(looks)
    columns = _columns(drive, looks, scan)
    found += columns or units or _beams(drive, looks)
    found += _counts(drive, looks) + _doubled(looks) + _body(looks)
    found += [] if columns or units else _sectors(drive, looks) + _reach(looks)
    found += _rounded(looks)
    if not looks.has_times:
        what = "points carry no times: scans are taken as motion-compensated"
        found.append(Finding("note", what, "if they are not, set motion_compensated = false in drive.toml"))
    if not looks.has_intensity:
        found.append(Finding("note", "no intensity field", "the method does not need it"))
    return found


def _severity(spoilt: int, scans: int) -> Severity:
    return "error" if spoilt > _SOME_SCANS * scans else "warning"


def _refused(drive: Drive, looks: Looks) -> list[Finding]:
    if not looks.refused:
        return []
    i, why = min(looks.refused.items())
    others = f" (and {len(looks.refused) - 1} more of {len(drive)} scans)" if len(looks.refused) > 1 else ""
    mend = ""
    if "not finite or beyond" in why and drive.T_map_lidar_prior is not None:
        place = drive.T_map_lidar_prior[i, :3, 3]
        if np.linalg.norm(place) > 2000.0:
            mend = "are the points in the map's frame already? Then take them back: p_lidar = inverse(T_map_lidar) p"
    return [Finding("error", why + others, mend)]


def _beams(drive: Drive, looks: Looks) -> list[Finding]:
    """The sensor that somebody stated, against the rings of some scans: rays that never were would demolish walls."""
    if drive.sensor_told.startswith("measured"):
        return []
    some = (drive.read_scan(int(looks.index[k])) for k in sorted({0, len(looks.index) // 2, len(looks.index) - 1}))
    what = next(filter(None, (contradiction(drive.sensor, scan.by_lidar()[0][1]) for scan in some)), "")
    return (
        [Finding("error", what, "leave out --sensor, and the sensor in drive.toml: it is measured then")]
        if what
        else []
    )


def _columns(drive: Drive, looks: Looks, scan: Scan) -> list[Finding]:
    """A coordinate that is something else: an intensity, a constant."""
    found = _period(scan)
    if found:
        return found
    unit = np.median(looks.unit, axis=0)
    spread = np.median(looks.high - looks.low, axis=0)
    for axis, name in enumerate("xyz"):
        if spread[axis] == 0.0:
            what = f"{name} is {looks.low[0, axis] + 0.0:g} in every point: the scans are flat"
            found.append(Finding("error", what, "a 3D LiDAR is needed; is the column order x, y, z? (--columns)"))
        elif unit[axis] > 0.98:
            what = f"{name} lies within [0, 1] in {unit[axis]:.0%} of the points: it looks like an intensity"
            found.append(Finding("error", what, "name the columns in their order: --columns x,y,z,intensity"))
        elif np.median(looks.low[:, axis]) >= 0.0 and np.median(looks.rounded[:, 0]) < 0.9:
            found += _never_negative(drive, looks, name)
    return found


def _period(scan: Scan) -> list[Finding]:
    """After how many numbers a scan repeats itself: neighbouring points are alike, column by column."""
    points = scan.points[:_PERIOD_POINTS].astype(np.float64)
    # Intensities may have been scaled when they were read: their column only keeps its place.
    flat = (points if scan.intensity is None else np.pad(points, ((0, 0), (0, 1)), constant_values=np.nan)).ravel()
    width = len(flat) // max(len(points), 1)
    if len(flat) < 1000:
        return []
    unlike = {
        k: np.nanmean(np.minimum(np.abs(flat[k:] - flat[:-k]), 20.0)) for k in range(2, 16) if k == width or k % width
    }
    period = min(unlike, key=lambda k: unlike[k])
    if unlike[period] > 0.5 * unlike[width]:
        return []
    what = f"the numbers of a scan repeat themselves after {period}, not after the {width} columns that were read"
    return [Finding("error", what, "name all columns in their order: --columns x,y,z,intensity,ring")]


def _never_negative(drive: Drive, looks: Looks, name: str) -> list[Finding]:
    """A sensor without rings may look ahead only. Points that go round it, but only part of the way, are half of a
    revolution: that is told as the sectors that are missing."""
    if (name == "x" and not drive.sensor.rings) or (name != "z" and abs(np.median(looks.turns)) > 0.3):
        return []
    what = f"{name} is never negative: no LiDAR sees nothing below itself"
    if name != "z":
        what = f"{name} is never negative: an absolute value, a range, or half of the azimuth is missing (180 deg)"
    return [Finding("error", what, "is it a range, an intensity, an absolute value? Check --columns")]


def _units(looks: Looks) -> list[Finding]:
    median_m = float(np.median(looks.range_m[:, 1]))
    if median_m > 150.0 or np.isinf(median_m):
        what = f"points are {median_m:.0f} m away in the median: no LiDAR in a street sees so"
        mend = "convert the points to metres (they look like centimetres), or are they in the map's frame?"
        return [Finding("error", what, mend)]
    if median_m < 1.5:
        what = f"points are {median_m:.2f} m away in the median"
        return [Finding("error", what, "convert the points to metres, or mask the vehicle's own body")]
    return []


def _counts(drive: Drive, looks: Looks) -> list[Finding]:
    found = []
    usual = float(np.median(looks.count))
    around = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(looks.count, 4, mode="edge"), 9), axis=1)
    cut = np.flatnonzero(looks.count < _CUT_SHARE * around)
    if len(cut):
        k = int(cut[np.argmin(looks.count[cut] / around[cut])])
        what = f"scan {looks.index[k]} holds {looks.count[k]} points, those around it {around[k]:.0f}: cut off?"
        more = f" ({len(cut)} such scans)" if len(cut) > 1 else ""
        mend = "copy it again, or leave it out with --scans"
        found.append(Finding(_severity(len(cut), len(looks.count)), what + more, mend))
    if usual < 0.1 * drive.sensor.beams * drive.sensor.azimuths or usual < 1500:
        what = f"{usual:.0f} points a scan, few for a {drive.sensor.name}"
        found.append(Finding("warning", what, "is it another sensor (--sensor), or a down-sampled recording?"))
    return found


def _doubled(looks: Looks) -> list[Finding]:
    same = np.flatnonzero((np.diff(looks.print_) == 0.0) & (np.diff(looks.count) == 0))
    if not len(same):
        return []
    what = f"scan {looks.index[same[0] + 1]} is the same as the one before it"
    more = f" ({len(same)} such scans of {len(looks.index)})" if len(same) > 1 else ""
    mend = "the recording stood still or was written twice: leave the copies out"
    return [Finding(_severity(len(same), len(looks.index)), what + more, mend)]


def _body(looks: Looks) -> list[Finding]:
    own = float(np.median(looks.near))
    if own <= 0.05 or np.median(looks.range_m[:, 1]) < 1.5:
        return []
    what = f"{own:.0%} of the points are within 2 m of the sensor: the vehicle's own body?"
    return [Finding("warning", what, "mask it: it would be mapped as a wall that follows the car")]


def _sectors(drive: Drive, looks: Looks) -> list[Finding]:
    """Directions in which hardly any scan sees anything, and scans that lack what the others see."""
    mean = looks.sectors.mean(axis=0)
    empty = mean * SECTORS < _EMPTY_SECTOR
    found = []
    blind_deg = 360.0 / SECTORS * int(empty.sum())
    if blind_deg >= 60.0:
        first = int(np.argmax(empty & ~np.roll(empty, 1)))
        start = -180.0 + 10.0 * first
        what = f"nothing is seen over {blind_deg:.0f} deg of azimuth (from {start:.0f} deg counter-clockwise)"
        mend = "part of every revolution is missing? Sound only for a sensor that sees no more, or is hidden there"
        middle = np.radians(-175.0 + 10.0 * np.arange(SECTORS))
        facing = np.arctan2(mean @ np.sin(middle), mean @ np.cos(middle))
        looks_ahead = not drive.sensor.rings and abs(facing) < np.radians(30.0)
        found.append(Finding("note" if looks_ahead else "warning", what, mend))
    seen = mean * SECTORS > 0.3
    lost = ((looks.sectors < _EMPTY_SECTOR * mean) & seen).sum(axis=1) * 10.0
    bad = np.flatnonzero(lost >= 60.0)
    if len(bad) and len(bad) < 0.5 * len(lost):
        k = int(bad[np.argmax(lost[bad])])
        what = f"scan {looks.index[k]} lacks {lost[k]:.0f} deg of azimuth that the others see ({len(bad)} such scans)"
        mend = "packets were lost, or the file is cut off: leave these scans out"
        found.append(Finding(_severity(len(bad), len(lost)), what, mend))
    return found


def _reach(looks: Looks) -> list[Finding]:
    far_m = float(np.median(looks.range_m[:, 2]))
    if far_m >= 15.0:
        return []
    what = f"99 % of the points lie within {far_m:.0f} m"
    return [Finding("warning", what, "cut to a small range? Votes need what stands beside the road, 20 m and more")]


def _rounded(looks: Looks) -> list[Finding]:
    for k, quantum in enumerate(QUANTA_M):
        if np.median(looks.rounded[:, k]) > 0.95 and quantum >= 0.05:
            what = f"coordinates are rounded to {quantum:g} m"
            return [Finding("error" if quantum > 0.2 else "warning", what, "write them in millimetres or as float32")]
    return []


def in_map_frame(T: F64, looks: Looks) -> bool:
    """Whether the points lie around the prior, or move along with it: then they are in the map's frame already."""
    away_m = float(np.median(np.linalg.norm(T[looks.index, :3, 3], axis=1)))
    off_m = float(np.median(np.linalg.norm(looks.mean - T[looks.index, :3, 3], axis=1)))
    if away_m > _FAR_M and off_m < 0.5 * away_m:
        return True
    p, centre = T[looks.index, :2, 3], looks.mean[:, :2]
    spread = p - p.mean(axis=0)
    if len(p) < 5 or np.linalg.norm(p.max(axis=0) - p.min(axis=0)) < 8.0:
        return False
    slope = float((spread * (centre - centre.mean(axis=0))).sum() / (spread**2).sum())
    off = np.linalg.norm((centre - centre.mean(axis=0)) - spread, axis=1)
    return 0.8 < slope < 1.2 and float(np.median(off)) < 0.4 * float(np.median(np.linalg.norm(spread, axis=1)))


def cheap_checks(drive: Drive, looks: Looks) -> list[Finding]:
    """What ``looks`` at a drive's scans, its times and its prior show."""
    T = drive.T_map_lidar_prior
    if T is not None and len(looks.index) and in_map_frame(T, looks):
        return [IN_MAP_FRAME]
    found = check_times(drive) + check_scans(drive, looks)
    return found + (check_prior(drive) if len(drive) >= 2 else [])


class LookedAt:
    """A drive that must be usable. Some of its scans are looked at before, the others when they are read: so none is
    read only to be looked at. If some show an error all are looked at, for the error to be told as of all."""

    def __init__(self, drive: Drive, progress: Callable[[int, int], None] | None = None) -> None:
        """MapvoteError with the first error that some of the scans show, if there is one."""
        self._looking = Looking(drive)
        some = np.unique(np.linspace(0, len(drive) - 1, _FIRST_LOOK).astype(np.int64)).tolist() if len(drive) else []
        found = cheap_checks(drive, self._looking.look(some, progress))
        if any(f.severity == "error" for f in found):
            self.warnings(progress)

    @property
    def drive(self) -> Drive:
        """To be used in place of the drive as it came."""
        return self._looking.drive

    def warnings(self, progress: Callable[[int, int], None] | None = None) -> list[Finding]:
        """The findings of all scans, read or not; MapvoteError with the first error, if there is one."""
        drive = self.drive
        found = cheap_checks(drive, self._looking.look(range(len(drive)), progress))
        return [f for f in usable(str(drive.path), found) if f != NO_PRIOR]
