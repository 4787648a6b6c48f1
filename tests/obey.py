"""A user who does what the doctor advises, word by word, and nothing else: advice becomes a change of the recording."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from faults import Recording, points, poses, positions, rotations, times, turn, turned, yaws
from mapvote.core.geometry import inverse, inverses
from mapvote.core.types import F64
from mapvote.doctor import Finding
from mapvote.doctor.prior import CAMERA_TO_LIDAR

Mend = Callable[[Recording], Recording]
NUMBER = r"(-?\d+(?:\.\d+)?(?:e[+-]?\d+)?)"
CAMERA = CAMERA_TO_LIDAR[:3, :3]
UPRIGHT = {
    "-y": CAMERA,
    "+y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "+x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "-x": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
}
"""Turns the axis that points up to z; which way is ahead then shows at the next look."""


def chained(T: F64) -> F64:
    out = [np.eye(4)]
    for step in T[1:]:
        out.append(out[-1] @ step)
    return np.array(out)


def rows_later(T: F64, scans: int) -> F64:
    """The rows of other scans, so many later; beyond the ends the vehicle goes on as it drives there."""
    if scans < 0:
        return rows_later(T[::-1], -scans)[::-1]
    step = T[0] @ inverse(T[1])
    before = [np.linalg.matrix_power(step, k) @ T[0] for k in range(scans, 0, -1)]
    return np.concatenate([np.array(before).reshape(-1, 4, 4), T])[: len(T)]


def without(r: Recording, numbers: Iterable[int]) -> Recording:
    """The drive with these scans left out by --scans."""
    left_out = set(numbers)
    kept = [i for i in range(len(r.scans)) if i not in left_out]
    T = r.T[kept] if len(r.T) == len(r.scans) else r.T
    return replace(r, scans=[r.scans[i] for i in kept], T=T, times_s=r.times_s[kept])


def metres(p: F64, longitude: int) -> F64:
    """Positions in degrees on a plane at the first of them."""
    lon, lat = p[:, longitude], p[:, 1 - longitude]
    east_m = 111_320.0 * np.cos(np.radians(lat[0]))
    return np.column_stack([(lon - lon[0]) * east_m, (lat - lat[0]) * 111_320.0, p[:, 2]])


ADVICE: list[tuple[str, str, Callable[[re.Match[str], re.Match[str]], Mend]]] = [
    # of the points
    (r"", r"negate y and z of every point", lambda w, m: points(lambda p: p * [1, -1, -1])),
    (r"", r"or only z, if right and left", lambda w, m: points(lambda p: p * [1, 1, -1])),
    (r"", r"negate y of every point|negate y of the map's points, or", lambda w, m: points(lambda p: p * [1, -1, 1])),
    (r"", r"negate x of every point", lambda w, m: points(lambda p: p * [-1, 1, 1])),
    (r"", r"swap x and y of every point", lambda w, m: points(lambda p: p[:, [1, 0, 2]])),
    (r"axis (..) points up", r"turn the points to x forward", lambda w, m: points(lambda p: p @ UPRIGHT[w[1]].T)),
    (rf"scans [^;]*turned by {NUMBER} deg", r"turn the points, or T_base_lidar, so that x is forward",
     lambda w, m: points(turned(yaw=-float(w[1])))),
    (r"", rf"turn the points by {NUMBER} deg about x and {NUMBER} deg about y",
     lambda w, m: points(turned(roll=float(m[1]), pitch=float(m[2])))),
    (rf"scans are pitched by {NUMBER} deg", r"level the points, or put",
     lambda w, m: points(turned(pitch=float(w[1])))),
    (r"", r"turn the points back by the prior's rotation", lambda w, m: lambda r: replace(
        r, scans=[np.column_stack([s[:, :3] @ T[:3, :3], s[:, 3:]]) for s, T in zip(r.scans, r.T, strict=True)])),
    (r"", r"give poses without rotation", lambda w, m: rotations(lambda R: np.broadcast_to(np.eye(3), R.shape))),
    (r"", rf"shift its rows by {NUMBER} scans", lambda w, m: poses(lambda T: rows_later(T, int(m[1])))),
    (rf"divide x, y, z by {NUMBER}", r"", lambda w, m: points(lambda p: p / float(w[1]))),
    (rf"multiply x, y, z by {NUMBER}", r"", lambda w, m: points(lambda p: p * float(w[1]))),
    (rf"positions are {NUMBER} times", r"multiply the points by that", lambda w, m: points(lambda p: p * float(w[1]))),
    (r"", rf"multiply their points by {NUMBER}", lambda w, m: points(lambda p: p * float(m[1]))),
    (r"", r"p_lidar = inverse\(T_map_lidar\)", lambda w, m: lambda r: replace(r, scans=[
        np.column_stack([s[:, :3] @ inverse(T)[:3, :3].T + inverse(T)[:3, 3], s[:, 3:]])
        for s, T in zip(r.scans, r.T, strict=True)])),
    # of the prior
    (r"", r"write T_map_lidar, the inverse of each matrix", lambda w, m: poses(inverses)),
    (r"put KITTI's calib.txt into", r"", lambda w, m: poses(lambda T: CAMERA_TO_LIDAR @ T @ CAMERA_TO_LIDAR.T)),
    (r"", r"put KITTI's calib.txt into", lambda w, m: poses(lambda T: CAMERA_TO_LIDAR @ T @ CAMERA_TO_LIDAR.T)),
    (r"", r"transpose the 3 x 3 rotations", lambda w, m: rotations(lambda R: np.swapaxes(R, 1, 2))),
    (r"", r"use yaw = 90 deg - bearing", lambda w, m: yaws(lambda a: np.pi / 2 - a)),
    (r"", rf"divide its positions by {NUMBER}", lambda w, m: positions(lambda p: p / float(m[1]))),
    (r"", rf"multiply its positions by {NUMBER}", lambda w, m: positions(lambda p: p * float(m[1]))),
    (r"degrees \(longitude", r"project them to metres", lambda w, m: positions(lambda p: metres(p, 0))),
    (r"degrees \(latitude", r"project them to metres", lambda w, m: positions(lambda p: metres(p, 1))),
    (r"", r"swap the first two coordinates", lambda w, m: positions(lambda p: p[:, [1, 0, 2]])),
    (r"", r"negate y of its positions", lambda w, m: positions(lambda p: p * [1, -1, 1])),
    (r"", r"chain them", lambda w, m: poses(chained)),
    (r"", r"reverse its rows", lambda w, m: poses(lambda T: T[::-1])),
    (r"", r"reverse the scans", lambda w, m: lambda r: replace(r, scans=r.scans[::-1])),
    (r"", rf"turn its rotations by {NUMBER} deg", lambda w, m: poses(lambda T: T @ turn(yaw=float(m[1])))),
    # of the times
    (r"times are milliseconds", r"convert times", lambda w, m: times(lambda t: t / 1e3)),
    (r"times are microseconds", r"convert times", lambda w, m: times(lambda t: t / 1e6)),
    (rf"were divided by {NUMBER}", r"convert times", lambda w, m: times(lambda t: t * float(w[1]))),
    # of single scans
    (r"scan (\d+) ", r"leave (?:it|these scans) out", lambda w, m: lambda r: without(r, [int(w[1])])),
    (r"0*(\d+)\.bin: .*--scans", r"", lambda w, m: lambda r: without(r, [int(w[1])])),
    (r"", r"leave the copies out", lambda w, m: lambda r: without(r, copies(r))),
]  # fmt: skip
"""(in what is found, in its mend, what is done then); a number is the doctor's."""


