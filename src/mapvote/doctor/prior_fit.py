"""Do prior and scans agree? The motion that the scans show is held against the prior under every reading of it.

First what is grossly wrong, by runs of some twenty metres: the reading that leaves least unexplained. Then, of a prior
that is right but for a little, scale, heading and pitch by one fit to a chain of some 300 m. The error of that fit is
how the prior strays from the chain: positions err alike for seconds, so many scans say hardly more than a few would.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mapvote.core.types import F64, I64, Drive
from mapvote.doctor.finding import Finding, Severity
from mapvote.doctor.motion import LEAST_FIT, Road, Run
from mapvote.doctor.prior import (
    AS_IT_IS,
    LEAST,
    LEVER_M,
    LIKELY,
    READINGS,
    SURE,
    Measured,
    Reading,
    at_times,
    drift_angle_deg,
    measure_scale,
    measure_time,
    measure_turn,
    misfits,
    scaled,
)
from mapvote.doctor.similarity import fit_similarity

CHAIN_SCANS = 150
"""Of a chain: some 300 m."""
_POSITION_M, _ROTATION_RAD = 0.15, np.radians(0.25)
"""Errors of a prior's pose against a chain: they weigh positions against rotations."""
_CHAIN_SCALE, _CHAIN_RAD = 0.003, np.radians(0.15)
"""What the chain itself may err by."""
_FIRSTS = 6
"""Readings that are tried as the first of two faults."""
_HEIGHT_M = (0.8, 4.0)
"""Of a LiDAR over the road."""
CANNOT_TELL = "without a turn this drive cannot decide whether"


@dataclass(frozen=True, slots=True)
class Whole:
    """How the prior differs from a chain of scans."""

    scale: Measured
    turn: Measured
    pitch: Measured
    length_m: float
    """Of the chain, end to end."""
    rms_m: float
    """How far the prior strays from the chain once scale and turn are taken out."""


def unbroken(chain: Run) -> Run:
    """Up to the first scan that does not fit those before it."""
    bad = np.flatnonzero(chain.fit < LEAST_FIT)
    end = int(bad[0]) if len(bad) else len(chain.fit)
    return Run(chain.indices[:end], chain.T_first_lidar[:end], chain.fit[:end])


def held_against(T: F64, chain: Run, prior_sigma_m: float = 0.0) -> Whole | None:
    """The prior's poses T (n, 4, 4) against the chain; None where it is too short or hardly moves.

    ``prior_sigma_m``: an error that grows along the drive looks like a scale, and across it like a turn; from one end
    to the other two errors of the prior differ by sqrt(2) of it.
    """
    seen = chain.T_first_lidar
    if len(seen) < 5:
        return None
    away = seen[:, :3, 3] - seen[:, :3, 3].mean(axis=0)
    reach_m, extent_m = float(np.sqrt((away**2).sum(axis=1).mean())), float(np.linalg.norm(np.ptp(away, axis=0)))
    if reach_m < 1.0:
        return None
    fit = fit_similarity(seen, T[chain.indices], position_m=_POSITION_M, rotation_rad=_ROTATION_RAD, own_turn=True)
    strays = float(np.linalg.norm(fit.off_m, axis=1).mean()) / reach_m
    share = float(np.hypot(strays, np.sqrt(2.0) * prior_sigma_m / extent_m))
    yaw_deg, pitch_deg = fit.own_deg
    back = np.eye(4)
    back[:3, :3] = scipy.spatial.transform.Rotation.from_euler("zy", fit.own_deg, degrees=True).inv().as_matrix()
    sigma_deg = float(np.degrees(np.hypot(share, _CHAIN_RAD)))

    def turned(T: F64) -> F64:
        return np.asarray(T @ back)

    return Whole(
        Measured("scale", fit.scale, fit.scale * float(np.hypot(share, _CHAIN_SCALE)), scaled(1.0 / fit.scale)),
        Measured("turn", yaw_deg, sigma_deg, turned),
        Measured("pitch", -pitch_deg, sigma_deg, turned),
        float(np.linalg.norm(seen[-1, :3, 3])),
        fit.rms_m,
    )


