"""Do prior and scans agree? The motion that the scans show is compared with the prior under every reading of it.

First what is grossly wrong, by runs of some twenty metres: the reading that leaves least unexplained. Then, of a prior
that is right but for a little, scale, heading and pitch by one fit to a chain of some 300 m. The error of that fit is
how the prior strays from the chain: positions err alike for seconds, so many scans say hardly more than a few would.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mapvote.core.geometry import poses_at
from mapvote.core.record import record
from mapvote.core.types import F64, Drive
from mapvote.doctor import Finding, Reading, Severity
from mapvote.doctor.drive_evidence import DriveEvidence, Road, Run
from mapvote.doctor.prior import (
    AS_IT_IS,
    PRIOR_CHECK,
    READINGS,
    X_FORWARD,
    Number,
    at_times,
    drift_angle_deg,
    fit_similarity,
    measure_scale,
    measure_time,
    measure_turn,
    median_angle_deg,
    misfits,
    scaled,
    turned,
)
from mapvote.survey.driven_road import wrong_attitude


@record()
@dataclass(frozen=True, slots=True)
class PriorFitRule:
    """Errors and numbers of the comparison of a prior with chains and runs of scans."""

    position_m: float = 0.15
    """Position error of a prior's pose against a chain, metres; it weighs positions against rotations."""
    rotation_rad: float = np.radians(0.25)
    """Rotation error of a prior's pose against a chain, radians."""
    chain_scale: float = 0.003
    """Error of a chain's scale."""
    chain_rad: float = np.radians(0.15)
    """Error of a chain's heading, radians."""
    firsts: int = 6
    """Readings that are tried as the first of two faults."""
    height_m: tuple[float, float] = (0.8, 4.0)
    """Least and largest height of a LiDAR over the road, metres."""


PRIOR_FIT_RULE = PriorFitRule()
FEET_M = 0.3048
CANNOT_TELL = "without a turn this drive cannot decide whether"


@dataclass(frozen=True, slots=True)
class _Fit:
    """How well a reading fits the runs."""

    reading: Reading
    misfit: F64
    """(runs,) metres."""
    special: bool
    """False: a number or a catch-all, named only where nothing more special fits."""

    @property
    def median(self) -> float:
        return float(np.median(self.misfit))


@dataclass(frozen=True, slots=True)
class ChainFit:
    """How the prior differs from a chain of scans."""

    scale: Number
    turn: Number
    pitch: Number
    length_m: float
    """Length of the chain, end to end."""
    rms_m: float
    """How far the prior strays from the chain once scale and turn are taken out."""


def agreement(e: DriveEvidence) -> tuple[list[Finding], F64 | None]:
    """(how prior and scans differ, the prior (n, 4, 4) as it would be mended)."""
    if e.T is None or not e.can_be_registered or e.leaps:
        return [], e.T
    findings, T = compare(e, e.T)
    if e.road.up == "-z":
        # Nothing wrong with a prior shows surely in scans that are mended by a guess.
        return [f for f in findings if f.severity == "error"], T @ np.diag([1.0, -1.0, -1.0, 1.0])
    return findings, T


def check_attitude(e: DriveEvidence) -> Iterator[Finding]:
    """Findings on a precise prior that agrees with the scans; ``build`` uses the same function."""
    if e.T is not None and e.can_be_registered:
        wrong = wrong_attitude(e.drive, e.readable.tolist())
        if wrong is not None:
            yield Finding("warning", wrong.what, wrong.mend)