def copies(r: Recording) -> list[int]:
    return [i for i in range(1, len(r.scans)) if np.array_equal(r.scans[i], r.scans[i - 1])]


def mends(finding: Finding) -> Iterator[Mend]:
    """Actions of a user on one finding, in the order of its words; nothing if it names no change that can be made."""
    found = []
    for what, mend, of in ADVICE:
        in_what, in_mend = re.search(what, finding.what), re.search(mend, finding.mend)
        if in_what and in_mend:
            found.append((in_mend.start(), of(in_what, in_mend)))
    yield from (one for _, one in sorted(found, key=lambda pair: pair[0]))


def obeyed(
    r: Recording, look: Callable[[Recording], list[Finding]], most: int = 3
) -> tuple[Recording, list[Finding], int]:
    """(the recording once all advice is followed, what is found then, how many mends): the first error, or warning,
    that names a change is obeyed, and of alternatives the one after which least is wrong."""
    found = look(r)
    for done in range(most):
        bad = [f for f in found if f.severity != "note"]
        ways = next((list(mends(f)) for f in bad if any(True for _ in mends(f))), [])
        if not bad or not ways:
            return r, found, done
        tried = [(way(r)) for way in ways]
        looks = [look(one) for one in tried]
        best = min(range(len(ways)), key=lambda k: weight(looks[k]))
        if weight(looks[best]) > weight(found):
            return r, found, done
        r, found = tried[best], looks[best]
    return r, found, most


def weight(found: list[Finding]) -> int:
    return sum({"error": 10, "warning": 1, "note": 0}[f.severity] for f in found)
