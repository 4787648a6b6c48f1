"""The place of a scan in the whole map: a search without any prior, over every place that can be driven on.

Exhaustive correlation (Olson, Real-time correlative scan matching, 2009) with a column word for every metre of map:
the points of the scan, by their heights above the ground, are looked up at every drivable place and heading. Heights
above the ground need no roll, pitch or altitude. The best peaks are refined by NDT and judged like any other pose.
One km2 of streets has some 10^7 places and headings: seconds, so no branching and bounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mapvote.config import NdtSettings
from mapvote.core.columns import flat_cells
from mapvote.core.grid import CELL_SIZE
from mapvote.core.groups import widened
from mapvote.core.kernel import kernel
from mapvote.core.point_map import PointMap, all_points, has_open_ground
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I64, U8, U32, Bool, MapvoteError, Scan
from mapvote.matching.coarse_search import COARSE_SEARCH, best_and_rival, distinct, place_without_prior
from mapvote.matching.matcher import map_around
from mapvote.matching.ndt_voxels import LEVELS
from mapvote.matching.odometry import Tracker
from mapvote.matching.pose_check import POSE_CHECK, Judge, PoseCheck, height_above_lowest
from mapvote.matching.prepare import Sample, deskew, solid_sample, thin_for_levels

MARGIN = 32
"""Margin of every second cell around the map: more than the 45 m within which points are used."""
_SPAN = 64
"""Cells of a row that are looked up together."""


@record()
@dataclass(frozen=True, slots=True)
class GlobalSearchNumbers:
    """Numbers of the search over the whole map."""

    cell_m: float = 1.0
    """Side of a cell."""
    layer_m: float = 1.0
    """Height of a layer."""
    low_m: float = 0.8
    """Least height above the ground of the points that are used."""
    high_m: float = 30.0
    """Greatest height above the ground of the points that are used: 32 layers fit into a word."""
    max_cells: int = 40_000_000
    """Cells of the largest map that is searched: a box of 6 km by 6 km."""
    reach_m: float = 45.0
    """Distance from the sensor up to which points are used."""
    points: int = 200
    """Points that are looked up at each place."""
    first: int = 48
    """Points after which a hopeless place is given up."""
    yaws: int = 120
    """Headings tried, 3 deg apart."""
    spread_m: float = 3.0
    """Distance within which two peaks are one."""
    spread_rad: float = float(np.radians(15.0))
    """Turn within which two peaks are one."""
    peaks: int = 60
    """Peaks that are sharpened on single cells."""
    refined: int = 12
    """Sharpened peaks that are refined by the matcher."""
    judged: int = 3
    """Refined places that are judged."""
    min_score: float = 0.4
    """Mean likelihood of the points above the ground from which a place in a map without ground is accepted."""


GLOBAL_SEARCH = GlobalSearchNumbers()


@dataclass(frozen=True, slots=True)
class CoarseMap:
    """The map in cells of a metre."""

    x0: float
    y0: float
    ground_z: F32
    """(rows, cols) map metres, NaN where unknown."""
    words: U32
    """(rows, cols) occupied layers of a metre above the ground."""
    wide: U32
    """(2, 2, rows / 2, cols / 2) the same, dilated, by even and odd rows and columns, with MARGIN cells and more on
    each side: the words that places on every second cell look up for one point of a scan lie side by side."""
    rows: I64
    cols: I64
    """Cells on a coarser raster in which a vehicle can stand, row by row."""
    spans: I64
    """(m, 3) row and first column in ``wide``, and the first of these cells, of each stretch of a row with any."""


def laid_out(point_map: PointMap, numbers: GlobalSearchNumbers = GLOBAL_SEARCH) -> CoarseMap:
    """The whole map. MapvoteError if it is too large to search."""
    cell_m = numbers.cell_m
    # The box of all tiles.
    windows = [tile.window for tile in point_map.tiles.values()]
    x0 = min(w.x0 for w in windows)
    y0 = min(w.y0 for w in windows)
    cols = int(np.ceil((max(w.x0 + w.cols * CELL_SIZE for w in windows) - x0) / cell_m))
    rows = int(np.ceil((max(w.y0 + w.rows * CELL_SIZE for w in windows) - y0) / cell_m))
    if rows * cols > numbers.max_cells:
        raise MapvoteError(
            f"map {point_map.map_id} is {cols} m by {rows} m: too large to search; give the drive a prior (--prior)"
        )
    # Ground and layers of each tile.
    words = np.zeros((rows, cols), dtype=np.uint32)
    ground_z = np.full((rows, cols), np.nan, dtype=np.float32)
    for tile in point_map.tiles.values():
        x, y = tile.window.centres()
        measured = np.nonzero(np.isfinite(tile.ground_z))
        at = ((y[measured[0]] - y0) / cell_m).astype(np.int64), ((x[measured[1]] - x0) / cell_m).astype(np.int64)
        ground_z[at] = tile.ground_z[measured]
        points = tile.points_map
        height = points[:, 2] - tile.ground_z.reshape(-1)[flat_cells(tile.window, tile.points)]
        tall = (height > numbers.low_m) & (height < numbers.high_m)  # nowhere over unknown ground
        bit = np.uint32(1) << np.floor(height[tall] / numbers.layer_m).astype(np.uint32)
        at = ((points[tall, 1] - y0) / cell_m).astype(np.int64), ((points[tall, 0] - x0) / cell_m).astype(np.int64)
        np.bitwise_or.at(words, at, bit)
    # Cells on which a vehicle can stand: known ground, with no low obstacle in the cell or the four beside it.
    low = (words & np.uint32(0b11)) != 0
    blocked = low.copy()
    blocked[1:] |= low[:-1]
    blocked[:-1] |= low[1:]
    blocked[:, 1:] |= low[:, :-1]
    blocked[:, :-1] |= low[:, 1:]
    r, c = np.nonzero((np.isfinite(ground_z) & ~blocked)[::2, ::2])
    return CoarseMap(x0, y0, ground_z, words, _by_parity(_dilated(words)), 2 * r, 2 * c, _spans_of(r, c))


def _spans_of(r: I64, c: I64) -> I64:
    """(m, 3) as :class:`CoarseMap` has them, of places in row ``r`` (n,) and column ``c`` (n,) of every second cell,
    row by row."""
    first = np.flatnonzero((np.diff(r, prepend=-1) != 0) | (np.diff(c // _SPAN, prepend=-1) != 0))
    return np.column_stack([r[first] + MARGIN, c[first] + MARGIN, first])


@dataclass(frozen=True, slots=True)
class Bound:
    """A circle in the map within which a place is searched for."""

    x: float
    y: float
    radius_m: float

    def holds(self, x: F64, y: F64) -> Bool:
        """(n,) whether places, map metres, lie within."""
        return np.asarray((x - self.x) ** 2 + (y - self.y) ** 2 <= self.radius_m**2)

    def holds_pose(self, T_map: F64) -> bool:
        """Whether a pose (4, 4) lies within."""
        return bool(self.holds(T_map[:1, 3], T_map[1:2, 3])[0])


def _within(lay: CoarseMap, bound: Bound, cell_m: float) -> CoarseMap:
    """The map with the places within ``bound`` alone."""
    x = lay.x0 + (lay.cols.astype(np.float64) + 0.5) * cell_m
    y = lay.y0 + (lay.rows.astype(np.float64) + 0.5) * cell_m
    inside = bound.holds(x, y)
    rows = lay.rows[inside]
    cols = lay.cols[inside]
    return replace(lay, rows=rows, cols=cols, spans=_spans_of(rows // 2, cols // 2))


def _by_parity(words: U32) -> U32:
    """``CoarseMap.wide`` of dilated words (rows, cols)."""
    rows, cols = words.shape
    wide = np.pad(words, ((0, rows % 2), (0, cols % 2)))
    split = wide.reshape(len(wide) // 2, 2, -1, 2).transpose(1, 3, 0, 2)
    return np.pad(split, ((0, 0), (0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN + _SPAN)))


def highest(scores: U8, most: int) -> I64:
    """Indices of the ``most`` highest of (n,), in descending order; of equal ones the last first."""
    counts = np.cumsum(np.bincount(scores, minlength=256)[::-1])
    least = 255 - int(np.searchsorted(counts, most))
    candidates = np.flatnonzero(scores >= max(least, 0))
    return candidates[np.argsort(scores[candidates], kind="stable")[::-1][:most]]


def _dilated(words: U32) -> U32:
    """Every column with those of its eight neighbours, and one layer up and down."""
    return widened(words | (words << np.uint32(1)) | (words >> np.uint32(1)), 1)


def correlate(wide: U32, spans: I64, cols: I64, xy: F64, bits: U32, yaws: F64, hopeless: int, first: int) -> U8:
    """(places, headings) how many of the points (n <= 255) match the map at their height there; 0 where hopeless.

    ``cols`` (places,) in ``wide``. Span by span, point by point: the words of the cells of a span lie side by side, so
    that all of them are looked up sooner than the places among them.
    """
    out = np.zeros((len(cols), len(yaws)), np.uint8)
    hits, early = np.empty((2, _SPAN), np.uint32)
    memory = np.empty(len(xy), np.int64), hits, early
    _correlate(wide.reshape(-1), wide.shape[2:], spans, cols, (xy, bits), yaws, (hopeless, first), *memory, out)
    return out


@kernel
def _correlate(
    flat: U32, shape: tuple[int, int], spans: I64, cols: I64, points: tuple[F64, U32], yaws: F64,
    least: tuple[int, int], way: I64, hits: U32, early: U32, out: U8,
) -> None:  # fmt: skip
    """:func:`correlate` into ``out``, zeros. ``flat``: ``wide``, each of whose four planes has ``shape``. ``least``: as
    many matches among so many points are hopeless. ``way`` (n,), ``hits`` and ``early`` (_SPAN,): memory."""
    rows, width = shape
    xy, bits = points
    hopeless, first = least
    n = len(xy)
    for a in range(len(yaws)):
        c = np.cos(yaws[a])
        s = np.sin(yaws[a])
        for i in range(n):
            dr = np.int64(np.floor(s * xy[i, 0] + c * xy[i, 1] + 0.5))
            dc = np.int64(np.floor(c * xy[i, 0] - s * xy[i, 1] + 0.5))
            way[i] = ((2 * (dr & 1) + (dc & 1)) * rows + (dr >> 1)) * width + (dc >> 1)
        for k in range(len(spans)):
            row = spans[k, 0]
            col = spans[k, 1]
            place = spans[k, 2]
            beyond = spans[k + 1, 2] if k + 1 < len(spans) else len(cols)
            for j in range(_SPAN):
                hits[j] = 0
            _look_up(flat, row * width + col, way, bits, 0, first, hits)
            hopeful = False
            for p in range(place, beyond):
                j = cols[p] - col
                early[j] = hits[j]
                hopeful |= hits[j] > hopeless
            if hopeful:
                _look_up(flat, row * width + col, way, bits, first, n, hits)
                for p in range(place, beyond):
                    j = cols[p] - col
                    out[p, a] = hits[j] if early[j] > hopeless else 0


@kernel
def _look_up(flat: U32, at: int, way: I64, bits: U32, begin: int, end: int, hits: U32) -> None:
    """Add to ``hits`` of each cell of the span that begins ``at`` how many points, shifted by ``way``, match."""
    for i in range(begin, end):
        start = np.uint64(at + way[i])
        bit = bits[i]
        for j in range(np.uint64(0), np.uint64(_SPAN)):
            hits[j] += (flat[start + j] >> bit) & np.uint32(1)


@kernel
def apart(x: F64, y: F64, yaw: F64, spread_m: float, spread_rad: float, chosen: I64) -> int:
    """Enter into ``chosen`` the indices of the first that lie apart from all chosen before, until it is full; returns
    how many there are."""
    n = 0
    for i in range(len(x)):
        fresh = True
        for k in range(n):
            j = chosen[k]
            turn = abs(np.arctan2(np.sin(yaw[i] - yaw[j]), np.cos(yaw[i] - yaw[j])))
            if (x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2 < spread_m**2 and turn < spread_rad:
                fresh = False
                break
        if fresh:
            chosen[n] = i
            n += 1
            if n == len(chosen):
                break
    return n


@kernel
def sharpened(words: U32, x: float, y: float, yaw: float, xy: F64, bits: U32) -> tuple[float, float, float, float]:
    """(share, x, y, yaw) of the best place and heading around one, on single cells; x and y in cells."""
    best = -1.0
    at = (x, y, yaw)
    height, width = words.shape
    for da in range(-3, 4):
        a = yaw + np.radians(0.75) * da
        c = np.cos(a)
        s = np.sin(a)
        for dx in range(-4, 5):
            for dy in range(-4, 5):
                px = x + 0.5 * dx
                py = y + 0.5 * dy
                hits = np.int64(0)
                for i in range(len(xy)):
                    r = np.int64(np.floor(py + s * xy[i, 0] + c * xy[i, 1]))
                    k = np.int64(np.floor(px + c * xy[i, 0] - s * xy[i, 1]))
                    if 0 <= r < height and 0 <= k < width:
                        column = words[r, k] | (words[r, k] << np.uint32(1)) | (words[r, k] >> np.uint32(1))
                        hits += np.int64((column >> bits[i]) & np.uint32(1))
                if hits > best:
                    best = float(hits)
                    at = (px, py, a)
    return best / len(xy), at[0], at[1], at[2]


@dataclass(frozen=True, slots=True)
class Found:
    """The best place in the map."""

    T_map_lidar: F64
    fit: float
    """The fit of :class:`mapvote.matching.pose_check.Verdict`."""
    lead: float
    """Difference of its fit from that of the best place elsewhere."""


class _Searched:
    """A map as the search reads it: each part is made when it is first needed."""

    def __init__(self, point_map: PointMap, numbers: GlobalSearchNumbers) -> None:
        self._map = point_map
        self._numbers = numbers

    @cached_property
    def has_ground(self) -> bool:
        return has_open_ground(self._map)

    @cached_property
    def points(self) -> F64:
        return all_points(self._map)

    @cached_property
    def layout(self) -> CoarseMap:
        return laid_out(self._map, self._numbers)


class GlobalSearch:
    """The search for scans in the whole of a map."""

    def __init__(
        self,
        point_map: PointMap,
        ndt: NdtSettings,
        range_sigma_m: float,
        numbers: GlobalSearchNumbers = GLOBAL_SEARCH,
        check: PoseCheck = POSE_CHECK,
    ) -> None:
        self.ndt = ndt
        self.numbers = numbers
        self.map_around = map_around(ndt.matcher, point_map)
        self._searched = _Searched(point_map, numbers)
        self.judge = Judge(range_sigma_m, check)

    def go_on_in(self, point_map: PointMap) -> None:
        """The map is another version from here on."""
        self.map_around.go_on_in(point_map)
        self._searched = _Searched(point_map, self.numbers)

    def __call__(self, scan: Scan, bound: Bound | None = None) -> F64 | None:
        """The pose (4, 4) of the scan, or None if no place holds or another fits as well. ``bound``: no other place is
        looked at.

        A map without ground has neither drivable squares nor heights above ground: there every shift and yaw of
        the scan is tried (matching/coarse_search.py), which takes some seconds for each square kilometre.
        """
        if not self._searched.has_ground:
            return self._without_ground(scan, bound)
        place = self.find(scan, bound)
        if place is None or place.fit < self.judge.check.min_fit or place.lead < self.judge.check.min_lead:
            return None
        return place.T_map_lidar if bound is None or bound.holds_pose(place.T_map_lidar) else None

    def _without_ground(self, scan: Scan, bound: Bound | None) -> F64 | None:
        """The place in a map without ground, by every shift and yaw of the scan."""
        points = self._searched.points
        if bound is not None:
            wide = replace(bound, radius_m=bound.radius_m + self.numbers.reach_m)
            points = points[wide.holds(points[:, 0], points[:, 1])]
            if len(points) < self.numbers.first:
                return None
        placed = place_without_prior(points, scan.points.astype(np.float64))
        if placed.lead < COARSE_SEARCH.min_lead or placed.score < self.numbers.min_score:
            return None
        return placed.T_a_b if bound is None or bound.holds_pose(placed.T_a_b) else None

    def find(self, scan: Scan, bound: Bound | None = None) -> Found | None:
        """The best place, however good it is; None if the scan has hardly a point above the ground, or the map no place
        like it."""
        numbers = self.numbers
        # Points above the ground near the sensor, and their layers.
        few = solid_sample(scan.points, 1.0)
        height = height_above_lowest(few)
        near = few[:, 0] ** 2 + few[:, 1] ** 2 < numbers.reach_m**2
        used = near & (height > numbers.low_m) & (height < numbers.high_m)
        sample = few[used]
        if len(sample) < numbers.first:
            return None
        bits = np.floor(height[used] / numbers.layer_m).astype(np.uint32)
        order = np.random.default_rng(0).permutation(len(sample))[: numbers.points]  # the same each time
        xy = sample[order, :2]
        bits = bits[order]
        # The sensor's height over the ground, and the poses of the best peaks.
        below = few[few[:, 0] ** 2 + few[:, 1] ** 2 < 36.0, 2]
        sensor_m = -float(np.quantile(below, 0.05)) if len(below) else 1.8
        lay = self._searched.layout
        lay = lay if bound is None else _within(lay, bound, numbers.cell_m)
        if not len(lay.cols):
            return None
        best = sorted(self._peaks(lay, xy, bits), key=lambda peak: -peak[0])[: numbers.refined]
        return self._choose(scan, [self._pose(peak, sensor_m) for peak in best])

    def _peaks(self, lay: CoarseMap, xy: F64, bits: U32) -> list[tuple[float, float, float, float]]:
        """(share, x, y, yaw) of the best places, sharpened on single cells."""
        numbers = self.numbers
        yaws: F64 = np.arange(numbers.yaws, dtype=np.float64) * (2.0 * np.pi / numbers.yaws)
        check = self.judge.check
        hopeless = int(0.5 * check.min_fit * check.min_known * numbers.first)
        scores = correlate(lay.wide, lay.spans, lay.cols // 2 + MARGIN, xy, bits, yaws, hopeless, numbers.first)
        likely = highest(scores.ravel(), 400 * numbers.peaks)
        place = likely // numbers.yaws
        heading = likely % numbers.yaws
        x = lay.cols[place] + 0.5
        y = lay.rows[place] + 0.5
        chosen = np.empty(numbers.peaks, np.int64)
        places = x * numbers.cell_m, y * numbers.cell_m, yaws[heading]
        n = apart(*places, numbers.spread_m, numbers.spread_rad, chosen)
        return [sharpened(lay.words, x[k], y[k], yaws[heading[k]], xy, bits) for k in chosen[:n]]

    def _pose(self, peak: tuple[float, float, float, float], sensor_m: float) -> F64:
        """(4, 4) on the map's ground at a peak, level with it."""
        lay, (_, x, y, yaw) = self._searched.layout, peak
        cell_m = self.numbers.cell_m
        row = int(y)
        col = int(x)
        low_r = max(row - 5, 0)
        low_c = max(col - 5, 0)
        patch = lay.ground_z[low_r : row + 6, low_c : col + 6]
        r, c = np.nonzero(np.isfinite(patch))
        A = np.column_stack([c + low_c + 0.5 - x, r + low_r + 0.5 - y, np.ones(len(r))])
        (gx, gy, z), *_ = np.linalg.lstsq(A, patch[r, c], rcond=None)
        up = np.array([-gx, -gy, 1.0]) / np.sqrt(gx * gx + gy * gy + 1.0)
        ahead = np.array([np.cos(yaw), np.sin(yaw), gx * np.cos(yaw) + gy * np.sin(yaw)])
        ahead /= np.linalg.norm(ahead)
        T = np.eye(4)
        T[:3, 0] = ahead
        T[:3, 1] = np.cross(up, ahead)
        T[:3, 2] = up
        T[:3, 3] = np.array([lay.x0 + x * cell_m, lay.y0 + y * cell_m, z]) + sensor_m * up
        return T

    def _choose(self, scan: Scan, guesses: list[F64]) -> Found | None:
        """Refine all, judge the best few with the motion that suits them, and compare."""
        guesses.sort(key=lambda T: (round(T[0, 3] / 40.0), round(T[1, 3] / 40.0)))  # neighbours share a window
        clouds = thin_for_levels(scan.points)
        clouds = [np.ascontiguousarray(cloud[:, :: max(1, cloud.shape[1] // 2000)]) for cloud in clouds]
        refined = [self.map_around(guess[:3, 3]).refine(clouds, guess) for guess in guesses]
        refined.sort(key=lambda result: -result.score)
        places = distinct((one.T_map_lidar for one in refined), self.numbers.spread_rad)[: self.numbers.judged]
        if not places:
            return None
        fit, T, rival = best_and_rival([self._judged(scan, T) for T in places], self.numbers.spread_rad)
        return Found(T, fit, fit - rival)

    def _judged(self, scan: Scan, T: F64) -> tuple[float, F64]:
        around = self.map_around(T[:3, 3])
        points = scan.points
        if scan.time_s is not None:
            tracker = Tracker(self.map_around, self.ndt)
            points = deskew(scan, tracker.guess_motion(around, scan.stamp_ns, Sample(scan), T))
        T = around.refine(thin_for_levels(points), T).T_map_lidar
        few = solid_sample(points, LEVELS[-1].points_m)
        return self.judge.fit(around, few, T), T