def compare(e: DriveEvidence, T: F64) -> tuple[list[Finding], F64]:
    """(findings, the poses (n, 4, 4) mended as far as is known), of poses T (n, 4, 4)."""
    drive = e.drive
    runs = e.runs
    length_m = float(np.median([run.length_m for run in runs]))
    prior_m = float(np.median([np.linalg.norm(T[r.indices[-1], :3, 3] - T[r.indices[0], :3, 3]) for r in runs]))
    if length_m < 1.0 and prior_m < 1.0:
        return [Finding("note", "the vehicle hardly moves: prior and scans cannot be compared")], T
    if length_m < min(1.0, 0.1 * prior_m):
        problem = f"the scans stand still where the prior moves {prior_m:.1f} m"
        return [Finding("error", problem, "is it the trajectory of this drive? Are the points in the map's frame?")], T
    as_it_is = _fit(AS_IT_IS, T, runs)
    turn, pitch = measure_turn(T, runs)
    time = measure_time(T, runs, drive.stamps_ns)
    numbers = [measure_scale(T, runs), turn if abs(pitch.value) <= abs(turn.value) else pitch]
    numbers += [time] if time is not None else []
    fits = [_fit(_with_side(reading, runs), T, runs) for reading in READINGS]
    fits += [_fit(_reading_of(number, T, runs, e.road_below), T, runs, special=False) for number in numbers]
    # A deviation that the prior's own errors explain is no reason to read it otherwise.
    likely = [h for h in fits if as_it_is.median > _explained_m(drive, h.reading, h.median, length_m)]
    best = _named_before(min([as_it_is, *likely], key=lambda h: h.median), likely, drive, length_m)
    floor_m = 0.1 + 0.12 * length_m + 2.0 * min(drive.prior_sigma_m, 1.5)
    if not _clearly_better(best, as_it_is, length_m):
        if as_it_is.median > floor_m:
            return [_nothing_fits(as_it_is, runs, length_m, prior_m)], T
        findings = [*check_small(e, T, time), *_places(as_it_is, runs, drive.prior_sigma_m)]
        return [*findings, *_scatter(drive, as_it_is, length_m), *_cannot_tell(as_it_is, fits, length_m, e)], T
    if best.median > floor_m:
        pair = _two_at_once(T, fits, runs, e.road_below)
        if pair is None or pair[1].median > floor_m:
            return [_nothing_fits(as_it_is, runs, length_m, prior_m)], T
        one, other = pair
        first = Finding("error", f"two faults at once: {one.reading.name}", one.reading.mend)
        behind = _named([other], one, other, length_m)
        behind = replace(behind, what=f"and once that is mended: {behind.what}")
        return [first, behind], other.reading.poses(one.reading.poses(T))
    group = _like_the_best(best, fits, length_m, runs)
    named = replace(_named(group, as_it_is, best, length_m), readings=_for_a_map(group, fits, as_it_is, T))
    findings = [named]
    mended = best.reading.poses(T)
    right_handed = bool(np.linalg.det(mended[0, :3, :3]) > 0)
    if len(group) == 1 and right_handed and best.median > 0.1 + 0.02 * length_m:  # another fault may hide behind it
        more, twice_mended = compare(e, mended)
        errors = [f for f in more if f.severity == "error"]
        more = [replace(f, what=f"and once that is mended: {f.what}", readings=()) for f in errors]
        findings = findings + more
        mended = twice_mended if more else mended
    return findings, mended


def _two_at_once(T: F64, fits: Sequence[_Fit], runs: Sequence[Run], road: Road) -> tuple[_Fit, _Fit] | None:
    """The two readings, the second of a prior mended by the first, that leave least of the motion unexplained."""
    pairs = []
    for one in sorted(fits, key=lambda h: h.median)[: PRIOR_FIT_RULE.firsts]:
        mended = one.reading.poses(T)
        if one.reading.catch_all or np.linalg.det(mended[0, :3, :3]) < 0:
            continue
        others = [_fit(_with_side(reading, runs), mended, runs) for reading in READINGS if not reading.catch_all]
        for number in (measure_scale(mended, runs), *measure_turn(mended, runs)):
            others.append(_fit(_reading_of(number, mended, runs, road), mended, runs, special=False))
        pairs.append((one, min(others, key=lambda h: h.median)))
    return min(pairs, key=lambda pair: pair[1].median, default=None)


def _explained_m(drive: Drive, reading: Reading, left_m: float, length_m: float) -> float:
    """By how much the prior's own errors may move the ends of a run. Where ``left_m`` remains under a reading, they are
    hardly more than twice that, whatever drive.toml states. A catch-all levels the prior too."""
    tilt_m = PRIOR_CHECK.lever_m * np.radians(2.0 * drive.prior_sigma_deg) if reading.catch_all else 0.0
    return float(1.5 * min(drive.prior_sigma_m, 2.0 * left_m) + tilt_m + 0.01 * length_m)


