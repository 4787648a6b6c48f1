"""The place of one cloud in another: a search without a prior, over every shift and every yaw.

Both clouds are level (z up); nothing else is required: neither ground, nor a path, nor a common height. Each is
drawn from above in cells of a metre: the logarithm of the number of occupied layers of half a metre. The drawings are
correlated by the fast Fourier transform, yaw by yaw. Heights follow from the cells that meet. Candidates are ranked by
the likelihood of NDT (Magnusson 2009) and refined by it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import scipy

from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.record import record
from mapvote.core.types import F64, I64, Bool, MapvoteError
from mapvote.core.voxels import first_of_each, voxel_downsample, voxel_keys
from mapvote.matching.matcher import likelihood_at
from mapvote.matching.ndt_map import NdtMap, build_ndt
from mapvote.matching.prepare import thin_for_levels


@record()
@dataclass(frozen=True, slots=True)
class CoarseSearch:
    """Numbers of the search without a prior."""

    cell_m: float = 1.0
    """Side of a cell of the drawings."""
    layer_m: float = 0.5
    """Height of a layer."""
    yaws: int = 240
    """Headings tried, 1.5 deg apart: 80 m from the middle they are 2 m apart, which neighbours and NDT bridge."""
    low_layers: int = 2
    """Layers up to which a cell shows ground, kerbs and tops of hedges."""
    peaks: int = 40
    """Places of the correlation that are ranked by NDT."""
    refined: int = 8
    """Ranked places that are refined."""
    spread_cells: int = 3
    """Cells within which two peaks are one."""
    spread_rad: float = float(np.radians(5.0))
    """Turn within which two poses are one place."""
    most_cells: int = 64_000_000
    """Cells of the largest drawing."""
    sample: int = 20_000
    """Points of the cloud that are compared with the other one's heights and surfaces."""
    dz_m: float = 0.25
    """Height of a bin of height differences."""
    heights_m: tuple[float, ...] = (0.0, -1.5, 1.5)
    """Offsets tried from the likeliest difference in height: walls alone give it to a metre or two."""
    min_lead: float = 0.1
    """Share of its score by which a place must be ahead of every other: below it the place is ambiguous."""
    near_m: float = 0.5
    """Distance within which points of two clouds may be of one surface."""
    stands_m: float = 0.5
    """Height above the lowest point of its square metre from which a point stands."""
    same_m: float = 1.5
    """Distance in the plane within which two poses are one place."""
    window_m: float = 90.0
    """Distance from the middle of the overlap within which points are compared."""


COARSE_SEARCH = CoarseSearch()


@dataclass(frozen=True, slots=True)
class Placed:
    """Where a cloud lies in another one."""

    T_a_b: F64
    score: float
    """Mean NDT likelihood of the points that overlap, in [0, 1]."""
    lead: float
    """Share of its score by which it is ahead of the best place elsewhere, in [0, 1]."""


def place_without_prior(points_a: F64, points_b: F64, numbers: CoarseSearch = COARSE_SEARCH) -> Placed:
    """The rigid motion that takes points_b (m, 3) to points_a (n, 3), both metres with z up.

    MapvoteError if one of them has no points above its ground.
    """
    # Each cloud about its own middle: the coordinates of a country reach beyond what a key of a voxel holds.
    middle_a, middle_b = (np.floor(np.median(points, axis=0)) for points in (points_a, points_b))
    points_a = points_a - middle_a
    local = points_b - middle_b
    (cells_a, weight_a), (cells_b, weight_b) = _weights(points_a, numbers), _weights(local, numbers)
    if not len(cells_a) or not len(cells_b):
        raise MapvoteError("one of the clouds holds nothing but ground: two planes cannot be registered")
    tall = np.column_stack([(cells_b + 0.5) * numbers.cell_m, weight_b])
    sample = local[np.random.default_rng(0).permutation(len(local))[: numbers.sample]]
    height_over = _heights(points_a, numbers)
    # Places by correlation, each at some heights.
    guesses = [
        from_xyz_rpy(x, y, height_over(transform(from_xyz_rpy(x, y, 0.0, yaw=yaw), sample)) + dz, yaw=yaw)
        for x, y, yaw in _correlate(cells_a, weight_a, tall, numbers)
        for dz in numbers.heights_m
    ]
    # Their refinement by NDT; the best one and its rival elsewhere.
    windows = _Windows(points_a, local[voxel_downsample(local, 0.5)], numbers)
    refined = _refined(windows, guesses, _Standing.of(points_a, local, numbers), numbers)
    share, T, rival = best_and_rival(refined, numbers.spread_rad, numbers)
    T_a_b = from_xyz_rpy(*middle_a) @ T @ from_xyz_rpy(*(-middle_b))
    return Placed(T_a_b, windows.score(T, -1), 1.0 - rival / share if share > 0 else 0.0)


