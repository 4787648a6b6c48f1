"""What times and prior show by themselves: units, holes, jumps, rows that stand still, tilts."""

from __future__ import annotations

import numpy as np

from mapvote.core.types import F64, Bool, Drive
from mapvote.doctor.finding import Finding
from mapvote.doctor.readings import course, heading

_FASTEST_MPS = 70.0
NO_PRIOR = Finding(
    "warning",
    "no prior: the vehicle must find itself in the map",
    "write prior.txt (3 x 4 rows T_map_lidar), or expect to be asked for the first pose",
)


def check_times(drive: Drive) -> list[Finding]:
    if len(drive) < 3:
        return [Finding("warning", f"only {len(drive)} scans", "a vote needs many scans of a place")]
    step_s = np.diff(drive.stamps_ns) * 1e-9
    median_s = float(np.median(step_s))
    for factor, unit in ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")):
        if median_s > 5.0 and 0.02 <= median_s / factor <= 2.0:
            what = f"scans are {median_s:g} s apart: the times are {unit}, not seconds"
            return [Finding("error", what, "convert times.txt")]
        if median_s < 0.01 and 0.02 <= median_s * factor <= 2.0:
            what = f"scans are {median_s:g} s apart: the times were divided by {factor:g}"
            return [Finding("error", what, "convert times.txt")]
    found = []
    expected_s = 1.0 / drive.sensor.rate_hz
    if not 0.8 < median_s / expected_s < 1.25:
        what = f"scans are {median_s:.3f} s apart, but a {drive.sensor.name} turns at {drive.sensor.rate_hz:g} Hz"
        mend = "if scans were left out, all is well; else times or rate_hz (drive.toml) are wrong"
        found.append(Finding("warning", what, mend))
    holes = int((step_s > 1.8 * median_s).sum())
    if holes:
        at = int(np.argmax(step_s))
        what = f"{holes} holes in the times, the longest {step_s[at]:.2f} s after scan {at}"
        grave = step_s[at] > 5.0 * median_s
        found.append(Finding("warning" if grave else "note", what, "chosen with --scans, or lost while recording?"))
    uneven = float(np.median(np.abs(step_s - median_s))) / median_s
    if uneven > 0.1:
        what = f"the times are uneven: half of the steps are more than {uneven:.0%} off {median_s:.3f} s"
        found.append(Finding("warning", what, "are they times of arrival? Take the sensor's own stamps"))
    return found


def check_prior(drive: Drive) -> list[Finding]:
    T = drive.T_map_lidar_prior
    if T is None:
        return [NO_PRIOR]
    if len(T) < 2:
        return []
    steps_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    return _motion(drive, T, steps_m) + _attitude(T)


def _motion(drive: Drive, T: F64, steps_m: F64) -> list[Finding]:
    found = []
    if steps_m.sum() < 0.5:
        what = f"the prior does not move ({steps_m.sum():.2f} m in {len(T)} scans)"
        return [Finding("warning", what, "if the vehicle did, the file is not its trajectory; else all is well")]
    speed = steps_m / (np.diff(drive.stamps_ns) * 1e-9)
    usual = float(np.median(steps_m))
    if np.median(speed) > _FASTEST_MPS:
        what = f"the prior moves at {np.median(speed):.0f} m/s"
        found.append(Finding("error", what, "check the unit of its positions (metres) and of the times (seconds)"))
    jumps = np.flatnonzero(steps_m > 5 * usual + 1.0)
    if len(jumps) and len(jumps) < 0.2 * len(steps_m) and usual > 0:
        what = f"the prior jumps {len(jumps)} times, most at scan {int(np.argmax(steps_m)) + 1} ({steps_m.max():.1f} m)"
        # No error: a map fits all its priors, and a vehicle asks the map; both leave outliers out.
        found.append(Finding("warning", what, "GNSS outliers: smooth them, or give prior_sigma_m in drive.toml"))
    stuck = steps_m < 1e-6
    if 3 <= stuck.sum() < len(steps_m) and usual > 0.05:
        longest = _longest(stuck)
        what = f"the prior stands still for {longest} rows, at full speed before or after"
        found.append(Finding("warning", what, "was it held while GNSS or the filter was away? Leave those rows out"))
    elif usual <= 1e-6 < steps_m.sum() and stuck.sum() > 0.4 * len(stuck):
        what = f"{stuck.mean():.0%} of the prior's rows repeat the one before"
        found.append(Finding("warning", what, "it is slower than the scans, or was held: interpolate it"))
    values = np.abs(T[:, :2, 3] - T[0, :2, 3])
    for quantum in (1.0, 0.5, 0.25, 0.1):
        whole = np.abs(values / quantum - np.round(values / quantum)) < 1e-3
        if steps_m.sum() > 5.0 and whole.mean() > 0.95:
            what = f"the prior's positions are rounded to {quantum:g} m"
            found.append(Finding("warning", what, "float32 of large coordinates? Write double"))
            break
    return found


def _longest(flags: Bool) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int((edges[1::2] - edges[::2]).max()) + 1


def _attitude(T: F64) -> list[Finding]:
    found = []
    tilt_deg = float(np.median(np.rad2deg(np.arccos(np.clip(T[:, 2, 2], -1, 1)))))
    if tilt_deg > 30:
        what = f"the prior tilts the sensor by {tilt_deg:.0f} deg"
        found.append(Finding("warning", what, "fine for a sensor mounted so; else its axes are not x forward, z up"))
    return found


def drift_angle_deg(T: F64) -> float:
    """By how much the headings told differ from the course of the positions, median, degrees counter-clockwise."""
    apart = heading(T) - course(T)
    return float(np.degrees(np.arctan2(np.median(np.sin(apart)), np.median(np.cos(apart)))))
