"""Faults at a path, whatever lies there: a map, a ballot, a bag, a store, a drive, or a drive on a map.

A ballot: does it look as if the vehicle knew
where it was? A store: is every byte what it was, can anybody use it, is its newest map sound?
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.codec.ballot import decode, is_ballot, unpack_states
from mapvote.core.mount import mount_of_prior
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import F64, CellState, Drive, MapvoteError
from mapvote.doctor import Finding, Progress, any_error, in_order
from mapvote.doctor.bags import check_bag, check_lidars_of_bag
from mapvote.doctor.drive_evidence import DriveEvidence, check_ranges, check_road
from mapvote.doctor.lean import RULES as ROAD_BELOW
from mapvote.doctor.map_fit import MapEvidence, check_cloud_on_map, check_on_map, in_another_unit
from mapvote.doctor.map_points import check_cloud
from mapvote.doctor.maps import check_map, classified_ground, examine_map, tile_by_tile
from mapvote.doctor.off_surfaces import check_points
from mapvote.doctor.prior_fit import agreement, check_attitude
from mapvote.doctor.reading_on_map import decided_by_map
from mapvote.doctor.scans import IN_MAP_FRAME, NO_PRIOR, cheap_checks
from mapvote.formats import is_cloud, open_drive_on
from mapvote.formats.drives.rosbag import open_rosbag
from mapvote.formats.registry import drive_format


@record()
@dataclass(frozen=True, slots=True)
class BallotCheck:
    """Limits of a sound ballot."""

    most_changed: float = 0.2
    """Share of determined cells that are changed, at most."""
    sigma_m: float = 0.15
    """Median standard deviation of the poses, at most, metres."""


BALLOT_CHECK = BallotCheck()


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Findings of the doctor, errors first, and the poses of a drive."""

    findings: list[Finding]
    drive: Drive | None = None
    T_mended: F64 | None = None
    """(n, 4, 4) takes its points, as they are in the files, to their place in the map; None if unknown."""


def examine_drive(drive: Drive, progress: Progress | None = None) -> tuple[list[Finding], F64 | None]:
    """(findings, errors first; the prior (n, 4, 4) as it would be mended) of a drive."""
    e = DriveEvidence(drive, progress)
    cheap = cheap_checks(drive, e.looks)
    if IN_MAP_FRAME in cheap:  # then nothing else can be checked
        return cheap, np.tile(np.eye(4), (len(drive), 1, 1))
    mount = None if e.T is None else mount_of_prior(e.T)
    if mount is not None:
        turned = DriveEvidence(mount.turned(drive), progress)
        vars(turned)["looks"] = e.looks
        findings, T = _by_scans(turned)
        # Prior and points that agree on a mount are sound. A road below a sensor that leans so shows the mount, too.
        if not any_error(findings) or (
            mount.lean_deg > ROAD_BELOW.lean_deg and turned.road.up == "+z" and turned.road.is_there
        ):
            findings = [replace(f, readings=()) for f in findings]  # of the turned prior
            return in_order([*cheap, *findings]), e.T if T is turned.T or T is None else T @ mount.C
    findings, T = _by_scans(e)
    return in_order([*cheap, *findings]), T


def _by_scans(e: DriveEvidence) -> tuple[list[Finding], F64 | None]:
    """(what scans show once they are compared, the prior (n, 4, 4) as it would be mended)."""
    findings = [*check_ranges(e), *check_road(e), *e.leaps]
    of_prior, T = agreement(e)
    attitude = [] if any_error(of_prior) else check_attitude(e)
    return [*findings, *of_prior, *attitude], T


