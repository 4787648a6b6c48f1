"""Where does one cloud lie in another? A search without a prior, over every shift and every yaw.

Both clouds are level (z up); nothing else is required: neither ground, nor a path, nor a common height. Each is
drawn from above in cells of a metre, by what stands there: the logarithm of how many layers of half a metre are
occupied. The drawings are correlated by the fast Fourier transform, yaw by yaw. Heights follow from the cells that
meet. Candidates are ranked by the likelihood of NDT (Magnusson 2009) and refined by it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.spatial import KDTree

from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.types import F32, F64, I64, Bool, MapvoteError
from mapvote.core.voxels import first_of_each, voxel_downsample, voxel_keys
from mapvote.matching.matcher import likelihood_at
from mapvote.matching.ndt_map import NdtMap, build_ndt
from mapvote.matching.prepare import thin_for_levels

_CELL_M, _LAYER_M = 1.0, 0.5
_YAWS = 240
"""Steps of 1.5 deg: 80 m from the middle they are 2 m apart, which the correlation's neighbours and NDT bridge."""
_LOW_LAYERS = 2
"""Fewer layers in a cell are ground, kerbs and hedges' tops: nothing that stands."""
_PEAKS, _REFINED = 40, 8
_SPREAD_CELLS, _SPREAD_RAD = 3, float(np.radians(5.0))
_MOST_CELLS = 64_000_000
_SAMPLE = 4000
_DZ_M = 0.25
_HEIGHTS = (0.0, -1.5, 1.5)
"""Besides the likeliest difference in height these are tried: walls alone give it to a metre or two."""
LEAST_LEAD = 0.1
"""A place whose score is not ahead of every other by such a share of it is ambiguous."""
_NEAR_M = 0.5
"""Standing points of two clouds that lie so near may be of one surface."""
_STANDS_M = 0.5
_SAME_M = 1.5
_WINDOW_M = 90.0
"""How far from the middle of what overlaps points are compared, metres."""


@dataclass(frozen=True, slots=True)
class Placed:
    """Where a cloud lies in another one."""

    T_a_b: F64
    score: float
    """Mean NDT likelihood of the points that overlap, in [0, 1]."""
    lead: float
    """By how much of its own score it is ahead of the best place elsewhere, in [0, 1]."""


def place_without_prior(points_a: F64, points_b: F64) -> Placed:
    """The rigid motion that takes points_b (m, 3) to points_a (n, 3), both metres with z up.

    MapvoteError if one of them shows nothing that stands.
    """
    # Each about its own middle: the coordinates of a country reach beyond what a key of a voxel holds.
    middle_a, middle_b = (np.floor(np.median(points, axis=0)) for points in (points_a, points_b))
    points_a, local = points_a - middle_a, points_b - middle_b
    (cells_a, weight_a), (cells_b, weight_b) = _weights(points_a), _weights(local)
    if not len(cells_a) or not len(cells_b):
        raise MapvoteError("nothing stands in one of the clouds: two planes of ground cannot be registered")
    tall = np.column_stack([(cells_b + 0.5) * _CELL_M, weight_b])
    sample = local[np.random.default_rng(0).permutation(len(local))[: 5 * _SAMPLE]]
    height_over = _heights(points_a)
    guesses = [
        from_xyz_rpy(x, y, height_over(transform(from_xyz_rpy(x, y, 0.0, yaw=yaw), sample)) + dz, yaw=yaw)
        for x, y, yaw in _correlate(cells_a, weight_a, tall)
        for dz in _HEIGHTS
    ]
    windows = _Windows(points_a, local[voxel_downsample(local, 0.5)])
    share, T, rival = best_and_rival(_refined(windows, guesses, _Standing.of(points_a, local)), _SPREAD_RAD)
    T_a_b = from_xyz_rpy(*middle_a) @ T @ from_xyz_rpy(*(-middle_b))
    return Placed(T_a_b, windows.score(T, -1), 1.0 - rival / share if share > 0 else 0.0)


def _weights(points: F64) -> tuple[I64, F64]:
    """((k, 2) cells x, y of _CELL_M in which something stands; (k,) logarithm of their occupied layers)."""
    keys = voxel_keys(points * [1.0, 1.0, _CELL_M / _LAYER_M], 0.0, 0.0, _CELL_M)
    columns, layers = np.unique(keys[first_of_each(keys)] >> 21, return_counts=True)
    tall = layers > _LOW_LAYERS
    columns, layers = columns[tall], layers[tall]
    cells = np.column_stack([(columns >> 21) - (1 << 20), (columns & ((1 << 21) - 1)) - (1 << 20)])
    return cells, np.log2(layers.astype(np.float64))


