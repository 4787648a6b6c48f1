"""What is wrong with a prior by a little: a scale, a turn, a shift in time, told only where they surely are there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.core.types import F64, I64
from mapvote.doctor.agreement import misfit
from mapvote.doctor.finding import Finding, Severity
from mapvote.doctor.measured import Measured
from mapvote.doctor.motion import Run
from mapvote.doctor.whole import Whole, held_against, strays_less, unbroken

_LEAST = {"scale": 0.02, "turn": 2.0, "pitch": 2.0, "time": 0.15}
"""Share, degrees, degrees, seconds. Less is not complained of: priors err so much by themselves."""
_SURE, _LIKELY = 4.0, 2.0
"""Standard errors: what is more than so many is an error, and may be one."""
_SURE_OF_TIME = 5.0


def check_small(
    T: F64, chain: Run, runs: Sequence[Run], time: Measured | None, stamps_ns: I64, prior_sigma_m: float
) -> list[Finding]:
    """Of the prior's poses T (n, 4, 4): scale, turn and pitch by the chain, the shift in time by the runs as well.

    What is no larger than four standard errors cannot be decided: a note.
    """
    followed, chain = chain, unbroken(chain)
    broken = _broken(followed, len(chain.indices))
    whole = held_against(T, chain, prior_sigma_m)
    if time is not None and _shows(time, T, runs) and strays_less(T, stamps_ns, time.value, chain) > 0.2:
        grave = abs(time.value) > 2.0 * _LEAST["time"]
        return [*broken, Finding("error" if grave else "warning", *small_words(time))]
    if whole is None:
        what = "too few scans fit each other to measure scale and heading"
        return [*broken, Finding("note", what, "drive farther")]
    found = [f for m in (whole.scale, whole.turn, whole.pitch) for f in _told(m)]
    shown = any(f.severity != "note" for f in found)
    return broken + found + ([] if shown else [_not_shown(whole, time)])


def _broken(chain: Run, after: int) -> list[Finding]:
    """Where a scan does not fit the ``after`` ones before it, though the runs do by themselves."""
    if after == len(chain.indices):
        return []
    before, scan = chain.indices[after - 1], chain.indices[after]
    what = f"between scans {before} and {scan} the sensor is elsewhere at once: they do not fit each other"
    return [Finding("warning", what, "are scans missing there, or out of order?")]


def _shows(time: Measured, T: F64, runs: Sequence[Run]) -> bool:
    before = misfit(T, runs)
    return abs(time.value) > _least_time(time) and before - misfit(time.poses(T), runs) > 0.25 * before


def _told(m: Measured) -> list[Finding]:
    off, sigma = _off(m)
    if off <= max(_LEAST[m.kind], _LIKELY * sigma):
        return []
    what, mend = small_words(m)
    if off <= _SURE * sigma:
        return [Finding("note", f"{what}; that may be chance", f"a longer drive tells; else: {mend}")]
    severity: Severity = "error" if off > 2.0 * _LEAST[m.kind] else "warning"
    return [Finding(severity, what, mend)]


def _off(m: Measured) -> tuple[float, float]:
    """(by how much, its standard error), of a scale as a share."""
    return (abs(float(np.log(m.value))), m.sigma / m.value) if m.kind == "scale" else (abs(m.value), m.sigma)


def _least_time(m: Measured) -> float:
    return max(_LEAST["time"], _SURE_OF_TIME * m.sigma)


def _not_shown(whole: Whole, time: Measured | None) -> Finding:
    """How large a mistake may be before this drive shows it: a short one shows little."""
    least = {m.kind: max(_LEAST[m.kind], _SURE * _off(m)[1]) for m in (whole.scale, whole.turn)}
    told = [f"{least['scale']:.0%} of scale", f"{least['turn']:.0f} deg of heading"]
    told += [f"{_least_time(time):.1f} s"] if time is not None else []
    what = f"over {whole.length_m:.0f} m mistakes of the prior show from {', '.join(told)} on"
    return Finding("note", what, "a longer drive with turns tells more")


def small_words(m: Measured) -> tuple[str, str]:
    """(what, how to mend it)."""
    if m.kind == "scale":
        what = f"prior and scans differ in scale: the prior is {m.value:.3f} times as large (+-{m.sigma:.3f})"
        return what, "a projection's scale (Mercator), feet, or the sensor's calibration? Compare with a known length"
    if m.kind == "time":
        side = "late" if m.value > 0 else "early"
        return f"the prior is {abs(m.value):.2f} s {side} (+-{m.sigma:.2f})", "shift its times against the scans"
    if m.kind == "pitch":
        what = f"the scans are pitched by {m.value:.1f} deg (+-{m.sigma:.1f}) against the prior's motion"
        return what, "level the points, or put the sensor's pitch into T_base_lidar and the prior's rotations"
    what = f"headings and scans are turned against each other by {m.value:.1f} deg (+-{m.sigma:.1f})"
    return what, "mend the yaw of T_base_lidar, or of the prior"