def diagnose(
    path: Path,
    options: Mapping[str, Any] | None = None,
    point_map: PointMap | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Everything the doctor finds at ``path``: in a map, a ballot or a drive; with ``point_map``, also whether a drive
    or a map lies on it. ``options``: of the drive, as ``open_drive`` takes them."""
    if is_cloud(path):
        findings, cloud = examine_map(path)
        if point_map is not None and cloud is not None:
            findings = in_order([*findings, *check_cloud_on_map(point_map, cloud)])
        return Diagnosis(findings)
    layout = drive_format(path)
    if path.is_file() and layout is None and (path.suffix == ".ballot" or is_ballot(path.read_bytes())):
        return Diagnosis(list(check_ballot(path.read_bytes())))
    options = options or {}
    drive, unopened = _opened(path, options, point_map)
    of_bag = layout is not None and layout.open is open_rosbag
    findings = unopened + (check_bag(path, **options) if of_bag else [])
    T = None
    if drive is not None:
        mend = "the drive is read without them; was the sensor off, or the disk full?"
        findings += [Finding("warning", sentence, mend) for sentence in drive.left_out]
        lidars = check_lidars_of_bag(path, drive, options) if of_bag else []
        findings += lidars
        # Scans put together wrongly fit neither each other nor a prior.
        more, T = ([], None) if any_error(lidars) else examine_drive(drive, progress)
        # A prior that could not be read has its error: the note that there is none is left out.
        findings += [f for f in more if not (unopened and f == NO_PRIOR)]
    if point_map is not None:
        findings, T = _with_map(findings, drive, T, point_map, progress)
    as_read = T is (None if drive is None else drive.T_map_lidar_prior)
    return Diagnosis(in_order(findings), drive, None if as_read and any_error(findings) else T)


def _opened(path: Path, options: Mapping[str, Any], point_map: PointMap | None) -> tuple[Drive | None, list[Finding]]:
    """(the drive as `vote` opens it, what stopped it from opening so): neither a broken prior nor points whose times
    cannot be told hide anything else."""
    findings: list[Finding] = []
    unread: Drive | None = None
    for without in ({}, {"motion_compensated": True}, {"prior": "none"}, {"prior": "none", "motion_compensated": True}):
        try:
            drive = open_drive_on(point_map, path, **{**options, **without})
        except MapvoteError as error:
            findings = findings or [Finding("error", str(error))]
            continue
        refusal = _refusal_of_all(drive)
        if not refusal:
            return drive, findings
        unread = unread or drive
        findings = findings or [Finding("error", refusal)]
    # Scans that cannot be read in any way have a finding each.
    return unread, findings if unread is None else [f for f in findings if f.what != _refusal_of_all(unread)]


def _refusal_of_all(drive: Drive) -> str:
    """Why the first, the middle and the last scan cannot be read; "" if one of them can."""
    refusal = ""
    for i in (0, len(drive) // 2, len(drive) - 1):
        try:
            drive.read_scan(i)
        except MapvoteError as error:
            refusal = refusal or str(error)
        else:
            return ""
    return refusal


def _with_map(
    findings: list[Finding], drive: Drive | None, T: F64 | None, point_map: PointMap, progress: Progress | None
) -> tuple[list[Finding], F64 | None]:
    """(the findings with those on the map and on the drive on it; the poses (n, 4, 4) as they lie on the map)."""
    of_points = [f for f in check_cloud(tile_by_tile(point_map), classified_ground(point_map)) if f.severity != "note"]
    of_map = of_points + [f for f in check_map(point_map) if f.severity != "note"]
    named = [replace(f, what=f"the map: {f.what}") for f in of_map]
    if drive is not None and not any_error(of_points):
        findings, T_read = decided_by_map(findings, drive, point_map, progress)
        T = T if T_read is None else T_read
    if drive is None or T is None or any_error(findings):
        return findings + named, T
    if any_error(of_points):  # as it is, no scan can fit it
        unit = in_another_unit(MapEvidence(drive, T, point_map, progress))
        return [*findings, *named, *([unit] if unit is not None else [])], T
    mount = mount_of_prior(T)
    if mount is None:
        more, T = check_on_map(drive, T, point_map, progress)
    else:
        more, T_level = check_on_map(mount.turned(drive), T @ mount.C.T, point_map, progress)
        T = T_level @ mount.C
    if not any_error(more):
        more += check_points(drive, list(T), point_map, localised=False)
    if not of_map and all(f.severity == "note" for f in more):
        findings = [f for f in findings if not f.map_tells]
    return [*findings, *named, *more], T


def check_ballot(data: bytes) -> Iterator[Finding]:
    """Everything that shows in the bytes of a ballot."""
    try:
        ballot = decode(data)
        counts = np.zeros(256, dtype=np.int64)
        for tile in ballot.tiles:
            if tile.states is not None:
                counts += np.bincount(unpack_states(tile.states).ravel(), minlength=256)
    except MapvoteError as error:
        yield Finding("error", str(error), "vote again with the drive, or copy the ballot again")
        return
    changed = int(counts[[CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY]].sum())
    determined = changed + int(counts[[CellState.UNCHANGED_OCCUPIED, CellState.UNCHANGED_EMPTY]].sum())
    if not ballot.tiles:
        problem = "it votes on no tile: no scan was localised, or none saw a cell of the map"
        yield Finding("error", problem, "see mapvote doctor DRIVE --map MAP")
    elif determined and changed > BALLOT_CHECK.most_changed * determined:
        problem = f"it calls {changed / determined:.0%} of the {determined:,} cells that it judges changed"
        yield Finding("warning", problem, "a lost vehicle, or the wrong map? Streets change by a few per cent")
    if ballot.end_ns <= ballot.start_ns:
        yield Finding("error", "its drive ends before it begins", "mend the times of the drive, and vote again")
    if ballot.scans_localised < 0.5 * ballot.scans:
        problem = f"only {ballot.scans_localised} of {ballot.scans} scans were localised"
        yield Finding("warning", problem, "is it the map of this street? mapvote doctor DRIVE --map MAP")
    if ballot.median_sigma_m > BALLOT_CHECK.sigma_m:
        problem = f"the sigma of the vehicle's position was {ballot.median_sigma_m:.2f} m (median)"
        yield Finding("warning", problem, "cells are 0.3 m wide: such votes blur")
    misfit_m = ballot.prior_misfit_m
    sigma_m = ballot.prior_sigma_m
    if misfit_m is not None and sigma_m is not None and misfit_m > max(3.0 * sigma_m, 0.5):
        problem = f"the prior was {misfit_m:.1f} m off the localised path (median), but states {sigma_m:.2f} m"
        yield Finding("warning", problem, "measure the offset: mapvote doctor DRIVE --map MAP")