def _correlate(cells: I64, weight: F64, tall: F64) -> list[tuple[float, float, float]]:
    """(x, y, yaw) of the best places of the origin of ``tall`` (m, 3), cells' x, y and weight, in the drawing of
    ``cells`` (k, 2) and their ``weight`` (k,): apart from each other, best first.

    The score is normalised by what the drawing has under the cells of ``tall``, so that a dense wood wins nothing.
    """
    low = cells.min(axis=0)
    cols, rows = cells.max(axis=0) - low + 1
    if rows * cols > _MOST_CELLS:
        raise MapvoteError(f"a cloud of {cols} m by {rows} m is too large to search without a prior; cut it first")
    drawn = np.zeros((rows, cols))
    drawn[cells[:, 1] - low[1], cells[:, 0] - low[0]] = weight
    reach = int(np.ceil(np.hypot(tall[:, 0], tall[:, 1]).max() / _CELL_M)) + 1
    shape = [fft.next_fast_len(side + 2 * reach, real=True) for side in drawn.shape]
    spectrum = fft.rfft2(drawn, shape)
    energy = fft.rfft2(drawn**2, shape)
    found: list[tuple[float, float, float, float]] = []
    for yaw in np.arange(_YAWS) * (2.0 * np.pi / _YAWS):
        c, s = np.cos(yaw), np.sin(yaw)
        col = np.floor((c * tall[:, 0] - s * tall[:, 1]) / _CELL_M).astype(np.int64)
        row = np.floor((s * tall[:, 0] + c * tall[:, 1]) / _CELL_M).astype(np.int64)
        image, mask = np.zeros(shape), np.zeros(shape)
        np.maximum.at(image, (row, col), tall[:, 2])
        mask[row, col] = 1.0
        met = fft.irfft2(spectrum * np.conj(fft.rfft2(image, shape)), shape)
        under = fft.irfft2(energy * np.conj(fft.rfft2(mask, shape)), shape)
        score = met / np.sqrt(np.maximum(under, 0.05 * (image**2).sum()) * (image**2).sum())
        for k in np.argpartition(score.ravel(), -5)[-5:]:
            r, q = np.unravel_index(k, shape)
            shift = [int(i) - side if i >= side - reach else int(i) for i, side in zip((r, q), shape, strict=True)]
            found.append((float(score[r, q]), float(shift[1]), float(shift[0]), float(yaw)))
    found.sort(reverse=True)
    kept: list[tuple[float, float, float]] = []
    for _, col, row, yaw in found:
        x, y = low[0] * _CELL_M + col * _CELL_M, low[1] * _CELL_M + row * _CELL_M
        apart = [
            np.hypot(x - u, y - v) > _SPREAD_CELLS * _CELL_M or np.cos(yaw - w) < np.cos(np.radians(4.0))
            for u, v, w in kept
        ]
        if all(apart):
            kept.append((x, y, yaw))
        if len(kept) == _PEAKS:
            break
    return kept


def _heights(cloud: F64) -> Callable[[F64], float]:
    """The likeliest height of a cloud over points (m, 3) in the same cells; 0 where no cell is shared."""
    of_point = voxel_keys(cloud, 0.0, 0.0, _CELL_M) >> 21
    order = np.argsort(of_point, kind="stable")
    keys, first = np.unique(of_point[order], return_index=True)
    start, heights = np.append(first, len(of_point)), cloud[order, 2]

    def height_over(points: F64) -> float:
        wanted = voxel_keys(points, 0.0, 0.0, _CELL_M) >> 21
        at = np.searchsorted(keys, wanted)
        at[at == len(keys)] = 0
        shared = keys[at] == wanted
        at, z = at[shared], points[shared, 2]
        if not len(at):
            return 0.0
        share = np.random.default_rng(0).random((8, len(at)))
        other = heights[(start[at] + share * (start[at + 1] - start[at])).astype(np.int64)]
        between = np.floor((other - z).ravel() / _DZ_M).astype(np.int64)
        low = int(between.min())
        counts = np.convolve(np.bincount(between - low), np.ones(3), mode="same")
        return float((np.argmax(counts) + low + 0.5) * _DZ_M)

    return height_over


def _refined(windows: _Windows, guesses: list[F64], standing: _Standing) -> list[tuple[float, F64]]:
    """(how near they lie, pose) of the likeliest guesses, refined by NDT. All points move the cloud; what stands ranks
    the places, for the ground of one place is like that of any other."""
    ranked = sorted(((windows.score(T, 0), T) for T in guesses), key=lambda one: -one[0])
    out: list[tuple[float, F64]] = []
    for T in distinct((T for _, T in ranked), _SPREAD_RAD, 1.0)[:_REFINED]:
        ndt_map, clouds = windows.around(T)
        found = ndt_map.refine(clouds, T).T_map_lidar
        out.append((standing.nearness(found), found))
    return out