def check_small(
    T: F64, chain: Run, runs: Sequence[Run], time: Measured | None, stamps_ns: I64, prior_sigma_m: float
) -> list[Finding]:
    """Of the prior's poses T (n, 4, 4): scale, turn and pitch by the chain, the shift in time by the runs as well.

    What is no larger than four standard errors cannot be decided: a note.
    """
    followed, chain = chain, unbroken(chain)
    found = _broken(followed, len(chain.indices))
    whole = held_against(T, chain, prior_sigma_m)
    if time is not None and _shows(time, T, runs):
        later = held_against(at_times(T, stamps_ns, time.value), chain, prior_sigma_m)
        speed_mps = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) / (np.diff(stamps_ns) * 1e-9)
        shift_m = abs(time.value) * float(np.median(speed_mps))
        if (
            whole is not None
            and later is not None
            and later.rms_m < 0.8 * whole.rms_m
            and shift_m > SURE * min(prior_sigma_m, later.rms_m)
        ):
            return [*found, Finding("error" if abs(time.value) > 2.0 * LEAST["time"] else "warning", *time.words)]
    if whole is None:
        return [*found, Finding("note", "too few scans fit each other to measure scale and heading", "drive farther")]
    small = [f for m in (whole.scale, whole.turn, whole.pitch) for f in _told(m)]
    shown = any(f.severity != "note" for f in small)
    return found + small + ([] if shown else [_not_shown(whole, time)])


def _broken(chain: Run, after: int) -> list[Finding]:
    """Where a scan does not fit the ``after`` ones before it, though the runs do by themselves."""
    if after == len(chain.indices):
        return []
    before, scan = chain.indices[after - 1], chain.indices[after]
    what = f"between scans {before} and {scan} the sensor is elsewhere at once: they do not fit each other"
    return [Finding("warning", what, "are scans missing there, or out of order?")]


def _shows(time: Measured, T: F64, runs: Sequence[Run]) -> bool:
    before, after = (float(np.median(misfits(one, runs))) for one in (T, time.poses(T)))
    return abs(time.value) > time.least and before - after > 0.25 * before


def _told(m: Measured) -> list[Finding]:
    off, sigma = m.off
    if off <= max(LEAST[m.kind], LIKELY * sigma):
        return []
    what, mend = m.words
    if off <= SURE * sigma:
        return [Finding("note", f"{what}; that may be chance", f"a longer drive decides; else: {mend}")]
    return [Finding("error" if off > 2.0 * LEAST[m.kind] else "warning", what, mend)]


def _not_shown(whole: Whole, time: Measured | None) -> Finding:
    """How large a mistake may be before this drive shows it: a short one shows little."""
    told = [f"{whole.scale.least:.0%} of scale", f"{whole.turn.least:.0f} deg of heading"]
    told += [f"{time.least:.1f} s"] if time is not None else []
    what = f"over {whole.length_m:.0f} m mistakes of the prior show from {', '.join(told)} on"
    return Finding("note", what, "a longer drive with turns shows smaller ones")


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
    # What the prior's own errors explain is no reason to read it otherwise.
    likely = [h for h in held if as_it_is.median > _explained_m(drive, h.reading, h.median, length_m)]
    best = min([as_it_is, *likely], key=lambda h: h.median)
    floor_m = 0.1 + 0.12 * length_m + 2.0 * min(drive.prior_sigma_m, 1.5)
    if _clearly_better(best, as_it_is, length_m):
        if best.median > floor_m:
            pair = _two_at_once(T, held, runs, road)
            if pair is None or pair[1].median > floor_m:
                return [_nothing_fits(as_it_is, runs, length_m, told_m)], T
            one, other = pair
            mended = one.reading.poses(T)
            first = Finding("error", f"two faults at once: {one.reading.name}", one.reading.mend)
            behind = _named([other], one, other, length_m)
            return [first, replace(behind, what=f"and once that is mended: {behind.what}")], other.reading.poses(mended)
        group = _like_the_best(best, held, length_m, runs)
        found, T = [_named(group, as_it_is, best, length_m)], best.reading.poses(T)
        right_handed = bool(np.linalg.det(T[0, :3, :3]) > 0)
        if len(group) == 1 and right_handed and best.median > 0.1 + 0.02 * length_m:  # another fault may hide behind it
            more, mended = check_agreement(drive, T, runs, road, turns, chain)
            more = [replace(f, what=f"and once that is mended: {f.what}") for f in more if f.severity == "error"]
            found, T = found + more, mended if more else T
        return found, T
    if as_it_is.median > floor_m:
        return [_nothing_fits(as_it_is, runs, length_m, told_m)], T
    found = check_small(T, chain(), runs, time, drive.stamps_ns, drive.prior_sigma_m)
    found += _places(as_it_is, runs, drive.prior_sigma_m) + _scatter(drive, as_it_is, length_m)
    found += _cannot_tell(as_it_is, held, length_m, turns, drive.sensor.clockwise)
    return found, T


