"""What else the doctor takes, each by itself: a ROS bag, a ballot, a store.

A bag: its topics, rates and clocks, and what joins its frames. A ballot: does it look as if the vehicle knew
where it was? A store: is every byte what it was, can anybody use it, is its newest map sound?
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy

from mapvote.codec.ballot import Ballot, BallotTile, decode, unpack_states
from mapvote.core.types import F64, I64, CellState, MapvoteError
from mapvote.doctor.finding import Finding, in_order
from mapvote.doctor.maps import check_whole
from mapvote.formats.drives.options import DriveOptions
from mapvote.formats.drives.rosbag import CLOUD, GNSS, POSES, Bag, T_from, frame_id, static_frames

if TYPE_CHECKING:
    from mapvote.server.store.store import Store

_LATE_S = 0.5
"""Between the stamp in a header and the receipt: more is another clock."""

_Times = Mapping[str, I64]
"""Of each topic (messages, 2): when it was received and when it was stamped, nanoseconds."""
_CHANGED = (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY)
_DETERMINED = (CellState.UNCHANGED_OCCUPIED, CellState.UNCHANGED_EMPTY, *_CHANGED)
_MOST_CHANGED = 0.2
_SIGMA_M = 0.15
_MEND = "mapvote check STORE --mend --from BACKUP"
_TOLD = 5
"""Damaged records of one kind that are listed one by one."""


def check_bag(path: Path, options: DriveOptions) -> list[Finding]:
    """Topics, rates, clocks and frames of the bag at ``path``; nothing of what its scans show."""
    try:
        bag = Bag(path)
        times = {topic: _times(bag, topic) for topic in bag.topics(CLOUD, *POSES, *GNSS)}
        return _topics(bag, times) + _clocks(bag, times) + _poses(bag, times, options)
    except MapvoteError as error:
        return [Finding("error", str(error))]


def _times(bag: Bag, topic: str) -> I64:
    rows = [(received_ns, bag.stamp_ns(data)) for _, received_ns, data in bag.raw(topic)]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _topics(bag: Bag, times: _Times) -> list[Finding]:
    others, found = [], []
    for name, topic in sorted(bag.reader.topics.items()):
        if topic.msgtype not in (CLOUD, *POSES, *GNSS):
            others.append(f"{name} ({topic.msgcount})")
            continue
        seconds = float(np.ptp(times[name][:, 0])) * 1e-9 if len(times[name]) else 0.0
        rate = f"{(len(times[name]) - 1) / seconds:.1f} Hz" if seconds > 0 else "no rate"
        found.append(Finding("note", f"{name}: {topic.msgcount} messages of {topic.msgtype}, {rate}"))
        if topic.msgtype == CLOUD and topic.msgcount == 0:
            found.append(Finding("warning", f"{name} holds no message", "did the driver run? Record it again"))
    return [*found, Finding("note", f"other topics: {', '.join(others)}")] if others else found


def _clocks(bag: Bag, times: _Times) -> list[Finding]:
    """Stamps of the headers against the times of receipt."""
    found = []
    for topic in bag.topics(CLOUD):
        received, stamps = times[topic].T
        if len(stamps) < 3:
            continue
        late_s = float(np.median(received - stamps)) * 1e-9
        back = int((np.diff(stamps) <= 0).sum())
        if (stamps == 0).all():
            what = f"{topic}: headers carry no stamps, the times of receipt are used"
            found.append(Finding("warning", what, "let the driver stamp its messages: receipt comes late and unevenly"))
        elif back:
            what = f"{topic}: stamps do not go forward, {back} times"
            found.append(Finding("error", what, "two recordings joined, or a clock set back: cut the bag there"))
        elif abs(late_s) > _LATE_S:
            what = f"{topic}: messages were received {late_s:.2f} s after their stamps (median)"
            found.append(Finding("note", what, "the sensor keeps another clock: do the poses keep the same one?"))
    return found


def _poses(bag: Bag, times: _Times, options: DriveOptions) -> list[Finding]:
    """Which topics may serve as prior, whether they span the scans, and how far the LiDAR sits from what they track."""
    clouds, poses = list(bag.topics(CLOUD)), list(bag.topics(*POSES, *GNSS))
    if not clouds:
        return []
    if not poses:
        return [Finding("note", "no topic of poses or GNSS fixes: a prior must come from a file (--prior)")]
    found = []
    if options.prior is None:
        what = f"no prior is chosen, but there are poses: {', '.join(poses)}"
        found.append(Finding("warning", what, f"--prior {poses[0]}"))
    lidar = frame_id(bag, clouds[0])
    edges = static_frames(bag)
    for topic in poses:
        found += _spanned(times[clouds[0]][:, 1], times[topic][:, 1], topic)
        tracked = frame_id(bag, topic, child=True)
        if tracked and tracked != lidar:
            T = T_from(edges, tracked).get(lidar)
            found.append(_mounted(topic, tracked, lidar, T, options))
    return found


def _spanned(scans: I64, poses: I64, topic: str) -> list[Finding]:
    if not len(poses) or not len(scans):
        return []
    outside = float(((scans < poses.min()) | (scans > poses.max())).mean())
    if outside <= 0.05:
        return []
    what = f"{topic} has no pose at the time of {outside:.0%} of the scans"
    if outside > 0.9:
        return [Finding("error", what, "do both keep one clock? Use times of one computer, or PTP")]
    return [Finding("warning", what, "leave these scans out with --scans")]


def _mounted(topic: str, tracked: str, lidar: str, T: F64 | None, options: DriveOptions) -> Finding:
    what = f"{topic} tracks {tracked}, the scans are of {lidar}"
    if T is None:
        mend = "give it: --mount X,Y,Z,ROLL,PITCH,YAW (metres, degrees)"
        return Finding("warning", f"{what}; nothing in /tf_static says where that sits on it", mend)
    if options.mount is not None or np.allclose(T, np.eye(4), atol=1e-3):
        return Finding("note", f"{what}: /tf_static says where that sits on it")
    rpy_deg = scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)
    mend = "--mount " + ",".join(f"{v:.3f}" for v in (*T[:3, 3], *rpy_deg))
    return Finding("warning", f"{what}: /tf_static says where that sits on it, the prior does not know", mend)


def check_ballot(data: bytes) -> list[Finding]:
    """Everything that shows in the bytes of a ballot."""
    try:
        ballot = decode(data)
        changed, determined = _counts(ballot.tiles)
    except MapvoteError as error:
        return [Finding("error", str(error), "cast it again from the drive, or copy it again")]
    found = _votes(ballot, changed, determined)
    if ballot.end_ns <= ballot.start_ns:
        found.append(Finding("error", "the drive ends before it begins", "mend the times of the drive, and vote again"))
    if ballot.scans_localised < 0.5 * ballot.scans:
        what = f"only {ballot.scans_localised} of {ballot.scans} scans were localised"
        found.append(Finding("warning", what, "is it the map of this street? mapvote doctor DRIVE --map MAP"))
    if ballot.median_sigma_m > _SIGMA_M:
        what = f"the vehicle knew where it was to {ballot.median_sigma_m:.2f} m only (median)"
        found.append(Finding("warning", what, "cells are 0.3 m: such votes blur"))
    misfit_m, sigma_m = ballot.prior_misfit_m, ballot.prior_sigma_m
    if misfit_m is not None and sigma_m is not None and misfit_m > max(3.0 * sigma_m, 0.5):
        what = f"the vehicle was {misfit_m:.1f} m off its prior (median), which claims {sigma_m:.2f} m"
        found.append(Finding("warning", what, "measure the offset: mapvote doctor DRIVE --map MAP"))
    return found


def _votes(ballot: Ballot, changed: int, determined: int) -> list[Finding]:
    if not ballot.tiles:
        what = "it votes on no tile: the vehicle never knew where it was, or saw no cell of the map"
        return [Finding("error", what, "see mapvote doctor DRIVE --map MAP")]
    if determined and changed > _MOST_CHANGED * determined:
        what = f"it calls {changed / determined:.0%} of the {determined:,} cells that it judges changed"
        return [Finding("warning", what, "a lost vehicle, or the wrong map? Streets change by a few per cent")]
    return []


def _counts(tiles: list[BallotTile]) -> tuple[int, int]:
    """(cells called changed, cells judged at all)."""
    counts = np.zeros(256, dtype=np.int64)
    for tile in tiles:
        if tile.states is not None:
            counts += np.bincount(unpack_states(tile.states).ravel(), minlength=256)
    return int(counts[list(_CHANGED)].sum()), int(counts[list(_DETERMINED)].sum())


def check_store(store: Store) -> list[Finding]:
    """Everything that the doctor finds in an open store, errors first. Every byte is read."""
    from mapvote.server.views.history import overview

    found = _damage(store)
    at_a_glance = overview(store)
    told = ", ".join(
        f"{at_a_glance[key]:,} {key.replace('_', ' ')}" for key in ("tiles", "ballots", "vehicles", "plane_bytes")
    )
    found.append(Finding("note", f"version {at_a_glance['version']}: {told}"))
    if at_a_glance["quarantined"]:
        what = f"{at_a_glance['quarantined']} damaged things were set aside: their votes and tiles do not count"
        found.append(Finding("warning", what, f"{_MEND} brings back what a backup has"))
    found += _keys(store)
    try:
        return in_order(found + check_whole(store.point_map()))
    except MapvoteError as error:
        return in_order([*found, Finding("error", f"its newest map cannot be read: {error}", _MEND)])


def _damage(store: Store) -> list[Finding]:
    from mapvote.server.store.integrity import check

    damaged = check(store)
    kinds = Counter(damage.kind for damage in damaged)
    found = []
    for kind, count in kinds.items():
        some = [damage for damage in damaged if damage.kind == kind][:_TOLD]
        found += [Finding("error", f"damaged: {damage}", _MEND) for damage in some]
        if count > _TOLD:
            found.append(Finding("error", f"damaged: {count - _TOLD} more of the kind {kind}", _MEND))
    return found


def _keys(store: Store) -> list[Finding]:
    from mapvote.server.store.keys import listed

    valid = Counter(key.role for key in listed(store) if key.valid_at(store.clock()))
    if not valid["operator"]:
        what = "no operator has a valid key: the server cannot be operated remotely"
        return [Finding("warning", what, "mapvote keys STORE issue NAME --role operator")]
    return [Finding("note", "keys: " + ", ".join(f"{count} {role}" for role, count in sorted(valid.items())))]