def _weights(points: F64, numbers: CoarseSearch) -> tuple[I64, F64]:
    """((k, 2) cells x, y with points above the ground; (k,) logarithm of their occupied layers)."""
    cell_m = numbers.cell_m
    keys = voxel_keys(points * [1.0, 1.0, cell_m / numbers.layer_m], 0.0, 0.0, cell_m)
    columns, layers = np.unique(keys[first_of_each(keys)] >> 21, return_counts=True)
    tall = layers > numbers.low_layers
    columns = columns[tall]
    layers = layers[tall]
    cells = np.column_stack([(columns >> 21) - (1 << 20), (columns & ((1 << 21) - 1)) - (1 << 20)])
    return cells, np.log2(layers.astype(np.float64))


def _correlate(cells: I64, weight: F64, tall: F64, numbers: CoarseSearch) -> list[tuple[float, float, float]]:
    """(x, y, yaw) of the best places of the origin of ``tall`` (m, 3), cells' x, y and weight, in the drawing of
    ``cells`` (k, 2) and their ``weight`` (k,): apart from each other, best first.

    The score is normalised by the drawing's weights under the cells of ``tall``, so that a dense wood gains nothing.
    """
    cell_m = numbers.cell_m
    # The spectra of the drawing and of its squares.
    low = cells.min(axis=0)
    cols, rows = cells.max(axis=0) - low + 1
    if rows * cols > numbers.most_cells:
        raise MapvoteError(f"a cloud of {cols} m by {rows} m is too large to search without a prior; cut it first")
    drawn = np.zeros((rows, cols), np.float32)  # scores to seven digits: half of the time of float64
    drawn[cells[:, 1] - low[1], cells[:, 0] - low[0]] = weight
    reach = int(np.ceil(np.hypot(tall[:, 0], tall[:, 1]).max() / cell_m)) + 1
    shape = [scipy.fft.next_fast_len(side + 2 * reach, real=True) for side in drawn.shape]
    spectrum = scipy.fft.rfft2(drawn, shape)
    energy = scipy.fft.rfft2(drawn**2, shape)
    image, mask = np.zeros((2, *shape), np.float32)
    # The best places of each heading.
    ranked: list[tuple[float, float, float, float]] = []
    for yaw in np.arange(numbers.yaws) * (2.0 * np.pi / numbers.yaws):
        c = np.cos(yaw)
        s = np.sin(yaw)
        col = np.floor((c * tall[:, 0] - s * tall[:, 1]) / cell_m).astype(np.int64)
        row = np.floor((s * tall[:, 0] + c * tall[:, 1]) / cell_m).astype(np.int64)
        image.fill(0.0)
        mask.fill(0.0)
        np.maximum.at(image, (row, col), tall[:, 2])
        mask[row, col] = 1.0
        own = float((image**2).sum())
        met = scipy.fft.irfft2(spectrum * scipy.fft.rfft2(image).conj(), shape, overwrite_x=True)
        under = scipy.fft.irfft2(energy * scipy.fft.rfft2(mask).conj(), shape, overwrite_x=True)
        score = met / np.sqrt(np.maximum(under, 0.05 * own) * own)
        for k in np.argpartition(score.ravel(), -5)[-5:]:
            r, q = np.unravel_index(k, shape)
            shift = [int(i) - side if i >= side - reach else int(i) for i, side in zip((r, q), shape, strict=True)]
            ranked.append((float(score[r, q]), float(shift[1]), float(shift[0]), float(yaw)))
    # The best of all that lie apart.
    ranked.sort(reverse=True)
    kept: list[tuple[float, float, float]] = []
    for _, col, row, yaw in ranked:
        x = low[0] * cell_m + col * cell_m
        y = low[1] * cell_m + row * cell_m
        apart = [
            np.hypot(x - u, y - v) > numbers.spread_cells * cell_m or np.cos(yaw - w) < np.cos(np.radians(4.0))
            for u, v, w in kept
        ]
        if all(apart):
            kept.append((x, y, yaw))
        if len(kept) == numbers.peaks:
            break
    return kept


