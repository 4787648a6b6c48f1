"""What the doctor found, as a picture: scans laid over each other and over the map, as read and as mended."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.core.geometry import transform
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.types import F32, F64, Drive, MapvoteError
from mapvote.doctor.diagnosis import Diagnosis
from mapvote.evaluation.reporting import style

_SCANS = 6
_POINTS_OF_A_SCAN, _POINTS_OF_THE_MAP = 6_000, 200_000
_CLOSE_M = 25.0
"""Half the side of the lower pictures."""
_SAID = 3
"""Findings that stand above the picture."""


def draw_diagnosis(diagnosis: Diagnosis, point_map: PointMap | None, path: Path) -> None:
    """Write a PNG: scans from above, coloured by time, over the map (grey): left as read, right as mended; below a
    part of it from near. Where the doctor knows no way to mend, the right side says so."""
    figure, axes = style.new_figure(11.0, 11.5, rows=2, cols=2)
    ground = None if point_map is None else _thinned(all_points(point_map), _POINTS_OF_THE_MAP)
    drive, read, mended = diagnosis.drive, diagnosis.T_read, diagnosis.T_mended
    scans = {} if drive is None else _some_scans(drive)
    for column, (title, T) in enumerate((("as read", read), ("as mended", mended))):
        wide, near = axes[:, column]
        wide.set_title(title)
        if T is None or drive is None:
            missing = "no prior: nothing says where the scans lie" if column == 0 else "not known how to mend it"
            for axis in (wide, near):
                axis.text(0.5, 0.5, missing, ha="center", transform=axis.transAxes)
                axis.set_axis_off()
            continue
        for axis in (wide, near):
            if ground is not None:
                axis.plot(ground[:, 0], ground[:, 1], ",", color=style.FAINT, alpha=0.4)
            _draw_scans(axis, scans, T, len(drive))
            axis.plot(T[:, 0, 3], T[:, 1, 3], "-", color=style.INK, linewidth=1.0)
            axis.set(xlabel="x, m", ylabel="y, m")
            axis.set_aspect("equal", adjustable="box" if axis is near else "datalim")
        x, y = T[len(T) // 2, :2, 3]
        near.set_xlim(x - _CLOSE_M, x + _CLOSE_M)
        near.set_ylim(y - _CLOSE_M, y + _CLOSE_M)
    figure.suptitle(_headline(diagnosis), ha="left", x=0.01, fontsize=9.5)
    style.save(figure, path)


def _headline(diagnosis: Diagnosis) -> str:
    serious = [f"{f.severity}: {f.what}" for f in diagnosis.findings if f.severity != "note"][:_SAID] or ["sound"]
    return "\n".join(textwrap.fill(line, 120, subsequent_indent="    ") for line in serious)


def _some_scans(drive: Drive) -> dict[int, F32]:
    """A few scans along the drive, without the road below and what is far."""
    scans = {}
    for i in np.unique(np.linspace(0, len(drive) - 1, _SCANS).astype(np.int64)):
        try:
            points = drive.read_scan(int(i)).points
        except MapvoteError:
            continue
        scans[int(i)] = _thinned(points, _POINTS_OF_A_SCAN)
    return scans


def _thinned(points: Any, most: int) -> Any:
    return points[:: max(1, len(points) // most)]


def _draw_scans(axis: Any, scans: dict[int, F32], T: F64, n: int) -> None:
    for i, points in scans.items():
        placed = transform(T[i], points.astype(np.float64))
        axis.scatter(
            placed[:, 0], placed[:, 1], s=0.3, c=np.full(len(placed), i), cmap="viridis", vmin=0, vmax=max(n - 1, 1)
        )
