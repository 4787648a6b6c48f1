"""What is wrong between prior and scans: the readings and numbers under which they agree, told apart by the runs.

A reading is held against another run by run. Those that no run tells from the best are named together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mapvote.core.types import F64, Drive
from mapvote.doctor.agreement import misfits
from mapvote.doctor.finding import Finding, Severity
from mapvote.doctor.measured import Measured, measure_scale, measure_time, measure_turn
from mapvote.doctor.motion import Run
from mapvote.doctor.prior import drift_angle_deg
from mapvote.doctor.readings import AS_IT_IS, READINGS, Reading
from mapvote.doctor.road import Road
from mapvote.doctor.small import check_small, small_words

_HEIGHT_M = (0.8, 4.0)
"""Of a sensor on a vehicle, over the road."""
CANNOT_TELL = "this drive cannot tell without a turn whether"


@dataclass(frozen=True, slots=True)
class _Held:
    """A reading held against the runs."""

    reading: Reading
    misfit: F64
    """(runs,) metres."""
    special: bool
    """False: a number or a catch-all, named only where nothing more special fits."""

    @property
    def median(self) -> float:
        return float(np.median(self.misfit))


def check_agreement(
    drive: Drive, T: F64, runs: Sequence[Run], road: Road, turns: float, chain: Callable[[], Run]
) -> tuple[list[Finding], F64]:
    """(findings, the poses (n, 4, 4) mended as far as is known). ``turns``: how the points go round, for a mirror;
    ``chain``: a long run, asked for where the prior is right but for a little."""
    length_m = float(np.median([run.length_m for run in runs]))
    told_m = float(np.median([np.linalg.norm(T[r.indices[-1], :3, 3] - T[r.indices[0], :3, 3]) for r in runs]))
    if length_m < 1.0 and told_m < 1.0:
        return [Finding("note", "the vehicle hardly moves: prior and scans cannot be compared")], T
    if length_m < min(1.0, 0.1 * told_m):
        what = f"the scans stand still where the prior moves {told_m:.1f} m"
        return [Finding("error", what, "is it the trajectory of this drive? Are the points in the map's frame?")], T
    as_it_is = _held(AS_IT_IS, T, runs)
    held = [_held(reading, T, runs) for reading in READINGS]
    turn, pitch = measure_turn(T, runs)
    time = measure_time(T, runs, drive.stamps_ns)
    numbers = [measure_scale(T, runs), turn, pitch, *([time] if time is not None else [])]
    wordy = [m for m in numbers if m is not (turn if abs(pitch.value) > abs(turn.value) else pitch)]
    held += [_held(_number_reading(m, T, runs, road), T, runs, special=False) for m in wordy]
    best = min([as_it_is, *held], key=lambda h: h.median)
    floor_m = 0.1 + 0.12 * length_m + 2.0 * min(drive.prior_sigma_m, 1.5)
    if _clearly_better(best, as_it_is, length_m):
        if best.median > floor_m:
            return [_nothing_fits(as_it_is, runs, length_m, told_m)], T
        group = _like_the_best(best, held, length_m, runs)
        return [_named(group, as_it_is, best, length_m)], best.reading.poses(T)
    if as_it_is.median > floor_m:
        return [_nothing_fits(as_it_is, runs, length_m, told_m)], T
    found = check_small(T, chain(), runs, time, drive.stamps_ns, drive.prior_sigma_m)
    found += _places(as_it_is, runs) + _scatter(drive, as_it_is, length_m)
    found += _cannot_tell(as_it_is, held, length_m, turns, drive.sensor.clockwise)
    return found, T


def _held(reading: Reading, T: F64, runs: Sequence[Run], special: bool = True) -> _Held:
    return _Held(reading, misfits(reading.poses(T), runs), special and not reading.catch_all)


def _clearly_better(best: _Held, other: _Held, length_m: float) -> bool:
    """In the median, and in most runs by itself: a jump of the prior spoils some runs under every reading. A number
    fits much a little: it must leave less."""
    runs = float((best.misfit < 0.6 * other.misfit).mean())
    return (
        best.median < (0.5 if best.special else 0.4) * other.median
        and other.median - best.median > 0.15 + 0.005 * length_m
        and runs > 0.6
    )


def _worse(one: _Held, best: _Held, length_m: float) -> bool:
    """Whether the runs tell ``one`` from the best."""
    more = one.misfit - best.misfit
    error = float(more.std()) / np.sqrt(len(more)) + 0.02
    return bool(np.median(more) > max(0.05, 0.004 * length_m) and more.mean() > 2.0 * error)


def _like_the_best(best: _Held, held: Sequence[_Held], length_m: float, runs: Sequence[Run]) -> list[_Held]:
    """What the runs do not tell from the best. The side that breaks the custom (x is forward) goes first."""
    group = [h for h in held if h is best or not _worse(h, best, length_m)]
    special = [h for h in group if h.special]
    wanted = "prior" if abs(forward_deg(runs)) < 15.0 else "scans"
    by_convention = [h for h in special if h.reading.told_by in (wanted, "order") or _is_left_handed(h.reading)]
    numbers = [h for h in group if not h.special and h.reading.told_by == wanted]
    chosen = by_convention or numbers or special or group
    if not any(h.reading.angle for h in chosen):
        chosen += [h for h in numbers if h.reading.angle]
    return sorted(chosen, key=lambda h: h.median)


def _is_left_handed(reading: Reading) -> bool:
    return "left-handed" in reading.name


def forward_deg(runs: Sequence[Run]) -> float:
    """The azimuth in the scans towards which the vehicle moves, median over the runs' first steps."""
    ahead = [run.T_first_lidar[1, :2, 3] for run in runs if np.linalg.norm(run.T_first_lidar[1, :2, 3]) > 0.05]
    if not ahead:
        return 0.0
    angle = np.array([np.arctan2(y, x) for x, y in ahead])
    return float(np.degrees(np.arctan2(np.median(np.sin(angle)), np.median(np.cos(angle)))))


