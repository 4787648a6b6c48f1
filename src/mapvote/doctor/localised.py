"""Did the vehicle know where it was? What is asked of a drive once it is localised, before its ballot leaves.

Nothing is registered again: the poses that were found are compared with each other and with the prior. A drive whose
scans are out of order, or whose prior is read in another convention, is localised here and there; vehicles that share
such a defect outvote any quorum. Sound drives pass: a prior may be off by a constant, scatter, stand still or turn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mapvote.codec.ballot import Ballot
from mapvote.core.geometry import inverses, rotation_angles, velocity_changes
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.sensor_height import check_heights
from mapvote.core.types import F64, I64, Bool, Drive, MapvoteError
from mapvote.doctor import Finding
from mapvote.perception.frontend import DriveReport


@record()
@dataclass(frozen=True, slots=True)
class LocalisedRules:
    """Numbers of the checks of a localised drive."""

    least_scans: int = 8
    """Least number of scans for a verdict."""
    least_share: float = 0.5
    """Least share of the scans over the map's ground that must be localised."""
    leap_mps: float = 70.0
    """Greatest speed between two localised scans, metres per second; a faster step is a leap."""
    leap_m: float = 5.0
    """Steps up to this length are no leap, metres: a correction of the track moves it by less."""
    brakes_mps2: float = 8.0
    """Largest acceleration of a vehicle, metres per second squared."""
    velocity_mps: float = 4.0
    """Change of the velocity between two steps that poses 0.1 m off may feign at 10 Hz, metres per second."""
    jerky_share: float = 0.25
    """Greatest share of steps between which the velocity changes by more than both."""
    way_m: float = 10.0
    """Least length of the stretches whose lengths are compared with the prior, metres."""
    way_share: float = 0.25
    """Greatest difference of a stretch by the prior, beside four of its sigmas, as a share of its length."""
    turn_deg: float = 20.0
    """Greatest difference of the prior's attitude, beside four of its sigmas, degrees."""
    off_m: float = 3.0
    """Greatest median scatter of the prior's positions about their mean offset, beside four of its sigmas, metres."""
    low_m: float = 0.15
    """Least median height of a sensor over the map's ground, metres; points nearer to it count from the road."""


LOCALISED_RULES = LocalisedRules()
_PLACE_MEND = (
    "see `mapvote doctor DRIVE --map MAP`: are the scans in order, and is the prior of this drive and in this frame?"
)


@dataclass(frozen=True, slots=True)
class LocalisedDrive:
    """The poses of a drive on a map, beside those that it believed."""

    stamps_ns: I64
    """(n,)"""
    T_map_lidar: F64
    """(n, 4, 4) found."""
    sure: Bool
    """(n,) which of them are trusted."""
    T_prior: F64 | None
    """(n, 4, 4) believed; NaN where nothing was."""
    sigma_m: float
    sigma_deg: float
    """The prior's, as stated."""

    @classmethod
    def of(cls, drive: Drive, T_map_lidar: Sequence[F64] | F64, sure: Bool) -> LocalisedDrive:
        """Findings on a recorded ``drive`` whose scans were localised at poses (n, 4, 4), where ``sure`` (n,)."""
        prior = drive.T_map_lidar_prior
        sigma_m = drive.prior_sigma_m
        sigma_deg = drive.prior_sigma_deg
        if prior is not None and drive.prior_sigmas is not None:  # fixes, which know no attitude
            fixed = np.isfinite(drive.prior_sigmas[:, 0])
            prior = np.where(fixed[:, None, None], prior, np.nan)
            sigma_m = float(drive.prior_sigmas[fixed, 0].max(initial=0.0))
            sigma_deg = np.inf
        return cls(drive.stamps_ns, np.asarray(T_map_lidar), sure, prior, sigma_m, sigma_deg)

    @classmethod
    def of_vote(cls, drive: Drive, report: DriveReport) -> LocalisedDrive:
        """Findings on a recorded ``drive`` that has voted."""
        if not drive.prior_in_map:
            return cls.of_report(report, prior_in_map=False)
        sure = np.ones(len(drive), dtype=np.bool_)
        sure[report.lost] = False
        return cls.of(drive, report.T_map_lidar, sure)

    @classmethod
    def of_report(cls, report: DriveReport, *, prior_in_map: bool = True) -> LocalisedDrive:
        """Findings on the decided scans of ``report``. Priors outside the map's frame say nothing of a scan without a
        sure place: their frame is learnt from the scans that have one."""
        n = len(report.T_map_lidar)
        sure = np.ones(n, dtype=np.bool_)
        sure[[i for i in report.lost if i < n]] = False
        given = [prior for prior in report.priors[:n] if prior is not None]
        T_prior = None
        if given:
            T_prior = np.full((n, 4, 4), np.nan)
            for i, prior in enumerate(report.priors[:n]):
                if prior is not None and (prior_in_map or sure[i]):
                    T_prior[i] = prior.T_map_lidar
        sigma_m = max((prior.sigma_m for prior in given), default=np.inf)
        # Fixes know no attitude.
        sigmas_rad = [np.inf if prior.is_planar else prior.sigma_rad for prior in given]
        sigma_deg = float(np.degrees(max(sigmas_rad, default=np.inf)))
        stamps_ns = np.array(report.stamps_ns[:n], dtype=np.int64)
        return cls(stamps_ns, np.array(report.T_map_lidar).reshape(n, 4, 4), sure, T_prior, sigma_m, sigma_deg)