def _named_before(best: _Fit, likely: Sequence[_Fit], drive: Drive, length_m: float) -> _Fit:
    """A reading whose rest the prior's own errors explain goes before a number, which takes up a part of them."""
    if best.special or best.reading is AS_IT_IS:
        return best
    enough = [h for h in likely if h.special and h.median <= _explained_m(drive, h.reading, h.median, length_m)]
    return min(enough, key=lambda h: h.median, default=best)


def _fit(reading: Reading, T: F64, runs: Sequence[Run], special: bool = True) -> _Fit:
    return _Fit(reading, misfits(reading.poses(T), runs), special and not reading.catch_all)


def _clearly_better(best: _Fit, other: _Fit, length_m: float) -> bool:
    """In the median, and in most runs by itself: a jump of the prior spoils some runs under every reading. A number
    fits much a little: it must leave less."""
    runs = float((best.misfit < 0.6 * other.misfit).mean())
    return (
        best.median < (0.5 if best.special else 0.4) * other.median
        and other.median - best.median > 0.15 + 0.005 * length_m
        and runs > 0.6
    )


def _worse(one: _Fit, best: _Fit, length_m: float) -> bool:
    """Whether the runs distinguish ``one`` from the best."""
    more = one.misfit - best.misfit
    error = float(more.std()) / np.sqrt(len(more)) + 0.02
    return bool(np.median(more) > max(0.05, 0.004 * length_m) and more.mean() > 2.0 * error)


def _like_the_best(best: _Fit, fits: Sequence[_Fit], length_m: float, runs: Sequence[Run]) -> list[_Fit]:
    """The readings that the runs do not distinguish from the best. The side that breaks convention (x is forward)
    first."""
    group = [h for h in fits if h is best or not _worse(h, best, length_m)]
    special = [h for h in group if h.special]
    wanted = "prior" if abs(_forward_deg(runs)) < 15.0 else "scans"
    by_convention = [h for h in special if h.reading.told_by in (wanted, "order") or h.reading.left_handed]
    numbers = [h for h in group if not h.special and h.reading.told_by == wanted]
    chosen = by_convention or numbers or special or group
    if not any(h.reading.angle for h in chosen):
        chosen += [h for h in numbers if h.reading.angle]
    return sorted(chosen, key=lambda h: h.median)


def _for_a_map(group: Sequence[_Fit], fits: Sequence[_Fit], as_it_is: _Fit, T: F64) -> tuple[Reading, ...]:
    """The readings that a map may decide among: those that are named, then others that leave much less than the prior
    as it is. The first of the readings that align the scans alike is returned."""
    others = [h for h in sorted(fits, key=lambda h: h.median) if h.special and h.median < 0.5 * as_it_is.median]
    out: list[Reading] = []
    for h in [*group, *others]:
        poses = h.reading.poses(T)
        alike = any(np.allclose(poses, one.poses(T), atol=1e-6) for one in out)
        if not alike and len(out) < PRIOR_FIT_RULE.firsts + len(group):
            out.append(h.reading)
    return tuple(out)


def _with_side(reading: Reading, runs: Sequence[Run]) -> Reading:
    """A reading in which the order is wrong names whose: vehicles drive forwards, and scans in reverse order show one
    that drives backwards."""
    if reading.told_by != "order":
        return reading
    if abs(_forward_deg(runs)) > 90.0:
        return replace(reading, name="the scans are in reverse order", mend="reverse the scans: name their files anew")
    return replace(reading, name="the prior's rows are in reverse order", mend="reverse its rows")


def _forward_deg(runs: Sequence[Run]) -> float:
    """The azimuth in the scans towards which the vehicle moves, median over the runs' first steps."""
    ahead = np.array([run.T_first_lidar[1, :2, 3] for run in runs])
    ahead = ahead[np.linalg.norm(ahead, axis=1) > 0.05]
    return median_angle_deg(np.arctan2(ahead[:, 1], ahead[:, 0])) if len(ahead) else 0.0


