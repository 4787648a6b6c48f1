"""What is wrong at a path, whatever lies there: a map, a ballot, a bag, a store, a drive, or a drive on a map.

A bag: its topics, rates and clocks, and what joins its frames. A ballot: does it look as if the vehicle knew
where it was? A store: is every byte what it was, can anybody use it, is its newest map sound?
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import scipy

from mapvote.codec.ballot import decode, unpack_states
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, I64, CellState, Drive, MapvoteError
from mapvote.doctor import Finding, Progress, Severity, any_error, in_order
from mapvote.doctor.drive_evidence import DriveEvidence, check_ranges, check_road
from mapvote.doctor.map_fit import MapEvidence, check_cloud_on_map, check_on_map, in_another_unit
from mapvote.doctor.maps import check_cloud, check_map, examine_map, tile_by_tile
from mapvote.doctor.prior_fit import agreement, check_attitude
from mapvote.doctor.scans import IN_MAP_FRAME, NO_PRIOR, cheap_checks
from mapvote.formats import is_cloud, open_drive
from mapvote.formats.drives.options import DriveOptions, SaidOfDrive, drive_options
from mapvote.formats.drives.rosbag import CLOUD, GNSS, POSES, Bag, T_from, frame_id, is_rosbag, static_frames
from mapvote.formats.registry import DRIVES

_LATE_S = 0.5
"""Between the stamp in a header and the receipt: more is another clock."""

_Times = Mapping[str, I64]
"""Of each topic (messages, 2): when it was received and when it was stamped, nanoseconds."""
_CHANGED = (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY)
_DETERMINED = (CellState.UNCHANGED_OCCUPIED, CellState.UNCHANGED_EMPTY, *_CHANGED)
_MOST_CHANGED = 0.2
_SIGMA_M = 0.15


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What the doctor found, errors first, and of a drive how it lies."""

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
    found = [*cheap, *check_ranges(e), *check_road(e), *e.leaps]
    of_prior, T = agreement(e)
    attitude = [] if any_error(of_prior) else check_attitude(e)
    return in_order([*found, *of_prior, *attitude]), T