def check_localised(
    drive: LocalisedDrive, point_map: PointMap | None = None, rules: LocalisedRules = LOCALISED_RULES
) -> Iterator[Finding]:
    """The share of scans with a sure place, leaps, the height over the map's ground, and how prior and found poses
    differ. ``point_map``: scans that lie beside its ground need no place."""
    if len(drive.stamps_ns) < rules.least_scans:
        return
    yield from _share(drive, point_map, rules)
    sure_scans = np.flatnonzero(drive.sure)
    if len(sure_scans) < rules.least_scans:
        return
    yield from _leaps(drive, sure_scans, rules)
    yield from _jerks(drive, sure_scans, rules)
    if point_map is not None:
        yield from _height(drive.T_map_lidar[sure_scans, :3, 3], point_map, rules)
    if drive.T_prior is not None:
        sure_scans = sure_scans[np.isfinite(drive.T_prior[sure_scans]).all(axis=(1, 2))]
        if len(sure_scans) < rules.least_scans:
            return
        yield from _ways(drive, sure_scans, rules)
        yield from _attitude(drive, sure_scans, rules)
        yield from _positions(drive, sure_scans, rules)


def written_if_localised(
    written: Callable[[], Ballot], localised: LocalisedDrive, point_map: PointMap
) -> Callable[[], Ballot]:
    """A function that writes the ballot of a closed stretch of road. It raises MapvoteError, too, if the vehicle did
    not know where it was."""

    def checked() -> Ballot:
        for finding in check_localised(localised, point_map):
            raise MapvoteError(f"{finding.what}. {finding.mend} --unchecked votes all the same")
        return written()

    return checked


def _share(drive: LocalisedDrive, point_map: PointMap | None, rules: LocalisedRules) -> Iterator[Finding]:
    on_map = np.ones(len(drive.stamps_ns), dtype=np.bool_)
    if point_map is not None:
        believed = drive.T_map_lidar[:, :3, 3].copy()
        if drive.T_prior is not None:
            has_prior = np.isfinite(drive.T_prior).all(axis=(1, 2))
            believed[has_prior] = drive.T_prior[has_prior, :3, 3]
        on_map = np.isfinite(point_map.ground_under(believed)) | drive.sure
    scans = int(on_map.sum())
    sure = int(drive.sure.sum())
    if scans >= rules.least_scans and sure < rules.least_share * scans:
        problem = f"only {sure} of {scans} scans that lie on the map could be localised in it"
        yield Finding("error", problem, f"is it the map of this street? {_PLACE_MEND}")


def _leaps(drive: LocalisedDrive, sure_scans: I64, rules: LocalisedRules) -> Iterator[Finding]:
    """Steps from one sure scan to the next that no vehicle drives."""
    step_m = np.linalg.norm(np.diff(drive.T_map_lidar[sure_scans, :3, 3], axis=0), axis=1)
    step_s = np.diff(drive.stamps_ns[sure_scans]) * 1e-9
    leaps = (step_m > rules.leap_m) & (step_m > rules.leap_mps * step_s)
    if leaps.any():
        worst = int(np.argmax(np.where(leaps, step_m, 0.0)))
        times = "once" if leaps.sum() == 1 else f"{int(leaps.sum())} times, most"
        problem = f"the localised path leaps {times} before scan {sure_scans[worst + 1]} "
        yield Finding("error", f"{problem}({step_m[worst]:.1f} m in {step_s[worst]:.2f} s)", _PLACE_MEND)