def _number_reading(m: Measured, T: F64, runs: Sequence[Run], road: Road) -> Reading:
    if m.kind == "scale":
        return Reading(*_scale_words(m, road), m.poses)
    if m.kind == "time":
        what = f"the prior is {abs(m.value):.2f} s {'late' if m.value > 0 else 'early'} (+-{m.sigma:.2f})"
        return Reading(what, f"shift its times by {-m.value:+.2f} s, or its rows against the scans", m.poses)
    if m.kind == "pitch":
        side = "scans" if road.tilt_deg > 0.5 * abs(m.value) else "prior"
        return Reading(*small_words(m), m.poses, side, angle=True)
    forward, drift = forward_deg(runs), drift_angle_deg(T)
    if abs(forward) > max(0.5 * abs(m.value), 2.0 * abs(drift)):
        back = "face backwards (x to the rear): they " if abs(forward) > 170.0 else ""
        what = f"the scans {back}are turned by {forward:.1f} deg about z (+-{m.sigma:.1f}) from the direction of travel"
        return Reading(what, "turn the points, or T_base_lidar, so that x is forward", m.poses, "scans", angle=True)
    what = f"the prior's headings are off by {m.value:.1f} deg (+-{m.sigma:.1f}), counter-clockwise"
    return Reading(what, f"turn its rotations by {-m.value:.1f} deg about z", m.poses, angle=True)


def _scale_words(m: Measured, road: Road) -> tuple[str, str]:
    """Which side has the wrong scale shows by the sensor's height over the road."""
    low, high = _HEIGHT_M
    size = f"{m.value:.3f} times (+-{m.sigma:.3f})" if 0.1 < m.value < 10 else f"{m.value:.3g} times"
    usual, other = low <= road.depth_m <= high, low <= road.depth_m * m.value <= high
    if road.is_there and other and not usual:
        what = f"the scans are {1 / m.value:.3f} times too large (+-{m.sigma / m.value**2:.3f})"
        return (
            f"{what}: by them the road lies {road.depth_m:.1f} m below",
            f"multiply their points by {m.value:.4f} (feet are 0.3048 m)",
        )
    if road.is_there and usual and not other:
        return f"the prior's positions are {size} too large", f"divide its positions by {m.value:.4f}"
    what = f"the prior's positions are {size} too large, or the scans that much too small"
    return what, "compare with a length that you know; Mercator's metres need a projection (UTM), feet 0.3048"


