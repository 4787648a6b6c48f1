"""Yardstick after Kim et al. [15]: an evidence-theory voxel map per vehicle, combined on the server.

Every 0.3 m voxel carries Dempster-Shafer masses (occupied, free, unknown). A scan gives evidence along its rays, a
vehicle combines its scans, the server its vehicles and then the map; conflict with the map is change. Kim et al.
cluster features by similarity and have no released code: this keeps their evidence, not their clustering.
Masses: a ray that ends in a voxel supports "occupied" by 0.7, one that passes it "free" by 0.3; at least 0.01 stays
unknown, so that the present can outvote the past.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.core.grid import CELL_SIZE
from mapvote.core.kernel import kernel
from mapvote.core.types import F32, F64, I32, NO_VOTE, U8, U16, U64, Bool, CellState, Reference

LAYERS = 64
"""Voxels of a column, as in the map's column words: 19.2 m above the road."""
HIT_MASS = 0.7
PASS_MASS = 0.3
LEAST_UNKNOWN = 0.01
MAP_MASS = 0.9
_UNCHANGED_OCCUPIED, _UNCHANGED_EMPTY, _CHANGED_OCCUPIED, _CHANGED_EMPTY, _UNDETERMINED = (int(s) for s in CellState)
CONFLICT = 0.5
"""Change where the mass of "map and vehicles contradict each other" exceeds this."""


@kernel
def _march(
    points: F64, origin: F64, hits_count: Bool, base: I32, x0: float, y0: float, reach: float,
    hits: U16, passes: U16, touched: I32,
) -> int:  # fmt: skip
    """Count hits and passes per voxel along all rays (Amanatides and Woo 1987). Returns how many were touched."""
    rows, cols = base.shape
    n_touched = 0
    for i in range(len(points)):
        dx, dy, dz = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length < CELL_SIZE:
            continue
        dx, dy, dz = dx / length, dy / length, dz / length
        c, r, z = (
            int(np.floor((origin[0] - x0) / CELL_SIZE)),
            int(np.floor((origin[1] - y0) / CELL_SIZE)),
            int(np.floor(origin[2] / CELL_SIZE)),
        )
        ec, er, ez = (
            int(np.floor((points[i, 0] - x0) / CELL_SIZE)),
            int(np.floor((points[i, 1] - y0) / CELL_SIZE)),
            int(np.floor(points[i, 2] / CELL_SIZE)),
        )
        sc, sr, sz = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
        wc, wr, wz = (
            CELL_SIZE / max(abs(dx), 1e-12),
            CELL_SIZE / max(abs(dy), 1e-12),
            CELL_SIZE / max(abs(dz), 1e-12),
        )
        tc = ((c + (sc > 0)) * CELL_SIZE + x0 - origin[0]) * sc / max(abs(dx), 1e-12)
        tr = ((r + (sr > 0)) * CELL_SIZE + y0 - origin[1]) * sr / max(abs(dy), 1e-12)
        tz = ((z + (sz > 0)) * CELL_SIZE - origin[2]) * sz / max(abs(dz), 1e-12)
        t = 0.0
        while t < length and t <= reach:
            end = c == ec and r == er and z == ez
            if 0 <= r < rows and 0 <= c < cols:
                k = z - base[r, c]
                if 0 <= k < LAYERS and (not end or hits_count[i]):
                    voxel = (r * cols + c) * LAYERS + k
                    if hits[voxel] == 0 and passes[voxel] == 0:
                        touched[n_touched] = voxel
                        n_touched += 1
                    if end:
                        hits[voxel] = min(hits[voxel] + 1, 65535)
                    else:
                        passes[voxel] = min(passes[voxel] + 1, 65535)
            if end:
                break
            if tc <= tr and tc <= tz:
                t = tc
                tc += wc
                c += sc
            elif tr <= tz:
                t = tr
                tr += wr
                r += sr
            else:
                t = tz
                tz += wz
                z += sz
    return n_touched


@kernel
def dempster(o1: float, f1: float, o2: float, f2: float) -> tuple[float, float]:
    """Dempster's rule for two bodies of evidence on {occupied, free}: masses (occupied, free) of the combination.

    The rest of each mass is unknown; of the result at least LEAST_UNKNOWN stays so, which also keeps it defined
    for total contradiction.
    """
    u1, u2 = 1.0 - o1 - f1, 1.0 - o2 - f2
    o, f, u = o1 * o2 + o1 * u2 + u1 * o2, f1 * f2 + f1 * u2 + u1 * f2, u1 * u2
    total = o + f + u
    if total <= 0.0:
        return 0.0, 0.0
    o, f = o / total, f / total
    known = o + f
    if known > 1.0 - LEAST_UNKNOWN:
        o, f = o * (1.0 - LEAST_UNKNOWN) / known, f * (1.0 - LEAST_UNKNOWN) / known
    return o, f


