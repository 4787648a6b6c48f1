"""What one look at every scan shows: cut off, empty, doubled, half missing, columns or units mistaken."""

from __future__ import annotations

import numpy as np

from mapvote.core.types import Drive, Scan
from mapvote.doctor.finding import Finding, Severity
from mapvote.doctor.looks import QUANTA_M, SECTORS, Looks
from mapvote.formats.drives.sensor_estimate import contradiction

_CUT_SHARE = 0.6
"""A scan with fewer points than this share of its neighbours' is cut off."""
_EMPTY_SECTOR = 0.05
"""A sector with less than this share of an even one's points is empty."""
_SOME_SCANS = 0.05
"""A drive of which no larger share is spoilt can be used as it is, and the doctor warns."""

_PERIOD_POINTS = 50_000


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