def _reading_of(number: Number, T: F64, runs: Sequence[Run], road: Road) -> Reading:
    """The reading that a number stands for, with the side that is wrong as far as it shows."""
    value, problem, mend = number.value, *number.words
    if number.kind == "scale":
        return Reading(*_scale_words(number, road), number.poses)
    if number.kind == "time":
        return Reading(problem, f"shift its times by {-value:+.2f} s, or its rows against the scans", number.poses)
    if number.kind == "pitch":
        side = "scans" if road.tilt_deg > 0.5 * abs(value) else "prior"
        return Reading(problem, mend, number.poses, side, angle=True)
    forward = _forward_deg(runs)
    drift = drift_angle_deg(T)
    if abs(forward) > max(0.5 * abs(value), 2.0 * abs(drift)):
        back = "face backwards (x to the rear): they " if abs(forward) > 170.0 else ""
        problem = f"the scans {back}are turned by {forward:.1f} deg about z (+-{number.sigma:.1f})"
        problem += " from the direction of travel"
        return Reading(problem, X_FORWARD, number.poses, "scans", angle=True)
    problem = f"the prior's headings are off by {value:.1f} deg (+-{number.sigma:.1f}), counter-clockwise"
    return Reading(problem, f"turn its rotations by {-value:.1f} deg about z", number.poses, angle=True)


def _unit_near(m: Number) -> float:
    """The factor between feet and metres that a scale is within its error, or 5 %; 0 if it is none."""
    errors = max(0.05, PRIOR_CHECK.likely * m.off[1])
    return next((unit for unit in (FEET_M, 1.0 / FEET_M) if abs(np.log(m.value / unit)) < errors), 0.0)


def _scale_words(m: Number, road: Road) -> tuple[str, str]:
    """Which side has the wrong scale shows by the sensor's height over the road."""
    low, high = PRIOR_FIT_RULE.height_m
    size = f"{m.value:.3f} times (+-{m.sigma:.3f})" if 0.1 < m.value < 10 else f"{m.value:.3g} times"
    usual = low <= road.depth_m <= high
    other = low <= road.depth_m * m.value <= high
    unit = _unit_near(m)
    if road.is_there and other and not usual:
        problem = f"the scans are {1 / m.value:.3f} times too large (+-{m.sigma / m.value**2:.3f})"
        mend = f"multiply their points by {m.value:.4f}, or by the exact factor if you know it"
        if unit:
            mend = f"multiply their points by {unit:.5g} ({'they are' if unit < 1.0 else 'they were taken for'} feet)"
        return f"{problem}: by them the road lies {road.depth_m:.1f} m below", mend
    problem = f"the prior's positions are {size} too large"
    if road.is_there and usual and not other:
        feet = " (they are feet)" if unit > 1.0 else " (they were taken for feet)"
        return (
            problem,
            f"divide its positions by {unit:.5g}{feet}" if unit else f"divide its positions by {m.value:.5g}",
        )
    mend = (
        f"divide its positions by {m.value:.5g}, or multiply the points by that: compare with a length that you know "
    )
    mend += "(Mercator's metres need a projection such as UTM, feet 0.3048), or decide by a map (--map)"
    return f"{problem}, or the scans that much too small", mend


def _named(group: Sequence[_Fit], as_it_is: _Fit, best: _Fit, length_m: float) -> Finding:
    names = "; or ".join(h.reading.name for h in group)
    mends = "; or ".join(dict.fromkeys(h.reading.mend for h in group))
    apart = " (this drive cannot decide which: a turn would, or its map: --map)" if len(group) > 1 else ""
    so = f": so {best.median:.2f} m remain over {length_m:.0f} m driven, else {as_it_is.median:.2f} m"
    return Finding("error", names + apart + so, mends)


