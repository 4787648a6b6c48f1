"""The list of broken drives; how each is made is in broken_drives.py."""

from __future__ import annotations

import numpy as np

from broken_drives import (
    Kind,
    as_text_sorted,
    azimuth,
    cut_bytes,
    degrees,
    deltas,
    doubled,
    edit_lines,
    elsewhere,
    every_tenth,
    five_columns,
    frozen,
    in_map_axes,
    in_map_frame,
    jump,
    noise,
    one_scan,
    points,
    poses,
    positions,
    reordered,
    rotations,
    rows,
    scattered_ranges,
    shifted_rows,
    shuffled,
    spikes,
    times,
    turn_points,
    turn_poses,
    wave,
    with_roof,
    with_yaw,
)
from mapvote.core.geometry import inverse
from mapvote.doctor.prior import CAMERA_TO_LIDAR

CAMERA = CAMERA_TO_LIDAR[:3, :3]
MIRROR = "left-handed|mirrored"
TURN = r"turned by|turned against each other|headings are off|backward"
SCALE = r"too large|too small|in scale"
ORDER = "in order of time|reverse order|out of order"


def half(s: np.ndarray) -> np.ndarray:
    return s[azimuth(s) > 0]


POINTS = (
    points("points in the vehicle's left-handed axes", MIRROR, lambda p: p * [1, -1, 1]),
    points("points mirrored front to back", MIRROR, lambda p: p * [-1, 1, 1]),
    points("points facing backwards", TURN, lambda p: p * [-1, -1, 1]),
    points("points upside down, turned over", "upside down", lambda p: p * [1, -1, -1]),
    points("points with z negated", "upside down", lambda p: p * [1, 1, -1]),
    points("points with x and y swapped", "x and y of the scans are swapped", lambda p: p[:, [1, 0, 2]]),
    points("points in camera axes", "axis -y points up", lambda p: p @ CAMERA),
    points("points with y up", r"axis \+y points up", lambda p: p[:, [0, 2, 1]] * [1, 1, -1]),
    points("points with x up", r"axis \+x points up", lambda p: p[:, [2, 1, 0]]),
    points("points turned by 90 deg (x right, y forward)", TURN, turn_points(yaw=90)),
    points("points turned by -90 deg", TURN, turn_points(yaw=-90)),
    points("points turned by 30 deg", TURN, turn_points(yaw=30)),
    points("points turned by 8 deg", TURN, turn_points(yaw=8)),
    points("points pitched by 12 deg", "tilted|pitched", turn_points(pitch=12)),
    points("points pitched by 6 deg", "tilted|pitched", turn_points(pitch=6)),
    points("points rolled by 10 deg", "tilted|rolled", turn_points(roll=10)),
    points("points in millimetres", "millimetres", lambda p: 1000 * p),
    points("points in centimetres", "centimetres", lambda p: 100 * p),
    points("points in feet", SCALE, lambda p: p / 0.3048),
    points("points taken for feet", SCALE, lambda p: p * 0.3048),
    points("points in kilometres", r"m away in the median|metres", lambda p: p / 1000),
    points("points 6 % too large", SCALE, lambda p: 1.06 * p),
    points("points rounded to whole metres", "rounded to 1 m", np.round),
    points("points rounded to 0.25 m", "rounded to 0.25 m", lambda p: np.round(4 * p) / 4),
    points(
        "ranges that scatter by 0.4 m",
        "rough|scatter",
        scattered_ranges(0.4),
    ),
    points("points without height", "z is 0", lambda p: p * [1, 1, 0]),
    points(
        "points with absolute values of y",
        "y is never negative",
        lambda p: np.column_stack([p[:, 0], abs(p[:, 1]), p[:, 2]]),
    ),
    Kind("points in the map's frame", "map's frame already", in_map_frame),
    Kind("points turned into the map's axes", "map's axes already|" + TURN, in_map_axes),
)
FILES = (
    rows("intensity in z", "z (lies within|is never)|intensity", lambda s: s[:, [0, 1, 3, 2]]),
    rows("intensity in x", "x (lies within|is never)|intensity", lambda s: s[:, [3, 0, 1, 2]]),
    rows(
        "five columns named like KITTI's",
        "column|intensity|not finite|5 %|x, y, z",
        five_columns,
    ),
    rows("half of the azimuth missing", "deg of azimuth", half),
    rows("the rear quarter and more missing", "deg of azimuth", lambda s: s[abs(azimuth(s)) < 120]),
    rows("cut to 10 m", "lie within", lambda s: s[np.linalg.norm(s[:, :3], axis=1) < 10]),
    rows("one point in sixty", "few for", lambda s: s[::60]),
    rows("without the lower beams", "no road", lambda s: s[s[:, 2] > -1.0]),
    rows(
        "with the vehicle's own roof",
        "own body",
        with_roof,
    ),
    rows("a tenth of the points NaN", "not finite", every_tenth(np.nan)),
    rows(
        "a tenth of the points at infinity",
        "not finite",
        every_tenth(np.inf),
    ),
    rows(
        "float64 read as float32",
        "not finite|5 %|not float32",
        lambda s: np.ascontiguousarray(s, dtype="<f8").view("<f4").reshape(-1, 4),
    ),
    rows(
        "big-endian",
        "not finite|5 %|no usable",
        lambda s: np.ascontiguousarray(s, dtype=">f4").view("<f4").reshape(-1, 4),
    ),
    one_scan("one scan cut off at a point", "cut off", lambda s: s[: len(s) // 3]),
    one_scan("one scan without 100 deg", "lacks|cut off", lambda s: s[abs(azimuth(s) - 40) > 50]),
    one_scan("one scan empty", "no usable|empty|holds no|0 bytes", lambda s: s[:0]),
    one_scan("one scan full of NaN", "not finite", lambda s: s * np.nan),
    Kind("one file cut off in a point", "multiple of|cut off", files=cut_bytes(7)),
    Kind(
        "every second scan doubled, the others lost",
        "same as the one before",
        reordered(doubled),
    ),
    Kind("scans shuffled", ORDER, reordered(shuffled)),
    Kind("scans in reverse order", ORDER, reordered(lambda n: np.arange(n)[::-1])),
    Kind("scans sorted as text", ORDER, reordered(as_text_sorted)),
    Kind(
        "two halves of the drive swapped",
        f"{ORDER}|do not fit|does not between|belongs? to|between scans",
        reordered(lambda n: np.roll(np.arange(n), n // 2)),
    ),
)
PRIOR = (
    poses("inverse poses", "inverse poses", lambda T: np.array([inverse(one) for one in T])),
    rotations("rotations transposed", "transposed", lambda R: np.swapaxes(R, 1, 2)),
    poses("prior in camera axes", "camera axes|camera poses", lambda T: CAMERA_TO_LIDAR.T @ T @ CAMERA_TO_LIDAR),
    with_yaw("heading as a compass bearing", "compass|" + TURN, lambda a: np.pi / 2 - a),
    with_yaw("heading from north, counter-clockwise", TURN, lambda a: a - np.pi / 2),
    with_yaw("headings turned about", TURN, lambda a: a + np.pi),
    with_yaw("headings off by 20 deg", TURN, lambda a: a + np.radians(20)),
    with_yaw("headings off by 6 deg", TURN, lambda a: a + np.radians(6)),
    with_yaw("headings in degrees taken for radians", "rotations do not belong|" + TURN, lambda a: np.degrees(a)),
    with_yaw("headings in radians taken for degrees", "rotations do not belong|" + TURN, lambda a: np.radians(a)),
    with_yaw("headings missing", "rotations do not belong|" + TURN, lambda a: 0 * a),
    poses("poses pitched by 10 deg", "tilted|pitched", turn_poses(pitch=10)),
    poses("poses rolled by 12 deg", "tilted|rolled", turn_poses(roll=12)),
    positions("positions in millimetres", "millimetres", lambda p: 1000 * p),
    positions("positions in centimetres", "centimetres", lambda p: 100 * p),
    positions("positions in kilometres", "kilometres", lambda p: p / 1000),
    positions("positions in feet", SCALE, lambda p: p / 0.3048),
    positions("positions in Mercator's metres", SCALE, lambda p: p * [1.53, 1.53, 1]),
    positions("positions 10 % too large", SCALE, lambda p: 1.1 * p),
    positions("positions 4 % too small", SCALE, lambda p: 0.96 * p),
    positions("positions as longitude, latitude", "longitude, latitude", degrees(False)),
    positions("positions as latitude, longitude", "latitude, longitude", degrees(True)),
    positions("x and y of positions swapped", "x and y are swapped|" + TURN, lambda p: p[:, [1, 0, 2]]),
    positions("y of positions negated", "y negated|" + TURN, lambda p: p * [1, -1, 1]),
    positions("x of positions negated", "negated|reverse|" + TURN, lambda p: p * [-1, 1, 1]),
    positions(
        "positions that scatter by 4 m", "scatter|off the scans' motion|do not belong together|jumps", noise(4.0)
    ),
    positions("positions rounded to whole metres", "rounded to", np.round, grave=False),
    poses("heights that go up and down by 3 m", "off the scans' motion|pitched|do not belong|between scans", wave),
    poses("the prior frozen from the middle", "stands still|fits the scans in|repeat", frozen),
    poses("a jump of 30 m", "jumps", jump(30.0)),
    poses("a jump of 3 m", "jumps|between scans|fits the scans in", jump(3.0), grave=False),
    poses("spikes of 25 m", "jumps", spikes),
    poses(
        "the prior does not move",
        "does not move|scans do not move|stands still|do not belong|repeat|prior moves 0.0",
        lambda T: np.tile(T[:1], (len(T), 1, 1)),
    ),
    poses("rows in reverse order", ORDER, lambda T: T[::-1]),
    poses("rows shuffled", "jumps|do not belong|order", lambda T: T[shuffled(len(T))]),
    poses("another drive's trajectory", "do not belong together|trajectory of this drive", elsewhere),
    poses("steps instead of poses", "counts from the one before", deltas),
    poses("rows 12 scans late", "late|early|s off|does not between|between scans", shifted_rows(12), grave=False),
    Kind("one row missing", "one line a scan|lines for", files=edit_lines("prior.txt", lambda lines: lines[:-1])),
    Kind(
        "one row not a number",
        "not a number|nan|number|finite",
        files=edit_lines("prior.txt", lambda lines: [*lines[:4], "nan " * 12, *lines[5:]]),
    ),
    Kind(
        "rotations scaled",
        "orthonormal|rigid",
        files=edit_lines(
            "prior.txt", lambda lines: [" ".join(str(2 * float(v)) for v in line.split()) for line in lines]
        ),
    ),
)
TIMES = (
    times("times in milliseconds", "milliseconds", lambda t: 1e3 * t),
    times("times in microseconds", "microseconds", lambda t: 1e6 * t),
    times("times divided by 1000", "divided by 1000", lambda t: t / 1000),
    times("times that run ten times too fast", "m/s|turns at|times", lambda t: t / 10),
    times("times in reverse", "not sorted", lambda t: t[::-1]),
    times("times of whole seconds", "not sorted", np.floor),
    times("two times alike", "not sorted", lambda t: np.where(np.arange(len(t)) == 9, t[8], t)),
    times(
        "times that jitter by 40 ms",
        "uneven|not sorted",
        lambda t: t + np.random.default_rng(2).uniform(-0.04, 0.04, len(t)),
        grave=False,
    ),
    times(
        "a hole of eight seconds that is none",
        "holes in the times",
        lambda t: np.where(np.arange(len(t)) > len(t) // 2, t + 8.0, t),
    ),
    Kind("one time missing", "lines for|one line a scan", files=edit_lines("times.txt", lambda lines: lines[:-1])),
    Kind(
        "one time not a number",
        "not a time",
        files=edit_lines("times.txt", lambda lines: [*lines[:3], "n/a", *lines[4:]]),
    ),
)
KINDS = (*POINTS, *FILES, *PRIOR, *TIMES)
