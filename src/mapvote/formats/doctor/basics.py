"""What shows without comparing scans: times, the prior's motion, ranges and fields."""

from __future__ import annotations

import numpy as np

from mapvote.core.types import Drive, Scan
from mapvote.formats.doctor.finding import Finding


def check_times(drive: Drive) -> list[Finding]:
    if len(drive) < 3:
        return [Finding("warning", f"only {len(drive)} scans", "a vote needs many scans of a place")]
    step_s = np.diff(drive.stamps_ns) * 1e-9
    median_s = float(np.median(step_s))
    expected_s = 1.0 / drive.sensor.rate_hz
    for factor, unit in ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")):
        if 0.05 < median_s / expected_s / factor < 20:
            return [
                Finding(
                    "error", f"scans are {median_s:g} s apart: the times are {unit}, not seconds", "convert times.txt"
                )
            ]
        if 0.05 < median_s / expected_s * factor < 20:
            return [
                Finding(
                    "error",
                    f"scans are {median_s:g} s apart: the times were divided by {factor:g}",
                    "convert times.txt",
                )
            ]
    found = []
    if not 0.8 < median_s / expected_s < 1.25:
        what = f"scans are {median_s:.3f} s apart, but a {drive.sensor.name} turns at {drive.sensor.rate_hz:g} Hz"
        found.append(Finding("note", what, "if scans were left out, all is well; else set rate_hz in drive.toml"))
    holes = int((step_s > 1.8 * median_s).sum())
    if holes:
        at = int(np.argmax(step_s))
        what = f"{holes} holes in the times, the longest {step_s[at]:.2f} s after scan {at}"
        found.append(Finding("note", what, "chosen with --scans, or lost while recording?"))
    return found


def check_prior(drive: Drive) -> list[Finding]:
    T = drive.T_map_lidar_prior
    assert T is not None
    if len(T) < 2:
        return []
    found = []
    steps_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    speed = steps_m / (np.diff(drive.stamps_ns) * 1e-9)
    if steps_m.sum() < 0.5:
        what = f"the prior does not move ({steps_m.sum():.2f} m in {len(T)} scans)"
        found.append(Finding("warning", what, "if the vehicle did, the file is not its trajectory; else all is well"))
    elif np.median(speed) > 70.0:
        what = f"the prior moves at {np.median(speed):.0f} m/s"
        found.append(Finding("error", what, "check the unit of its positions (metres) and of the times (seconds)"))
    usual = float(np.median(steps_m))
    jumps = np.flatnonzero(steps_m > 5 * usual + 1.0)
    if len(jumps) and len(jumps) < 0.2 * len(steps_m) and usual > 0:
        what = f"the prior jumps {len(jumps)} times, most at scan {int(np.argmax(steps_m)) + 1} ({steps_m.max():.1f} m)"
        found.append(Finding("warning", what, "GNSS outliers: smooth them, or give prior_sigma_m in drive.toml"))
    tilt_deg = np.rad2deg(np.arccos(np.clip(T[:, 2, 2], -1, 1)))
    if np.median(tilt_deg) > 30:
        what = f"the prior tilts the sensor by {np.median(tilt_deg):.0f} deg"
        found.append(Finding("warning", what, "fine for a sensor mounted so; else its axes are not x forward, z up"))
    return found


def check_scans(drive: Drive, scans: list[Scan]) -> list[Finding]:
    found = []
    distance_m = np.concatenate([np.linalg.norm(s.points, axis=1) for s in scans])
    median_m = float(np.median(distance_m))
    if median_m > 150:
        what = f"points are {median_m:.0f} m away in the median: no LiDAR in a street sees so"
        found.append(Finding("error", what, "convert the points to metres (they look like centimetres)"))
    elif median_m < 1.5:
        what = f"points are {median_m:.2f} m away in the median"
        found.append(Finding("error", what, "convert the points to metres, or mask the vehicle's own body"))
    own = float((distance_m < 2.0).mean())
    if own > 0.05 and median_m >= 1.5:
        what = f"{own:.0%} of the points are within 2 m of the sensor: the vehicle's own body?"
        found.append(Finding("warning", what, "mask it: it would be mapped as a wall that follows the car"))
    points = float(np.mean([len(s.points) for s in scans]))
    if points < 0.1 * drive.sensor.beams * drive.sensor.azimuths:
        what = f"{points:.0f} points a scan, few for a {drive.sensor.name}"
        found.append(Finding("warning", what, "is it another sensor (--sensor), or a down-sampled recording?"))
    if all(s.time_s is None for s in scans):
        what = "points carry no times: scans are taken as motion-compensated"
        found.append(Finding("note", what, "if they are not, set motion_compensated = false in drive.toml"))
    if all(s.intensity is None for s in scans):
        found.append(Finding("note", "no intensity field", "the method does not need it"))
    return found
