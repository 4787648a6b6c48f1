"""The cells of a window that points fall into, in one pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.kernel import kernel
from mapvote.core.types import read_only


def flat_cells(window: Grid, points: NDArray[np.float32]) -> NDArray[np.int64]:
    """(n,) row * cols + col of points (n, 3) from the window's corner, metres; the outermost cells take what rounding
    moved. As :meth:`Grid.indices_of` of :meth:`Grid.to_map` has them, to the last bit."""
    corner = window.x0, window.y0, window.lattice.x0, window.lattice.y0
    flat = np.empty(len(points), dtype=np.int64)
    cloud = read_only(np.ascontiguousarray(points))
    _enter_cells(cloud, *corner, window.row0, window.col0, window.rows, window.cols, flat)
    return flat


@kernel
def _enter_cells(
    points: NDArray[np.float32], x0: float, y0: float, lattice_x0: float, lattice_y0: float, row0: int, col0: int,
    rows: int, cols: int, flat: NDArray[np.int64],
) -> None:  # fmt: skip
    for i in range(len(points)):
        row = int(np.floor((np.float64(points[i, 1]) + y0 - lattice_y0) / CELL_SIZE)) - row0
        col = int(np.floor((np.float64(points[i, 0]) + x0 - lattice_x0) / CELL_SIZE)) - col0
        flat[i] = min(max(row, 0), rows - 1) * cols + min(max(col, 0), cols - 1)
