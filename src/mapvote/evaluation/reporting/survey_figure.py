"""How a survey fits its priors, as a picture: where it went and where it was told to be, and the misfit on the way."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapvote.core.types import Drive
from mapvote.evaluation.reporting import style
from mapvote.slam.build import BuildReport

_LEAST_M = 0.01
"""The lower end of the logarithmic scale, on which wild priors leave the others legible."""


def draw_survey(drives: Sequence[Drive], report: BuildReport, path: Path) -> None:
    """Write a PNG: every drive from above with its priors, and their distance along the road. Crosses: scans that were
    not registered; a dashed line: where the map is broken."""
    figure, axes = style.new_figure(9.0, 8.0, rows=2)
    above, along = axes[:, 0]
    for k, (drive, track) in enumerate(zip(drives, report.tracks, strict=True)):
        colour = style.VEHICLE_COLOURS[k % len(style.VEHICLE_COLOURS)]
        found = track.T_map_lidar[:, :3, 3]
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(found, axis=0), axis=1)))
        above.plot(found[:, 0], found[:, 1], color=colour, label=f"{track.vehicle}/{track.drive_id}")
        lost = found[~track.registered]
        above.plot(lost[:, 0], lost[:, 1], "x", color=style.INK)
        if drive.T_map_lidar_prior is not None:
            told = drive.T_map_lidar_prior[:, :3, 3]
            above.plot(told[:, 0], told[:, 1], ".", color=colour, alpha=0.5, markersize=3)
            off = np.linalg.norm(found[:, :2] - told[:, :2], axis=1)
            along.plot(way, np.maximum(off, _LEAST_M), ".", color=colour, markersize=3)
            along.axhline(drive.prior_sigma_m, color=colour, linestyle=":")
        for i in track.broken:
            along.axvline(way[i], color=colour, linestyle="--")
    above.set(title="where the survey went (lines), and its priors (dots)", xlabel="x, m", ylabel="y, m")
    above.set_aspect("equal", adjustable="datalim")
    above.legend()
    along.set(title="distance from the priors, and what they claim (dotted)", xlabel="along the road, m", ylabel="m")
    along.set_yscale("log")
    style.save(figure, path)