def _named(group: Sequence[_Held], as_it_is: _Held, best: _Held, length_m: float) -> Finding:
    names = "; or ".join(h.reading.name for h in group)
    mends = "; or ".join(dict.fromkeys(h.reading.mend for h in group))
    apart = " (this drive cannot tell which: a turn would)" if len(group) > 1 else ""
    so = f": so {best.median:.2f} m remain over {length_m:.0f} m driven, else {as_it_is.median:.2f} m"
    return Finding("error", names + apart + so, mends)


def _nothing_fits(as_it_is: _Held, runs: Sequence[Run], length_m: float, told_m: float) -> Finding:
    fits = as_it_is.misfit < 0.1 + 0.1 * length_m
    if fits.mean() >= 0.25:
        bad = [run for run, good in zip(runs, fits, strict=True) if not good]
        first, last = bad[0].indices[0], bad[-1].indices[-1]
        places = f"in {fits.sum()} of {len(fits)} places"
        what = f"the prior fits the scans in {places} only; it does not between scans {first} and {last}"
        return Finding("error", what, "did it stand still, jump or change its frame there? Leave that part out")
    what = (
        f"prior and scans do not belong together under any reading: the scans move {length_m:.1f} m where the prior "
        f"moves {told_m:.1f} m, {as_it_is.median:.1f} m apart"
    )
    return Finding("error", what, "is it the trajectory of this drive, one row for each scan, in order?")


def _places(as_it_is: _Held, runs: Sequence[Run]) -> list[Finding]:
    usual = as_it_is.median
    bad = np.flatnonzero(as_it_is.misfit > 4.0 * usual + 1.0)
    if not len(bad):
        return []
    run = runs[int(bad[np.argmax(as_it_is.misfit[bad])])]
    what = (
        f"between scans {run.indices[0]} and {run.indices[-1]} the prior is {as_it_is.misfit[bad].max():.1f} m off the "
        f"scans' motion, elsewhere {usual:.1f} m ({len(bad)} of {len(runs)} places)"
    )
    grave: Severity = "error" if as_it_is.misfit[bad].max() > 5.0 else "warning"
    return [Finding(grave, what, "a jump, or rows that belong to other scans: mend or leave out that part")]


def _scatter(drive: Drive, as_it_is: _Held, length_m: float) -> list[Finding]:
    expected = 1.5 * drive.prior_sigma_m + 10.0 * np.radians(2.0 * drive.prior_sigma_deg) + 0.01 * length_m
    if as_it_is.median < 0.8 * expected:
        return []
    what = (
        f"the prior is off the scans' motion by {as_it_is.median:.1f} m over {length_m:.0f} m, but prior_sigma_m says "
        f"{drive.prior_sigma_m:g}"
    )
    return [Finding("warning", what, "say how far it may be off: prior_sigma_m, prior_sigma_deg in drive.toml")]


def _cannot_tell(
    as_it_is: _Held, held: Sequence[_Held], length_m: float, turns: float, clockwise: bool
) -> list[Finding]:
    """Readings that this drive would not betray. Of a mirror the way in which the points go round is a hint."""
    like = [h.reading for h in held if h.special and not _worse(h, as_it_is, length_m)]
    if not like:
        return []
    names = "; ".join(reading.name for reading in like)
    what = f"{CANNOT_TELL}: {names}"
    if any(_is_left_handed(reading) for reading in like) and turns > 0.5 and clockwise:
        what += " (the points go round counter-clockwise, most sensors clockwise)"
    return [Finding("note", what, "check with a drive that turns, or against a map (--map)", map_tells=True)]