@kernel
def _absorb(hits: U16, passes: U16, touched: I32, n: int, occupied: F32, free: F32) -> None:
    """One scan's counts into a vehicle's masses; the counts are cleared again."""
    for i in range(n):
        v = touched[i]
        o, f = dempster(1.0 - (1.0 - HIT_MASS) ** hits[v], 0.0, 0.0, 1.0 - (1.0 - PASS_MASS) ** passes[v])
        occupied[v], free[v] = dempster(occupied[v], free[v], o, f)
        hits[v], passes[v] = 0, 0


@kernel
def _combine(occupied: F32, free: F32, other_occupied: F32, other_free: F32) -> None:
    """Another vehicle's masses into these, voxel by voxel, in place."""
    for v in range(len(occupied)):
        if other_occupied[v] > 0.0 or other_free[v] > 0.0:
            occupied[v], free[v] = dempster(occupied[v], free[v], other_occupied[v], other_free[v])


@kernel
def _cells(map_words: U64, occupied: F32, free: F32, states: U8) -> None:
    """Voxels to the cell states on which everything here is scored."""
    rows, cols = map_words.shape
    for r in range(rows):
        for c in range(cols):
            in_map, gone, new, seen = 0, 0, 0, 0
            for k in range(LAYERS):
                v = (r * cols + c) * LAYERS + k
                mapped = (map_words[r, c] >> np.uint64(k)) & np.uint64(1) == np.uint64(1)
                known = occupied[v] + free[v] > 0.5
                seen += known
                if mapped:
                    in_map += known
                    gone += MAP_MASS * free[v] > CONFLICT
                else:
                    new += MAP_MASS * occupied[v] > CONFLICT
            if map_words[r, c] != 0 and in_map > 0:
                states[r, c] = _CHANGED_EMPTY if 2 * gone > in_map else _UNCHANGED_OCCUPIED
            elif map_words[r, c] != 0:
                states[r, c] = _UNDETERMINED
            elif seen > 0:
                states[r, c] = _CHANGED_OCCUPIED if new > 0 else _UNCHANGED_EMPTY


class EvidenceMap:
    """One vehicle's voxel map: push every scan, then :func:`combine` the vehicles'."""

    def __init__(self, reference: Reference, window_m: float = 80.0) -> None:
        """``reference``: the old map over the whole window to be scored; 8 bytes a voxel are held for it."""
        self._reference = reference
        self._reach = 0.5 * window_m
        voxels = reference.grid.rows * reference.grid.cols * LAYERS
        self.occupied = np.zeros(voxels, dtype=np.float32)
        self.free = np.zeros(voxels, dtype=np.float32)
        self._hits = np.zeros(voxels, dtype=np.uint16)
        self._passes = np.zeros(voxels, dtype=np.uint16)
        self._touched = np.zeros(voxels, dtype=np.int32)

    @property
    def memory_bytes(self) -> int:
        """Held between scans."""
        return self.occupied.nbytes + self.free.nbytes

    def push(self, points_map: F64, origin_map: F64, obstacle: Bool, moving: Bool) -> None:
        """One scan: points (n, 3) and sensor (3,) in map metres; movers' rays prove what they passed, nothing more."""
        grid = self._reference.grid
        counts = self._hits, self._passes, self._touched
        n = _march(
            points_map, origin_map, obstacle & ~moving, self._reference.base, grid.x0, grid.y0, self._reach, *counts
        )
        _absorb(self._hits, self._passes, self._touched, n, self.occupied, self.free)


def combine(vehicles: Sequence[EvidenceMap], reference: Reference) -> U8:
    """The server's side: (rows, cols) CellState over the reference's window from all vehicles' masses and the map's."""
    states = np.full(reference.grid.shape, NO_VOTE, dtype=np.uint8)
    if not vehicles:
        return states
    occupied, free = vehicles[0].occupied.copy(), vehicles[0].free.copy()
    for other in vehicles[1:]:
        _combine(occupied, free, other.occupied, other.free)
    _cells(reference.occupied, occupied, free, states)
    return states