def _two_at_once(T: F64, held: Sequence[_Held], runs: Sequence[Run], road: Road) -> tuple[_Held, _Held] | None:
    """The two readings, the second of a prior mended by the first, that leave least of the motion unexplained."""
    best: tuple[_Held, _Held] | None = None
    for one in sorted(held, key=lambda h: h.median)[:_FIRSTS]:
        mended = one.reading.poses(T)
        if one.reading.catch_all or np.linalg.det(mended[0, :3, :3]) < 0:
            continue
        others = [_held(reading, mended, runs) for reading in READINGS if not reading.catch_all]
        for m in (measure_scale(mended, runs), *measure_turn(mended, runs)):
            others.append(_held(_number_reading(m, mended, runs, road), mended, runs, special=False))
        other = min(others, key=lambda h: h.median)
        if best is None or other.median < best[1].median:
            best = one, other
    return best


def _explained_m(drive: Drive, reading: Reading, left_m: float, length_m: float) -> float:
    """By how much the prior's own errors may move the ends of a run. Where ``left_m`` remains under a reading, they are
    hardly more than twice that, whatever drive.toml states. A catch-all levels the prior too."""
    tilt_m = LEVER_M * np.radians(2.0 * drive.prior_sigma_deg) if reading.catch_all else 0.0
    return float(1.5 * min(drive.prior_sigma_m, 2.0 * left_m) + tilt_m + 0.01 * length_m)


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
    """Whether the runs distinguish ``one`` from the best."""
    more = one.misfit - best.misfit
    error = float(more.std()) / np.sqrt(len(more)) + 0.02
    return bool(np.median(more) > max(0.05, 0.004 * length_m) and more.mean() > 2.0 * error)


def _like_the_best(best: _Held, held: Sequence[_Held], length_m: float, runs: Sequence[Run]) -> list[_Held]:
    """The readings that the runs do not distinguish from the best. The side that breaks convention (x is forward)
    first."""
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
        return Reading(m.words[0], f"shift its times by {-m.value:+.2f} s, or its rows against the scans", m.poses)
    if m.kind == "pitch":
        side = "scans" if road.tilt_deg > 0.5 * abs(m.value) else "prior"
        return Reading(*m.words, m.poses, side, angle=True)
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
    apart = " (this drive cannot decide which: a turn would)" if len(group) > 1 else ""
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


def _places(as_it_is: _Held, runs: Sequence[Run], prior_sigma_m: float) -> list[Finding]:
    """Where the prior leaves the scans' motion by far more than elsewhere; a note where it is said to err so much: two
    errors of it may differ by three standard errors."""
    usual = as_it_is.median
    bad = np.flatnonzero(as_it_is.misfit > 4.0 * usual + 1.0)
    if not len(bad):
        return []
    run, most_m = runs[int(bad[np.argmax(as_it_is.misfit[bad])])], float(as_it_is.misfit[bad].max())
    what = (
        f"between scans {run.indices[0]} and {run.indices[-1]} the prior is {most_m:.1f} m off the scans' motion, "
        f"elsewhere {usual:.1f} m ({len(bad)} of {len(runs)} places)"
    )
    grave: Severity = "note" if most_m <= 3.0 * prior_sigma_m else "warning"
    if most_m > max(5.0, 4.0 * prior_sigma_m):
        grave = "error"
    return [Finding(grave, what, "a jump, or rows that belong to other scans: mend or leave out that part")]


def _scatter(drive: Drive, as_it_is: _Held, length_m: float) -> list[Finding]:
    expected = 1.5 * drive.prior_sigma_m + LEVER_M * np.radians(2.0 * drive.prior_sigma_deg) + 0.01 * length_m
    if as_it_is.median < expected:
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
