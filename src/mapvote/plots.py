"""Pictures of a survey and of the doctor's findings, and the look of all pictures: a colour always means the same.

Needs matplotlib (extra ``plots``).
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from mapvote.core.geometry import transform
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.record import record
from mapvote.core.sampling import evenly
from mapvote.core.types import F32, F64, NO_VOTE, U8, CellState, Drive, MapvoteError
from mapvote.formats.atomic import whole_file

if TYPE_CHECKING:
    from mapvote.doctor.diagnosis import Diagnosis
    from mapvote.survey.build import BuildReport

Format = Literal["png", "svg", "pdf"]


class Colour(StrEnum):
    """Colours of all pictures, by their meaning."""

    INK = "#22303c"
    WHITE = "#ffffff"
    FAINT = "#8795a1"
    NEW = "#d7263d"
    GONE = "#1673c4"
    STANDING = "#51687c"
    EMPTY = "#e6ecf1"
    UNSURE = "#f2c230"
    MOVING = "#e07b00"


STATE_COLOURS = {
    CellState.UNCHANGED_OCCUPIED: Colour.STANDING,
    CellState.UNCHANGED_EMPTY: Colour.EMPTY,
    CellState.CHANGED_OCCUPIED: Colour.NEW,
    CellState.CHANGED_EMPTY: Colour.GONE,
    CellState.UNDETERMINED: Colour.UNSURE,
}
STATE_NAMES = {
    CellState.UNCHANGED_OCCUPIED: "unchanged (occupied)",
    CellState.UNCHANGED_EMPTY: "unchanged (empty)",
    CellState.CHANGED_OCCUPIED: "changed (occupied)",
    CellState.CHANGED_EMPTY: "changed (empty)",
    CellState.UNDETERMINED: "undetermined",
}
VEHICLE_COLOURS = ("#22303c", "#e07b00", "#2a8f5b", "#8e44ad", "#7f5539", "#0b7a75", "#b5179e", "#6c757d")
"""Never red nor blue: those mean change."""


def state_map() -> ListedColormap:
    """The colour of each state, in their order, and white for no vote."""
    return ListedColormap([*STATE_COLOURS.values(), Colour.WHITE])


@record()
@dataclass(frozen=True, slots=True)
class PictureSizes:
    """How much pictures of a survey and of a diagnosis show."""

    least_m: float = 0.01
    """Lower end of the logarithmic scale of prior errors, metres: a very wrong prior leaves the others legible."""
    scans: int = 6
    """Scans of a drive in the doctor's picture."""
    points_of_a_scan: int = 6_000
    """Most points of a scan."""
    points_of_the_map: int = 200_000
    """Most points of the map."""
    close_m: float = 25.0
    """Half the side of the doctor's lower pictures, metres."""
    findings: int = 3
    """Most findings above the doctor's picture."""


PICTURE_SIZES = PictureSizes()
_DPI = 140
_FONT = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.edgecolor": Colour.FAINT,
    "axes.labelcolor": Colour.INK,
    "axes.titlecolor": Colour.INK,
    "axes.titlesize": 10.5,
    "xtick.color": Colour.INK,
    "ytick.color": Colour.INK,
    "text.color": Colour.INK,
    "axes.linewidth": 0.8,
}


def state_image(states: U8) -> U8:
    """States as indices of :func:`state_map`."""
    return np.where(states == NO_VOTE, len(CellState), states).astype(np.uint8)


def new_figure(width: float, height: float, rows: int = 1, cols: int = 1, **grid: Any) -> tuple[Figure, Any]:
    """A figure of inches and its axes, without pyplot and its global state."""
    import matplotlib

    with matplotlib.rc_context(_FONT):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        return figure, figure.subplots(rows, cols, squeeze=False, **grid)


def save(figure: Figure, path: Path, format: Format = "png") -> None:
    """Without dates or versions in it, whole or not at all: same picture, same bytes."""
    import matplotlib

    undated = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}, "pdf": {"CreationDate": None}}
    fixed = {"svg.hashsalt": "mapvote", "svg.fonttype": "none", "pdf.fonttype": 42}
    with matplotlib.rc_context(_FONT | fixed), whole_file(path) as partial:
        options: dict[str, Any] = {"dpi": _DPI, "metadata": undated[format]}
        if format == "png":
            _lay_out(figure)
            options["pil_kwargs"] = {"compress_level": 3}  # a twentieth larger than by 6, in two thirds of the time
        figure.savefig(partial, format=format, **options)


def _lay_out(figure: Figure) -> None:
    """Place the axes by the layout engine alone: ``savefig`` would draw all images and points once more for that."""
    figure.set_dpi(_DPI)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")


