"""What the scans of a drive said of each cell, kept: every reading of the paper is then a look-up, without the drive.

A word a cell and scan (detection/sightings.py), over each scan's window; and, over the truth's window, in how many
scans something kept a cell from being occupied, or made it so, that no reading changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapvote.codec.arrays import pack_plane, unpack_bytes
from mapvote.core.grid import Grid
from mapvote.core.sensors import Sensor
from mapvote.core.types import I32, U16, Bool
from mapvote.detection.new_points import REACH_M
from mapvote.detection.paper import sightings
from mapvote.perception.frontend import Observation, PlacedScan
from mapvote.perception.raycast import find_obstacles

_FAST = 1
"""zstd level: written once, read for every reading."""


@dataclass(frozen=True, slots=True)
class KeptDrive:
    """One vehicle's drive. The counts are of scans, (rows, cols) over the truth's window."""

    window: Grid
    windows: I32
    """(scans, 4) row0, col0, rows, cols of each scan's local grid, from the truth's corner."""
    sizes: I32
    """(scans,) bytes of each scan's words."""
    packed: bytes
    taken: U16
    """Scans in which the cell had n_min points, had the moving-object filter not taken some."""
    passed_off: U16
    """Scans in which it had n_min points only because the filter left some of a body that moves."""
    beyond: U16
    """Scans in which n_min points fell into it, but it lay outside the local grid."""

    def words(self) -> Iterator[tuple[int, int, U16]]:
        """(row0, col0, words (rows, cols)) of each scan, rows and columns from the truth's corner."""
        at = 0
        for (row0, col0, rows, cols), size in zip(self.windows.tolist(), self.sizes.tolist(), strict=True):
            raw = unpack_bytes(self.packed[at : at + size], 2 * rows * cols, "a kept scan")
            yield row0, col0, np.frombuffer(raw, dtype="<u2").reshape(rows, cols)
            at += size


class Keeper:
    """Watches the observations of a drive. ``moving`` (scan's number) -> (n,): which of its points truly move."""

    def __init__(self, window: Grid, sensor: Sensor, n_min: int, moving: Callable[[int], Bool]) -> None:
        self.window, self.sensor, self.n_min, self._moving = window, sensor, n_min, moving
        self._windows: list[tuple[int, int, int, int]] = []
        self._packed: list[bytes] = []
        self._taken, self._passed_off, self._beyond = (np.zeros(window.shape, dtype=np.uint16) for _ in range(3))

    def watch(self, observations: Sequence[Observation]) -> None:
        """Keep what these scans say."""
        for seen in observations:
            grid = seen.view.grid
            self._windows.append((grid.row0 - self.window.row0, grid.col0 - self.window.col0, *grid.shape))
            self._packed.append(pack_plane(sightings(seen, self.sensor, self.n_min), _FAST))
            self._count(seen)

    def _count(self, seen: Observation) -> None:
        scan, grid, n_min = seen.scan, seen.view.grid, self.n_min
        inside = scan.obstacle & (scan.cell >= 0)
        every = np.bincount(scan.cell[inside], minlength=seen.view.counts.size).reshape(grid.shape)
        still = inside & ~seen.moving & ~self._moving(scan.index)
        truly = np.bincount(scan.cell[still], minlength=every.size).reshape(grid.shape)
        occupied = seen.view.counts >= n_min
        common = grid.intersection(self.window)
        here, there = common.slices_in(grid), common.slices_in(self.window)
        self._taken[there] += (~occupied & (every >= n_min))[here]
        self._passed_off[there] += (occupied & (truly < n_min))[here]
        cells = self._cells_beyond(scan)
        self._beyond.ravel()[np.flatnonzero(np.bincount(cells, minlength=self._beyond.size) >= n_min)] += 1

    def _cells_beyond(self, scan: PlacedScan) -> np.ndarray:
        """Flat cells of the truth's window of obstacle points that fell outside the local grid."""
        outside = scan.points_map[scan.cell < 0]
        near = outside[np.sum((outside[:, :2] - scan.origin_map[:2]) ** 2, axis=1) < REACH_M**2]
        obstacle, _ = find_obstacles(near, scan.outer)
        rows, cols, inside = self.window.indices_of(near[obstacle])
        return (rows * self.window.cols + cols)[inside]

    def write(self, folder: Path) -> None:
        """Into files of ``folder``."""
        (folder / "kept.words").write_bytes(b"".join(self._packed))
        np.savez_compressed(
            folder / "kept.npz",
            windows=np.array(self._windows, dtype=np.int32).reshape(-1, 4),
            sizes=np.array([len(data) for data in self._packed], dtype=np.int32),
            taken=self._taken,
            passed_off=self._passed_off,
            beyond=self._beyond,
        )


def read_kept(folder: Path, window: Grid) -> KeptDrive:
    """What :meth:`Keeper.write` wrote; ``window``: the truth's."""
    with np.load(folder / "kept.npz") as file:
        planes = {name: file[name] for name in ("windows", "sizes", "taken", "passed_off", "beyond")}
    return KeptDrive(window=window, packed=(folder / "kept.words").read_bytes(), **planes)