def diagnose(
    path: Path,
    options: Mapping[str, Any] | None = None,
    point_map: PointMap | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Everything the doctor finds at ``path``: in a map, a ballot or a drive; with ``point_map``, also whether a drive
    or a map lies on it. ``options``: of the drive, as ``open_drive`` takes them."""
    if is_cloud(path):
        found, cloud = examine_map(path)
        if point_map is not None and cloud is not None:
            found = in_order([*found, *check_cloud_on_map(point_map, cloud)])
        return Diagnosis(found)
    if path.is_file() and not any(layout.recognised(path) for layout in DRIVES.values()):
        return Diagnosis(list(check_ballot(path.read_bytes())))
    options = options or {}
    drive, unopened = _opened(path, options)
    found = unopened + (check_bag(path, **options) if is_rosbag(path) else [])
    T = None
    if drive is not None:
        more, T = examine_drive(drive, progress)
        # That a prior that could not be read is missing goes without saying.
        found += [f for f in more if not (unopened and f == NO_PRIOR)]
    if point_map is not None:
        found, T = _with_map(found, drive, T, point_map, progress)
    as_read = T is (None if drive is None else drive.T_map_lidar_prior)
    return Diagnosis(in_order(found), drive, None if as_read and any_error(found) else T)


def _opened(path: Path, options: Mapping[str, Any]) -> tuple[Drive | None, list[Finding]]:
    """(the drive, what stopped it from opening as it is): a broken prior hides nothing else."""
    found: list[Finding] = []
    for prior in (options.get("prior"), "none"):
        try:
            return open_drive(path, **{**options, "prior": prior}), found
        except MapvoteError as error:
            found = found or [Finding("error", str(error))]
    return None, found


def _with_map(
    found: list[Finding], drive: Drive | None, T: F64 | None, point_map: PointMap, progress: Progress | None
) -> tuple[list[Finding], F64 | None]:
    """(also what is wrong with the map, and with the drive on it; the poses (n, 4, 4) as they lie on the map)."""
    of_points = [f for f in check_cloud(tile_by_tile(point_map)) if f.severity != "note"]
    of_map = of_points + [f for f in check_map(point_map) if f.severity != "note"]
    named = [replace(f, what=f"the map: {f.what}") for f in of_map]
    if drive is None or T is None or any_error(found):
        return found + named, T
    if any_error(of_points):  # as it is, no scan can fit it
        unit = in_another_unit(MapEvidence(drive, T, point_map, progress))
        return [*found, *named, *([unit] if unit is not None else [])], T
    more, T = check_on_map(drive, T, point_map, progress)
    if not of_map and all(f.severity == "note" for f in more):
        found = [f for f in found if not f.map_tells]
    return [*found, *named, *more], T


def check_bag(path: Path, **said: Unpack[SaidOfDrive]) -> list[Finding]:
    """Topics, rates, clocks and frames of the bag at ``path``; nothing of what its scans show."""
    try:
        bag = Bag(path)
        times = {topic: _times(bag, topic) for topic in bag.topics(CLOUD, *POSES, *GNSS)}
        return [*_topics(bag, times), *_clocks(bag, times), *_poses(bag, times, drive_options(path, **said))]
    except MapvoteError as error:
        return [Finding("error", str(error))]


def _times(bag: Bag, topic: str) -> I64:
    rows = [(received_ns, bag.stamp_ns(data)) for _, received_ns, data in bag.raw(topic)]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _topics(bag: Bag, times: _Times) -> Iterator[Finding]:
    others = []
    for name, topic in sorted(bag.reader.topics.items()):
        if topic.msgtype not in (CLOUD, *POSES, *GNSS):
            others.append(f"{name} ({topic.msgcount})")
            continue
        seconds = float(np.ptp(times[name][:, 0])) * 1e-9 if len(times[name]) else 0.0
        rate = f"{(len(times[name]) - 1) / seconds:.1f} Hz" if seconds > 0 else "no rate"
        yield Finding("note", f"{name}: {topic.msgcount} messages of {topic.msgtype}, {rate}")
        if topic.msgtype == CLOUD and topic.msgcount == 0:
            yield Finding("warning", f"{name} holds no message", "did the driver run? Record it again")
    if others:
        yield Finding("note", f"other topics: {', '.join(others)}")


def _clocks(bag: Bag, times: _Times) -> Iterator[Finding]:
    """Stamps of the headers against the times of receipt."""
    for topic in bag.topics(CLOUD):
        received, stamps = times[topic].T
        if len(stamps) < 3:
            continue
        late_s = float(np.median(received - stamps)) * 1e-9
        back = int((np.diff(stamps) <= 0).sum())
        if (stamps == 0).all():
            what = f"{topic}: headers carry no stamps, the times of receipt are used"
            yield Finding("warning", what, "let the driver stamp its messages: receipt comes late and unevenly")
        elif back:
            what = f"{topic}: stamps do not go forward, {back} times"
            yield Finding("error", what, "two recordings joined, or a clock set back: cut the bag there")
        elif abs(late_s) > _LATE_S:
            what = f"{topic}: messages were received {late_s:.2f} s after their stamps (median)"
            yield Finding("note", what, "the sensor keeps another clock: do the poses keep the same one?")


def _poses(bag: Bag, times: _Times, options: DriveOptions) -> Iterator[Finding]:
    """Which topics may serve as prior, whether they span the scans, and how far the LiDAR sits from what they track."""
    clouds, poses = list(bag.topics(CLOUD)), list(bag.topics(*POSES, *GNSS))
    if not clouds:
        return
    if not poses:
        yield Finding("note", "no topic of poses or GNSS fixes: a prior must come from a file (--prior)")
        return
    if options.prior is None:
        what = f"no prior is chosen, but there are poses: {', '.join(poses)}"
        yield Finding("warning", what, f"--prior {poses[0]}")
    lidar, scans, edges = frame_id(bag, clouds[0]), times[clouds[0]][:, 1], static_frames(bag)
    for topic in poses:
        stamps = times[topic][:, 1]
        outside = float(((scans < stamps.min()) | (scans > stamps.max())).mean()) if len(stamps) and len(scans) else 0.0
        if outside > 0.05:
            grave: Severity = "error" if outside > 0.9 else "warning"
            mend = "do both keep one clock? Use times of one computer, or PTP"
            what = f"{topic} has no pose at the time of {outside:.0%} of the scans"
            yield Finding(grave, what, mend if outside > 0.9 else "leave these scans out with --scans")
        tracked = frame_id(bag, topic, child=True)
        if tracked and tracked != lidar:
            what = f"{topic} tracks {tracked}, the scans are of {lidar}"
            yield _mounted(what, T_from(edges, tracked).get(lidar), options)


def _mounted(what: str, T: F64 | None, options: DriveOptions) -> Finding:
    if T is None:
        mend = "give it: --mount X,Y,Z,ROLL,PITCH,YAW (metres, degrees)"
        return Finding("warning", f"{what}; nothing in /tf_static says where that sits on it", mend)
    if options.mount or options.T_base_lidar or np.allclose(T, np.eye(4), atol=1e-3):
        return Finding("note", f"{what}: /tf_static says where that sits on it")
    rpy_deg = scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)
    mend = "--mount " + ",".join(f"{v:.3f}" for v in (*T[:3, 3], *rpy_deg))
    return Finding("warning", f"{what}: /tf_static says where that sits on it, the prior does not know", mend)


def check_ballot(data: bytes) -> Iterator[Finding]:
    """Everything that shows in the bytes of a ballot."""
    try:
        ballot = decode(data)
        counts = np.zeros(256, dtype=np.int64)
        for tile in ballot.tiles:
            if tile.states is not None:
                counts += np.bincount(unpack_states(tile.states).ravel(), minlength=256)
    except MapvoteError as error:
        yield Finding("error", str(error), "cast it again from the drive, or copy it again")
        return
    changed, determined = int(counts[list(_CHANGED)].sum()), int(counts[list(_DETERMINED)].sum())
    if not ballot.tiles:
        what = "it votes on no tile: the vehicle never knew where it was, or saw no cell of the map"
        yield Finding("error", what, "see mapvote doctor DRIVE --map MAP")
    elif determined and changed > _MOST_CHANGED * determined:
        what = f"it calls {changed / determined:.0%} of the {determined:,} cells that it judges changed"
        yield Finding("warning", what, "a lost vehicle, or the wrong map? Streets change by a few per cent")
    if ballot.end_ns <= ballot.start_ns:
        yield Finding("error", "the drive ends before it begins", "mend the times of the drive, and vote again")
    if ballot.scans_localised < 0.5 * ballot.scans:
        what = f"only {ballot.scans_localised} of {ballot.scans} scans were localised"
        yield Finding("warning", what, "is it the map of this street? mapvote doctor DRIVE --map MAP")
    if ballot.median_sigma_m > _SIGMA_M:
        what = f"the vehicle knew where it was to {ballot.median_sigma_m:.2f} m only (median)"
        yield Finding("warning", what, "cells are 0.3 m: such votes blur")
    misfit_m, sigma_m = ballot.prior_misfit_m, ballot.prior_sigma_m
    if misfit_m is not None and sigma_m is not None and misfit_m > max(3.0 * sigma_m, 0.5):
        what = f"the vehicle was {misfit_m:.1f} m off its prior (median), which claims {sigma_m:.2f} m"
        yield Finding("warning", what, "measure the offset: mapvote doctor DRIVE --map MAP")