def stands(points: F64) -> Bool:
    """(n,) which points (n, 3) lie higher than _STANDS_M above the lowest one of their square metre."""
    _, cell = np.unique(np.floor(points[:, :2]).astype(np.int64), axis=0, return_inverse=True)
    lowest = np.full(len(points), np.inf)
    np.minimum.at(lowest, cell.reshape(-1), points[:, 2])
    return np.asarray(points[:, 2] > lowest[cell.reshape(-1)] + _STANDS_M)


@dataclass(frozen=True, slots=True)
class _Standing:
    """What stands in two clouds. Distances between its points tell a place from one like it better than distributions
    of a metre do, which also know the ground at the feet of walls."""

    a: KDTree
    b: F64
    """(m, 3)."""

    @classmethod
    def of(cls, points_a: F64, points_b: F64) -> _Standing:
        a, b = (points[voxel_downsample(points, _NEAR_M)] for points in (points_a, points_b))
        b = b[stands(b)]
        return cls(KDTree(a[stands(a)]), b[np.random.default_rng(0).permutation(len(b))[: 5 * _SAMPLE]])

    def nearness(self, T_a_b: F64) -> float:
        """Mean over b's points of 1 - (distance / _NEAR_M)^2 to the nearest one of a, 0 beyond _NEAR_M."""
        if not len(self.b) or not self.a.n:
            return 0.0
        distance = self.a.query(transform(T_a_b, self.b), distance_upper_bound=_NEAR_M)[0]
        return float(np.where(np.isfinite(distance), 1.0 - (distance / _NEAR_M) ** 2, 0.0).mean())


class _Windows:
    """NDT of a around the pose of b, made once for each 20 m, and the part of b inside it."""

    def __init__(self, points_a: F64, local: F64) -> None:
        self._a, self._b = points_a, local
        tall, _ = _weights(local)
        cells = np.floor(local[:, :2] / _CELL_M).astype(np.int64)
        self._stands = np.isin(cells @ [1 << 32, 1], tall @ [1 << 32, 1])
        self._ndt: dict[tuple[int, int], NdtMap] = {}

    def around(self, T: F64, standing: bool = False) -> tuple[NdtMap, list[F32]]:
        """(NDT of a, b's points in its window as its levels want them): all, or only what stands."""
        key = int(np.floor(T[0, 3] / 20.0)), int(np.floor(T[1, 3] / 20.0))
        if key not in self._ndt:
            at = 20.0 * (np.array(key) + 0.5)
            near = self._a[(np.abs(self._a[:, :2] - at) < _WINDOW_M).all(axis=1)]
            self._ndt[key] = build_ndt(near, np.array([*at, float(np.median(near[:, 2])) if len(near) else 0.0]))
        ndt_map, there = self._ndt[key], transform(T, self._b)
        inside = (np.abs(there[:, :2] - ndt_map.centre[:2]) < _WINDOW_M - 2.0).all(axis=1)
        return ndt_map, thin_for_levels(self._b[inside & self._stands if standing else inside])

    def score(self, T: F64, level: int) -> float:
        """Mean likelihood of all that stands in b at one level; what lies outside the window has none."""
        ndt_map, clouds = self.around(T, standing=True)
        if clouds[level].shape[1] == 0:
            return 0.0
        inside = (np.abs(transform(T, self._b[self._stands])[:, :2] - ndt_map.centre[:2]) < _WINDOW_M - 2.0).all(axis=1)
        return float(inside.mean()) * likelihood_at(ndt_map, clouds, T, level % len(ndt_map.levels))


def distinct(poses: Iterable[F64], turn_rad: float, height_m: float = np.inf) -> list[F64]:
    """The poses (4, 4) without those that are at the place of one before, see :func:`_same`."""
    out: list[F64] = []
    for T in poses:
        if not any(_same(T, S, turn_rad) and abs(T[2, 3] - S[2, 3]) < height_m for S in out):
            out.append(T)
    return out


def best_and_rival(scored: list[tuple[float, F64]], turn_rad: float) -> tuple[float, F64, float]:
    """(score, pose, the best score elsewhere, 0 if there is none) of the best of some poses (4, 4)."""
    ranked = sorted(scored, key=lambda one: -one[0])
    score, T = ranked[0]
    return score, T, max((other for other, S in ranked[1:] if not _same(S, T, turn_rad)), default=0.0)


def _same(T: F64, S: F64, turn_rad: float) -> bool:
    """Whether two poses are nearer than 1.5 m in the plane and ``turn_rad``."""
    between = inverse(T) @ S
    return bool(np.linalg.norm(between[:2, 3]) < _SAME_M and between[0, 0] > np.cos(turn_rad))
