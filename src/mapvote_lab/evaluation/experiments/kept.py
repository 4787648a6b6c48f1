"""What the scans of a drive say of each cell, kept: every reading of the paper is then a look-up, without the drive.

A word a cell and scan (detection/paper.py), over each scan's window.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapvote.codec.arrays import pack_plane, unpack_bytes
from mapvote.core.grid import Grid
from mapvote.core.sensors import Sensor
from mapvote.core.types import I32, U16
from mapvote.detection.paper import sightings
from mapvote.perception.frontend import Observation

_FAST = 1
"""zstd level: written once, read for every reading."""


@dataclass(frozen=True, slots=True)
class KeptDrive:
    """What the scans of one drive say of each cell."""

    windows: I32
    """(scans, 4) row0, col0, rows, cols of each scan's local grid, from the truth's corner."""
    sizes: I32
    """(scans,) bytes of each scan's words."""
    packed: bytes

    def words(self) -> Iterator[tuple[int, int, U16]]:
        """(row0, col0, words (rows, cols)) of each scan, rows and columns from the truth's corner."""
        at = 0
        for (row0, col0, rows, cols), size in zip(self.windows.tolist(), self.sizes.tolist(), strict=True):
            raw = unpack_bytes(self.packed[at : at + size], 2 * rows * cols, "a kept scan")
            yield row0, col0, np.frombuffer(raw, dtype="<u2").reshape(rows, cols)
            at += size


class Keeper:
    """Packs what each observation of a drive says, over ``window``."""

    def __init__(self, window: Grid, sensor: Sensor, n_min: int) -> None:
        self.window, self.sensor, self.n_min = window, sensor, n_min
        self._windows: list[tuple[int, int, int, int]] = []
        self._packed: list[bytes] = []

    def watch(self, observations: Sequence[Observation]) -> None:
        """Keep what these scans say."""
        for seen in observations:
            grid = seen.view.grid
            self._windows.append((grid.row0 - self.window.row0, grid.col0 - self.window.col0, *grid.shape))
            self._packed.append(pack_plane(sightings(seen, self.sensor, self.n_min), _FAST))

    def write(self, folder: Path) -> None:
        """Into two files of ``folder``."""
        (folder / "kept.words").write_bytes(b"".join(self._packed))
        windows = np.array(self._windows, dtype=np.int32).reshape(-1, 4)
        np.savez(folder / "kept.npz", windows=windows, sizes=np.array(list(map(len, self._packed)), dtype=np.int32))


def read_kept(folder: Path) -> KeptDrive:
    """What :meth:`Keeper.write` wrote."""
    with np.load(folder / "kept.npz") as file:
        return KeptDrive(file["windows"], file["sizes"], (folder / "kept.words").read_bytes())