def _jerks(drive: LocalisedDrive, sure_scans: I64, rules: LocalisedRules) -> Iterator[Finding]:
    """Changes of the velocity, by the places found and the stamps, that no vehicle can make."""
    change_mps, seconds = velocity_changes(drive.T_map_lidar[sure_scans, :3, 3], drive.stamps_ns[sure_scans])
    share = float((change_mps > rules.velocity_mps + rules.brakes_mps2 * seconds).mean())
    if share > rules.jerky_share:
        problem = f"{share:.0%} of the steps of the localised path need an acceleration that no vehicle has"
        yield Finding("error", problem, "are the stamps of the scans right, and the scans in order?")


def _height(positions: F64, point_map: PointMap, rules: LocalisedRules) -> Iterator[Finding]:
    """Where the rays begin, by the positions (n, 3) found: rays from the road see through what stands on it."""
    height_m = check_heights(point_map, positions).median_m
    if height_m < rules.low_m:
        problem = f"the origin of the points lies {height_m:.2f} m over the map's ground, where no sensor is"
        mend = "are they in the vehicle's frame (base_link)? Give them in the sensor's: rays begin at its origin."
        yield Finding("error", problem, mend)


def _ways(drive: LocalisedDrive, sure_scans: I64, rules: LocalisedRules) -> Iterator[Finding]:
    """How far the vehicle came, by the poses found and by the prior, over pieces of the drive."""
    assert drive.T_prior is not None
    driven_m = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(drive.T_map_lidar[sure_scans, :3, 3], axis=0), axis=1))]
    )
    piece = max(rules.way_m, 6.0 * drive.sigma_m)
    marks = np.searchsorted(driven_m, np.arange(0.0, driven_m[-1], piece))
    if len(marks) < 3:
        return
    a = sure_scans[marks[:-1]]
    b = sure_scans[marks[1:]]
    came_m = np.linalg.norm(drive.T_map_lidar[b, :3, 3] - drive.T_map_lidar[a, :3, 3], axis=1)
    believed_m = np.linalg.norm(drive.T_prior[b, :3, 3] - drive.T_prior[a, :3, 3], axis=1)
    slack_m = rules.way_share * np.maximum(came_m, believed_m) + 4.0 * drive.sigma_m
    if np.median(np.abs(came_m - believed_m) - slack_m) > 0.0:
        apart_m = float(np.median(np.abs(came_m - believed_m)))
        problem = (
            f"over stretches of {piece:.0f} m the localised path and the prior differ in length by {apart_m:.1f} m "
            "(median)"
        )
        yield Finding("error", problem, _PLACE_MEND)


def _attitude(drive: LocalisedDrive, sure_scans: I64, rules: LocalisedRules) -> Iterator[Finding]:
    assert drive.T_prior is not None
    apart = inverses(drive.T_prior[sure_scans]) @ drive.T_map_lidar[sure_scans]
    apart_deg = np.degrees(rotation_angles(apart))
    median_deg = float(np.median(apart_deg))
    if median_deg > rules.turn_deg + 4.0 * drive.sigma_deg:
        problem = f"the prior's attitude differs by {median_deg:.0f} deg (median) from the localised one"
        yield Finding("error", problem, f"are the axes of prior and points the same (x forward, z up)? {_PLACE_MEND}")


def _positions(drive: LocalisedDrive, sure_scans: I64, rules: LocalisedRules) -> Iterator[Finding]:
    assert drive.T_prior is not None
    off = drive.T_map_lidar[sure_scans, :2, 3] - drive.T_prior[sure_scans, :2, 3]
    scatter_m = float(np.median(np.linalg.norm(off - np.median(off, axis=0), axis=1)))
    if scatter_m > rules.off_m + 4.0 * drive.sigma_m:
        problem = (
            f"the prior lies {scatter_m:.1f} m (median) about its mean offset from the localised path, but states "
        )
        yield Finding("error", f"{problem}{drive.sigma_m:.2f} m", _PLACE_MEND)