def _heights(cloud: F64, numbers: CoarseSearch) -> Callable[[F64], float]:
    """The likeliest height of a cloud over points (m, 3) in the same cells; 0 where no cell is shared."""
    of_point = voxel_keys(cloud, 0.0, 0.0, numbers.cell_m) >> 21
    order = np.argsort(of_point, kind="stable")
    keys, first = np.unique(of_point[order], return_index=True)
    start = np.append(first, len(of_point))
    heights = cloud[order, 2]

    def height_over(points: F64) -> float:
        wanted = voxel_keys(points, 0.0, 0.0, numbers.cell_m) >> 21
        at = np.searchsorted(keys, wanted)
        at[at == len(keys)] = 0
        shared = keys[at] == wanted
        at = at[shared]
        z = points[shared, 2]
        if not len(at):
            return 0.0
        share = np.random.default_rng(0).random((8, len(at)))
        other = heights[(start[at] + share * (start[at + 1] - start[at])).astype(np.int64)]
        between = np.floor((other - z).ravel() / numbers.dz_m).astype(np.int64)
        low = int(between.min())
        counts = np.convolve(np.bincount(between - low), np.ones(3), mode="same")
        return float((np.argmax(counts) + low + 0.5) * numbers.dz_m)

    return height_over


def _refined(
    windows: _Windows, guesses: list[F64], standing: _Standing, numbers: CoarseSearch
) -> list[tuple[float, F64]]:
    """(nearness, pose) of the likeliest guesses, refined by NDT. All points move the cloud; only points above the
    ground rank the places, because the ground of one place is like that of any other."""
    ranked = sorted(((windows.score(T, 0), T) for T in guesses), key=lambda one: -one[0])
    out: list[tuple[float, F64]] = []
    for T in distinct((T for _, T in ranked), numbers.spread_rad, 1.0, numbers)[: numbers.refined]:
        T_refined = windows.refined(T)
        out.append((standing.nearness(T_refined), T_refined))
    return out


def stands(points: F64, numbers: CoarseSearch = COARSE_SEARCH) -> Bool:
    """(n,) which points (n, 3) lie higher than ``stands_m`` above the lowest one of their square metre."""
    _, cell = np.unique(np.floor(points[:, :2]).astype(np.int64), axis=0, return_inverse=True)
    lowest = np.full(len(points), np.inf)
    np.minimum.at(lowest, cell.reshape(-1), points[:, 2])
    return np.asarray(points[:, 2] > lowest[cell.reshape(-1)] + numbers.stands_m)


@dataclass(frozen=True, slots=True)
class _Standing:
    """Points of two clouds above their ground. Their distances tell a place from one like it better than distributions
    of a metre do, which also hold the ground at the feet of walls."""

    a: scipy.spatial.KDTree
    b: F64
    """(m, 3)."""
    near_m: float

    @classmethod
    def of(cls, points_a: F64, points_b: F64, numbers: CoarseSearch) -> _Standing:
        a, b = (points[voxel_downsample(points, numbers.near_m)] for points in (points_a, points_b))
        b = b[stands(b, numbers)]
        sample = b[np.random.default_rng(0).permutation(len(b))[: numbers.sample]]
        return cls(scipy.spatial.KDTree(a[stands(a, numbers)]), sample, numbers.near_m)

    def nearness(self, T_a_b: F64) -> float:
        """Mean over b's points of 1 - (distance / near_m)^2 to the nearest one of a, 0 beyond ``near_m``."""
        if not len(self.b) or not self.a.n:
            return 0.0
        distance = self.a.query(transform(T_a_b, self.b), distance_upper_bound=self.near_m)[0]
        return float(np.where(np.isfinite(distance), 1.0 - (distance / self.near_m) ** 2, 0.0).mean())