def _nothing_fits(as_it_is: _Fit, runs: Sequence[Run], length_m: float, prior_m: float) -> Finding:
    fits = as_it_is.misfit < 0.1 + 0.1 * length_m
    if fits.mean() >= 0.25:
        bad = [run for run, good in zip(runs, fits, strict=True) if not good]
        first = bad[0].indices[0]
        last = bad[-1].indices[-1]
        problem = f"the prior fits the scans in {fits.sum()} of {len(fits)} places only; it does not between scans "
        mend = "did it stand still, jump or change its frame there? Leave that part out"
        return Finding("error", f"{problem}{first} and {last}", mend)
    problem = (
        f"prior and scans do not belong together under any reading: the scans move {length_m:.1f} m where the prior "
        f"moves {prior_m:.1f} m, {as_it_is.median:.1f} m apart"
    )
    return Finding("error", problem, "is it the trajectory of this drive, one row for each scan, in order?")


def check_small(e: DriveEvidence, T: F64, time: Number | None) -> Iterator[Finding]:
    """Findings on poses T (n, 4, 4) with small errors: scale, turn and pitch by the chain, the shift in time by the
    runs as well. A deviation below four standard errors cannot be decided: a note."""
    chain = e.chain.unbroken()
    stamps_ns = e.drive.stamps_ns
    sigma_m = e.drive.prior_sigma_m
    if len(chain.indices) < len(e.chain.indices):  # though the runs fit by themselves
        before, scan = e.chain.indices[len(chain.indices) - 1 : len(chain.indices) + 1]
        problem = f"between scans {before} and {scan} the sensor is elsewhere at once: they do not fit each other"
        yield Finding("warning", problem, "are scans missing there, or out of order?")
    whole = fit_to_chain(T, chain, sigma_m)
    if time is not None and whole is not None and _shows(time, T, e.runs):
        later = fit_to_chain(at_times(T, stamps_ns, time.value), chain, sigma_m)
        speed_mps = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) / (np.diff(stamps_ns) * 1e-9)
        shift_m = abs(time.value) * float(np.median(speed_mps))
        better = later is not None and later.rms_m < 0.8 * whole.rms_m
        if later is not None and better and shift_m > PRIOR_CHECK.sure * min(sigma_m, later.rms_m):
            yield Finding("error" if abs(time.value) > 2.0 * PRIOR_CHECK.least_time_s else "warning", *time.words)
            return
    if whole is None:
        yield Finding("note", "too few scans fit each other to measure scale and heading", "drive farther")
        return
    small = [f for number in (whole.scale, whole.turn, whole.pitch) for f in _small(number)]
    yield from small
    if all(f.severity == "note" for f in small):  # how large a mistake may be: a short drive shows little
        least = [f"{whole.scale.least:.0%} of scale", f"{whole.turn.least:.0f} deg of heading"]
        least += [f"{time.least:.1f} s"] if time is not None else []
        problem = f"over {whole.length_m:.0f} m mistakes of the prior show from {', '.join(least)} on"
        yield Finding("note", problem, "a longer drive with turns shows smaller ones")


def fit_to_chain(T: F64, chain: Run, prior_sigma_m: float = 0.0) -> ChainFit | None:
    """The prior's poses T (n, 4, 4) against the chain; None where it is too short or hardly moves.

    ``prior_sigma_m``: an error that grows along the drive looks like a scale, and across it like a turn; from one end
    to the other two errors of the prior differ by sqrt(2) of it.
    """
    seen = chain.T_first_lidar
    if len(seen) < 5:
        return None
    away = seen[:, :3, 3] - seen[:, :3, 3].mean(axis=0)
    reach_m = float(np.sqrt((away**2).sum(axis=1).mean()))
    extent_m = float(np.linalg.norm(np.ptp(away, axis=0)))
    if reach_m < 1.0:
        return None
    fit = fit_similarity(
        seen,
        T[chain.indices],
        position_m=PRIOR_FIT_RULE.position_m,
        rotation_rad=PRIOR_FIT_RULE.rotation_rad,
        own_turn=True,
    )
    strays = float(np.linalg.norm(fit.off_m, axis=1).mean()) / reach_m
    share = float(np.hypot(strays, np.sqrt(2.0) * prior_sigma_m / extent_m))
    own = scipy.spatial.transform.Rotation.from_euler("zy", fit.own_deg, degrees=True)
    back = turned(poses_at([np.zeros(3)], own.inv().as_matrix())[0])
    yaw_deg, pitch_deg = fit.own_deg
    sigma_deg = float(np.degrees(np.hypot(share, PRIOR_FIT_RULE.chain_rad)))
    return ChainFit(
        Number(
            "scale", fit.scale, fit.scale * float(np.hypot(share, PRIOR_FIT_RULE.chain_scale)), scaled(1.0 / fit.scale)
        ),
        Number("turn", yaw_deg, sigma_deg, back),
        Number("pitch", -pitch_deg, sigma_deg, back),
        float(np.linalg.norm(seen[-1, :3, 3])),
        float(np.sqrt((fit.off_m**2).sum(axis=1).mean())),
    )