def draw_survey(drives: Sequence[Drive], report: BuildReport, path: Path, sizes: PictureSizes = PICTURE_SIZES) -> None:
    """Write a PNG: every drive from above with its priors, and their distance along the road. Crosses: scans that were
    not registered; a dashed line: where the map is broken."""
    figure, axes = new_figure(9.0, 8.0, rows=2)
    # Each drive in its colour: its way and priors above, their distance below.
    above, along = axes[:, 0]
    for k, (drive, track) in enumerate(zip(drives, report.tracks, strict=True)):
        colour = VEHICLE_COLOURS[k % len(VEHICLE_COLOURS)]
        positions = track.T_map_lidar[:, :3, 3]
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
        above.plot(positions[:, 0], positions[:, 1], color=colour, label=f"{track.vehicle}/{track.drive_id}")
        lost = positions[~track.registered]
        above.plot(lost[:, 0], lost[:, 1], "x", color=Colour.INK)
        if drive.T_map_lidar_prior is not None:
            priors = drive.T_map_lidar_prior[:, :3, 3]
            above.plot(priors[:, 0], priors[:, 1], ".", color=colour, alpha=0.5, markersize=3)
            off = np.linalg.norm(positions[:, :2] - priors[:, :2], axis=1)
            along.plot(way, np.maximum(off, sizes.least_m), ".", color=colour, markersize=3)
            along.axhline(drive.prior_sigma_m, color=colour, linestyle=":")
        for i in track.broken:
            along.axvline(way[i], color=colour, linestyle="--")
    above.set(title="where the survey went (lines), and its priors (dots)", xlabel="x, m", ylabel="y, m")
    above.set_aspect("equal", adjustable="datalim")
    above.legend()
    along.set(title="distance from the priors, and what they claim (dotted)", xlabel="along the road, m", ylabel="m")
    along.set_yscale("log")
    save(figure, path)


def draw_diagnosis(
    diagnosis: Diagnosis, point_map: PointMap | None, path: Path, sizes: PictureSizes = PICTURE_SIZES
) -> None:
    """Write a PNG: scans from above, coloured by time, over the map (grey): left as read, right as mended; below a
    part of it from near. Where the doctor knows no way to mend, the right side says so."""
    figure, axes = new_figure(11.0, 11.5, rows=2, cols=2)
    # The drive as it was read and as it was mended; a few of its scans.
    ground = None if point_map is None else _thinned(all_points(point_map), sizes.points_of_the_map)
    drive = diagnosis.drive
    mended = diagnosis.T_mended
    read = None if drive is None else drive.T_map_lidar_prior
    scans = {} if drive is None else _some_scans(drive, sizes)
    # Left as read, right as mended: the whole above, a part of it from near below.
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
                axis.plot(ground[:, 0], ground[:, 1], ",", color=Colour.FAINT, alpha=0.4)
            _draw_scans(axis, scans, T, len(drive))
            axis.plot(T[:, 0, 3], T[:, 1, 3], "-", color=Colour.INK, linewidth=1.0)
            axis.set(xlabel="x, m", ylabel="y, m")
            axis.set_aspect("equal", adjustable="box" if axis is near else "datalim")
        x, y = T[len(T) // 2, :2, 3]
        near.set_xlim(x - sizes.close_m, x + sizes.close_m)
        near.set_ylim(y - sizes.close_m, y + sizes.close_m)
    figure.suptitle(_headline(diagnosis, sizes.findings), ha="left", x=0.01, fontsize=9.5)
    save(figure, path)


def _headline(diagnosis: Diagnosis, most: int) -> str:
    serious = [f"{f.severity}: {f.what}" for f in diagnosis.findings if f.severity != "note"][:most] or ["sound"]
    return "\n".join(textwrap.fill(line, 120, subsequent_indent="    ") for line in serious)


def _some_scans(drive: Drive, sizes: PictureSizes) -> dict[int, F32]:
    """A few scans along the drive, thinned; broken ones left out."""
    scans = {}
    for i in evenly(0, len(drive) - 1, sizes.scans).tolist():
        try:
            points = drive.read_scan(i).points
        except MapvoteError:
            continue
        scans[i] = _thinned(points, sizes.points_of_a_scan)
    return scans


def _thinned(points: Any, most: int) -> Any:
    return points[:: max(1, len(points) // most)]


def _draw_scans(axis: Any, scans: dict[int, F32], T: F64, n: int) -> None:
    for i, points in scans.items():
        placed = transform(T[i], points.astype(np.float64))
        axis.scatter(
            placed[:, 0], placed[:, 1], s=0.3, c=np.full(len(placed), i), cmap="viridis", vmin=0, vmax=max(n - 1, 1)
        )