class _Windows:
    """NDT of a around the pose of b, made once for each 20 m, and the part of b inside it."""

    def __init__(self, points_a: F64, local: F64, numbers: CoarseSearch) -> None:
        self._a = points_a
        self._b = local
        self._window_m = numbers.window_m
        tall, _ = _weights(local, numbers)
        cells = np.floor(local[:, :2] / numbers.cell_m).astype(np.int64)
        self._standing = thin_for_levels(local[np.isin(cells @ [1 << 32, 1], tall @ [1 << 32, 1])])
        """b's points above the ground, (3, m) for each level."""
        self._ndt: dict[tuple[int, int], NdtMap] = {}

    def _around(self, T: F64) -> NdtMap:
        """The NDT of a around b."""
        key = int(np.floor(T[0, 3] / 20.0)), int(np.floor(T[1, 3] / 20.0))
        if key not in self._ndt:
            at = 20.0 * (np.array(key) + 0.5)
            near = self._a[(np.abs(self._a[:, :2] - at) < self._window_m).all(axis=1)]
            self._ndt[key] = build_ndt(near, np.array([*at, float(np.median(near[:, 2])) if len(near) else 0.0]))
        return self._ndt[key]

    def _is_inside(self, there: F64, ndt_map: NdtMap) -> Bool:
        """(n,) whether points (n, 3) of the frame of a lie in the window."""
        away_m = np.abs(there[:, :2] - ndt_map.centre[:2])
        return np.asarray((away_m < self._window_m - 2.0).all(axis=1))

    def refined(self, T: F64) -> F64:
        """The pose refined by all of b's points in the window."""
        ndt_map = self._around(T)
        inside = self._is_inside(transform(T, self._b), ndt_map)
        return ndt_map.refine(thin_for_levels(self._b[inside]), T).T_map_lidar

    def score(self, T: F64, level: int) -> float:
        """Mean likelihood of b's points above the ground at one level; points outside the window have none."""
        ndt_map = self._around(T)
        cloud = self._standing[level]
        inside = self._is_inside(transform(T, cloud.T), ndt_map)
        if not inside.any():
            return 0.0
        return float(inside.mean()) * likelihood_at(ndt_map, cloud.compress(inside, axis=1), T, level)


def distinct(
    poses: Iterable[F64], turn_rad: float, height_m: float = np.inf, numbers: CoarseSearch = COARSE_SEARCH
) -> list[F64]:
    """The poses (4, 4) without those that are at the place of one before, see :func:`_same`."""
    out: list[F64] = []
    for T in poses:
        if not any(_same(T, S, turn_rad, numbers) and abs(T[2, 3] - S[2, 3]) < height_m for S in out):
            out.append(T)
    return out


def best_and_rival(
    scored: list[tuple[float, F64]], turn_rad: float, numbers: CoarseSearch = COARSE_SEARCH
) -> tuple[float, F64, float]:
    """(score, pose, the best score elsewhere, 0 if there is none) of the best of some poses (4, 4)."""
    ranked = sorted(scored, key=lambda one: -one[0])
    score, T = ranked[0]
    return score, T, max((other for other, S in ranked[1:] if not _same(S, T, turn_rad, numbers)), default=0.0)


def _same(T: F64, S: F64, turn_rad: float, numbers: CoarseSearch) -> bool:
    """Whether two poses are nearer than 1.5 m in the plane and ``turn_rad``."""
    between = inverse(T) @ S
    return bool(np.linalg.norm(between[:2, 3]) < numbers.same_m and between[0, 0] > np.cos(turn_rad))