def _shows(time: Number, T: F64, runs: Sequence[Run]) -> bool:
    before, after = (float(np.median(misfits(one, runs))) for one in (T, time.poses(T)))
    return abs(time.value) > time.least and before - after > 0.25 * before


def _small(number: Number) -> Iterator[Finding]:
    off, sigma = number.off
    if off <= max(PRIOR_CHECK.least_of(number.kind), PRIOR_CHECK.likely * sigma):
        return
    problem, mend = number.words
    if off <= PRIOR_CHECK.sure * sigma:
        yield Finding("note", f"{problem}; that may be chance", f"a longer drive decides; else: {mend}")
    else:
        yield Finding("error" if off > 2.0 * PRIOR_CHECK.least_of(number.kind) else "warning", problem, mend)


def _places(as_it_is: _Fit, runs: Sequence[Run], prior_sigma_m: float) -> Iterator[Finding]:
    """Where the prior leaves the scans' motion by far more than elsewhere; a note where it is said to err so much: two
    errors of it may differ by three standard errors."""
    usual = as_it_is.median
    bad = as_it_is.misfit > 4.0 * usual + 1.0
    if bad.any():
        worst = int(np.argmax(as_it_is.misfit))
        first = runs[worst].indices[0]
        last = runs[worst].indices[-1]
        most_m = float(as_it_is.misfit[worst])
        problem = (
            f"between scans {first} and {last} the prior is {most_m:.1f} m off the scans' motion, "
            f"elsewhere {usual:.1f} m ({bad.sum()} of {len(runs)} places)"
        )
        grave: Severity = "note" if most_m <= 3.0 * prior_sigma_m else "warning"
        if most_m > max(5.0, 4.0 * prior_sigma_m):
            grave = "error"
        yield Finding(grave, problem, "a jump, or rows that belong to other scans: mend or leave out that part")


def _scatter(drive: Drive, as_it_is: _Fit, length_m: float) -> Iterator[Finding]:
    tilt_m = PRIOR_CHECK.lever_m * np.radians(2.0 * drive.prior_sigma_deg)
    if as_it_is.median >= 1.5 * drive.prior_sigma_m + tilt_m + 0.01 * length_m:
        problem = f"the prior is off the scans' motion by {as_it_is.median:.1f} m over {length_m:.0f} m, but "
        mend = "say how far it may be off: prior_sigma_m, prior_sigma_deg in drive.toml"
        yield Finding("warning", f"{problem}prior_sigma_m says {drive.prior_sigma_m:g}", mend)


def _cannot_tell(as_it_is: _Fit, fits: Sequence[_Fit], length_m: float, e: DriveEvidence) -> Iterator[Finding]:
    """Readings that this drive would not betray. The direction in which the points go round is a hint of a mirror."""
    like = [h.reading for h in fits if h.special and not _worse(h, as_it_is, length_m)]
    if not like:
        return
    problem = f"{CANNOT_TELL}: {'; '.join(reading.name for reading in like)}"
    if any(r.left_handed for r in like) and np.median(e.looks["turns"]) > 0.5 and e.drive.sensor.clockwise:
        problem += " (the points go round counter-clockwise, most sensors clockwise)"
    mend = "check with a drive that turns, or against a map (--map)"
    yield Finding("note", problem, mend, map_tells=True, readings=tuple(like))
