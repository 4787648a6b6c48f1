"""A map by itself: its ground, holes, frame; what leans and what is there twice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core.grid import TileIndex
from mapvote.core.point_map import LazyTiles, PointMap, all_points
from mapvote.core.record import record
from mapvote.core.sensor_height import check_heights
from mapvote.core.tile import Tile
from mapvote.core.types import F64, MapvoteError
from mapvote.doctor import Finding, any_error, in_order
from mapvote.doctor.map_points import MAP_POINT_CHECK, check_cloud, in_memory, spacing
from mapvote.formats import read_map, stream_cloud
from mapvote.formats.drives.point_fields import POINT_RULE
from mapvote.formats.geo.frame import frame_of
from mapvote.formats.maps.cloud import Cloud, joined
from mapvote.formats.maps.las import beside_its_box
from mapvote.formats.maps.mapvote_folder import is_map_folder
from mapvote.formats.maps.marked_points import MarkedPoints
from mapvote.formats.maps.tiling import Pieces, grounded, in_map_metres, map_of, on_earth
from mapvote.survey.clean_map import lone_points


@record()
@dataclass(frozen=True, slots=True)
class MapCheck:
    """Numbers of the checks of a map's ground and copies."""

    far_m: float = 50_000.0
    """Distance from the origin beyond which a map is far, metres."""
    slope_deg: float = 6.0
    """Slope of a map's ground beyond which it is tilted, degrees."""
    aloft_m: float = 100.0
    """Height over the ground that hardly any point of a street has, metres."""
    sparse_m: float = 0.4
    """Distance between neighbouring points beyond which they make patterns of their own, metres."""
    most_lone: float = 0.005
    """Share of lone points of a map; a survey's first map has a few in a thousand."""
    middle_points: int = 4_000_000
    """Points around the middle of a map larger than memory that show its ground and copies."""
    bin_m: float = 0.05
    """Bin of the histogram of heights over the ground, metres."""


MAP_CHECK = MapCheck()


@record()
@dataclass(frozen=True, slots=True)
class CopyCheck:
    """Numbers of the search for shifted copies of a map's walls."""

    cell_m: float = 0.2
    """Side of a cell of the picture of walls, metres."""
    side: int = 640
    """Cells along the picture: a square of 128 m is checked."""
    nearest_m: float = 1.0
    """Least shift of a copy, metres: nearer copies are lost in the thickness of the walls."""
    farthest_m: float = 8.0
    """Largest shift of a copy, metres."""
    peak: float = 5.3
    """Height of a copy's peak as a multiple of the usual unevenness. Sound maps of streets give 2 at most, of 24 scans
    with side walls alike 4.7; copies shifted by 1 to 5 m give 6 to 20."""
    fine_cell_m: float = 0.1
    """Side of a cell of the finer picture, metres."""
    fine_side: int = 1024
    """Cells along the finer picture."""
    fine_shift_m: tuple[float, float] = (0.4, 1.4)
    """Least and largest shift of copies on the finer picture, metres."""
    contrast: float = 0.02
    """Contrast of a copy on the finer picture. None of nine sound maps (six simulated, two of KITTI, a campus) gives
    more than 0; copies shifted by .6 m give .04 to .16, on the campus, whose walls are hedges and noise, less than 0
    too."""


COPY_CHECK = CopyCheck()


@record()
@dataclass(frozen=True, slots=True)
class LeanCheck:
    """Numbers of the check whether a map's walls lean."""

    patch_m: float = 1.0
    """Side of a patch of points to which a plane is fitted, metres."""
    patch_points: int = 12
    """Points of a patch at least."""
    upright: float = 0.35
    """Part of a patch's normal along z up to which it stands: 70 deg and steeper."""
    lean_deg: float = 1.5
    """Lean of the walls from which a map is tilted, degrees."""
    lean_sigmas: float = 4.0
    """Standard errors that the lean must exceed."""
    alike: float = 10.0
    """Neighbouring patches that lie on one wall and repeat each other."""


LEAN_CHECK = LeanCheck()


def tile_by_tile(point_map: PointMap) -> Pieces:
    """The points of a map."""
    return lambda: (point_map.tiles[index].points_map for index in sorted(point_map.tiles))


def classified_ground(point_map: PointMap) -> Pieces:
    """Those points of a map that its file classifies as ground."""
    tiles = point_map.tiles
    return lambda: (grounded(tiles[index].fields, tiles[index].points_map) for index in sorted(tiles))


def examine_map(path: Path) -> tuple[list[Finding], PointMap | None]:
    """(findings, errors first; the map, if one can be made of it) of a map in any format."""
    try:
        if not is_map_folder(path):
            sieve = MarkedPoints()
            cloud = joined(sieve.without(stream_cloud(path)))
            findings, made = examine_points(str(path), cloud)
            notes = [Finding("note", line) for line in sieve.told()]
            return in_order([*findings, *_check_box(path, cloud.points), *notes]), made
        point_map = read_map(path)
    except MapvoteError as error:
        return [Finding("error", str(error))], None
    return in_order(
        [*check_cloud(tile_by_tile(point_map), classified_ground(point_map)), *check_map(point_map)]
    ), point_map


def _check_box(path: Path, points: NDArray[np.floating]) -> Iterator[Finding]:
    """Do the points of a LAS file lie in the box that its header states?"""
    if path.suffix.lower() in (".las", ".laz") and len(points):
        beside = beside_its_box(path, points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64))
        if beside:
            problem, _, mend = beside.partition(". ")
            yield Finding("error", problem, mend)


def examine_points(source: str, cloud: Cloud) -> tuple[list[Finding], PointMap | None]:
    """The same of points as a file has them, of which no map has been made yet. MapvoteError if their coordinates
    cannot be made metres."""
    finite = on_earth(cloud.points)
    n = len(finite)
    bad = int((~finite).sum())
    findings = []
    if bad:
        problem = f"{bad} of {n} points are not finite"
        mend = "export the file again; of a LAS the header's scales and offsets may be broken"
        if bad > POINT_RULE.most_bad_share * n:
            return [Finding("error", problem, mend)], None
        findings.append(Finding("note", f"{problem}: import leaves them out"))
    fields = {name: column[finite] for name, column in cloud.fields.items()}
    (cloud,) = in_map_metres(source, iter([replace(cloud, points=cloud.points[finite], fields=fields)]))
    findings += check_cloud(in_memory(cloud.points), in_memory(grounded(cloud.fields, cloud.points)))
    if any_error(findings):
        return in_order(findings), None
    try:
        point_map = map_of(source, [cloud])
    except MapvoteError as error:
        return in_order([*findings, Finding("error", str(error))]), None
    return in_order([*findings, *check_map(point_map)]), point_map


def check_map(point_map: PointMap) -> Iterator[Finding]:
    """Findings on a map whose ground has been measured. Ground and copies of a map larger than memory are checked
    around its middle."""
    middle = _around_the_middle(point_map)
    points = all_points(middle)
    tiles = [middle.tiles[index] for index in sorted(middle.tiles)]
    height = np.concatenate([t.points_map[:, 2] - t.ground_z.reshape(-1)[t.cells] for t in tiles])
    yield from _ground(points, height)
    for problem in filter(None, (check_heights(point_map, path).complaint for path in point_map.driven)):
        mend = "each cell stores one ground level, and vehicles on the other level cannot vote there"
        yield Finding("warning", problem, f"build the map anew; {mend}")
    yield from _missing_tiles(point_map)
    if middle is not point_map:
        problem = (
            f"ground and copies were checked in {len(middle.tiles)} tiles of {len(point_map.tiles)}, in the middle"
        )
        yield Finding("note", problem)
    lone = sum(int(lone_points(tile).sum()) for tile in middle.tiles.values())
    if lone > MAP_CHECK.most_lone * middle.n_points:
        problem = f"{lone} of {middle.n_points} points stand above the ground and touch no other"
        yield Finding("note", problem, "vehicles will vote them away; mapvote import --clean drops them")
    standing = points[(height > 0.5) & (height < 6.0)]
    yield from _lean(standing)
    layer_m = ghost_layer(height)
    if layer_m is not None:
        problem = f"the road occurs twice, {abs(layer_m):.2f} m apart in height: a ghost layer"
        yield Finding("error", problem, "two drives of different height were merged: align them")
    elif float(np.median(spacing(in_memory(points), points))) < MAP_CHECK.sparse_m:
        shift = ghost_shift(standing)
        if shift is not None:
            x, y = shift
            by = f"{np.hypot(x, y):.1f} m (x {x:+.1f}, y {y:+.1f})"
            problem = f"walls and poles occur twice, shifted by {by}: a ghost layer"
            yield Finding("error", problem, "two drives were merged without alignment: align them")
    yield _frame(point_map)


def _around_the_middle(point_map: PointMap) -> PointMap:
    """The map, or of one that is larger than memory the tiles nearest to the middle."""
    if not isinstance(point_map.tiles, LazyTiles):
        return point_map
    row, col = np.median(np.array(list(point_map.tiles)), axis=0)
    chosen: dict[TileIndex, Tile] = {}
    for index in sorted(point_map.tiles, key=lambda index: (np.hypot(index[0] - row, index[1] - col), index)):
        if chosen and sum(len(tile.points) for tile in chosen.values()) > MAP_CHECK.middle_points:
            break
        chosen[index] = point_map.tiles[index]
    return replace(point_map, tiles=dict(sorted(chosen.items())))


def _ground(points: F64, height: F64) -> Iterator[Finding]:
    """Findings on the share of points (n, 3) that the ground explains, by their ``height`` (n,) over it."""
    known_share = float(np.isfinite(height).mean())
    if known_share < 0.5:
        problem = f"the ground is known under {known_share:.0%} of the points only"
        yield Finding("warning", problem, "is the road missing, cut off below, or is z not up?")
    below = float((height < -1.0).mean())
    if below > 0.01:
        problem = f"{below:.1%} of the points lie more than 1 m below the ground"
        yield Finding("warning", problem, "reflections, cellars, or a second layer below")
    above = float((height > MAP_CHECK.aloft_m).mean())
    if above > 0.001:
        problem = f"{above:.1%} of the points lie more than {MAP_CHECK.aloft_m:.0f} m above the ground"
        mend = "outliers, or another place's points: cut them off; sound among towers only"
        yield Finding("error" if above > 0.01 else "warning", problem, mend)
    near = np.abs(height) < 0.15
    if near.sum() < 100:
        yield Finding("warning", "hardly any point lies on the ground", "was the ground cut out of the map?")
        return
    if near.mean() < 0.08:
        problem = f"only {near.mean():.0%} of the points lie on the ground"
        yield Finding("warning", problem, "was the ground cut out of the map? Votes need the road")
    p = points[near][:: max(1, int(near.sum()) // 100_000)]
    p = p - p.mean(axis=0)
    slope, *_ = np.linalg.lstsq(np.column_stack([p[:, :2], np.ones(len(p))]), p[:, 2], rcond=None)
    slope_deg = float(np.degrees(np.arctan(np.hypot(slope[0], slope[1]))))
    if slope_deg > MAP_CHECK.slope_deg:
        problem = f"the ground as a whole is tilted by {slope_deg:.1f} deg"
        yield Finding("warning", problem, "sound on a steep street only; else z is not up: level the map")
    wide = height[np.abs(height) < 0.6]
    rough_m = 1.4826 * float(np.median(np.abs(wide - np.median(wide))))
    if rough_m > 0.12:
        problem = f"the ground is {rough_m:.2f} m thick"
        yield Finding("warning", problem, "scans scatter, or several were merged with bad poses")


def _missing_tiles(point_map: PointMap) -> Iterator[Finding]:
    tiles = set(point_map.tiles)
    above, beside = ({(r + a, c + b) for r, c in tiles} for a, b in ((1, 0), (0, 1)))
    below, behind = ({(r - a, c - b) for r, c in tiles} for a, b in ((1, 0), (0, 1)))
    holes = sorted(((above & below) | (beside & behind)) - tiles)
    if holes:
        window = point_map.lattice.tile(holes[0])
        problem = f"{len(holes)} tiles are missing between others, the first at ({window.x0:.0f}, {window.y0:.0f})"
        yield Finding("warning", problem, "a hole in the map: no vehicle can vote there")


def _frame(point_map: PointMap) -> Finding:
    frame = frame_of(point_map.georeference)
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for points in tile_by_tile(point_map)():
        low = np.minimum(low, points.min(axis=0, initial=np.inf))
        high = np.maximum(high, points.max(axis=0, initial=-np.inf))
    extent = ", ".join(f"{axis} {a:.0f} to {b:.0f}" for axis, a, b in zip("xyz", low, high, strict=True)) + " m"
    if frame.is_local and max(np.abs(low[:2]).max(), np.abs(high[:2]).max()) > MAP_CHECK.far_m:
        problem = f"the map does not name its coordinate system ({extent})"
        return Finding("warning", problem, "import it with --from-crs EPSG:n, so that GNSS and maps find it")
    return Finding("note", f"{extent}; {frame.told()}")


def _lean(standing: F64) -> Iterator[Finding]:
    """Do walls and poles stand upright? On a slope they do; in a map that is tilted they lean. ``standing`` (n, 3)."""
    sides = _sides(standing)
    if len(sides) < 3 * LEAN_CHECK.alike:
        return
    # An object along (a, b, 1) has sides n with n_x a + n_y b = -n_z: Cauchy's robust least squares.
    A = sides[:, :2]
    b = -sides[:, 2]
    lean: F64 = np.zeros(2)
    for _ in range(20):
        off = A @ lean - b
        spread = max(1.4826 * float(np.median(np.abs(off))), 0.005)
        weighted = A / (1.0 + (off / (1.5 * spread)) ** 2)[:, None]
        normal = weighted.T @ A + 1e-9 * np.eye(2)
        lean = np.asarray(np.linalg.solve(normal, weighted.T @ b))
    by = float(np.linalg.norm(lean))
    along = lean / max(by, 1e-9)
    sigma_deg = float(np.degrees(spread * np.sqrt(LEAN_CHECK.alike * along @ np.linalg.inv(normal) @ along)))
    by_deg = float(np.degrees(np.arctan(by)))
    if by_deg > max(LEAN_CHECK.lean_deg, LEAN_CHECK.lean_sigmas * sigma_deg):
        pitch = np.degrees(np.arctan(lean[0]))
        roll = np.degrees(np.arctan(-lean[1]))
        problem = f"walls and poles lean by {by_deg:.1f} deg (+-{sigma_deg:.1f}): the map is tilted"
        mend = f"level it: turn its points back by pitch {pitch:.1f} deg (about y) and roll {roll:.1f} deg (about x)"
        yield Finding("warning", problem, mend)


def _sides(standing: F64) -> F64:
    """(m, 3) directions, near the horizontal, square to what stands: normals of walls, two for each pole."""
    if len(standing) < MAP_POINT_CHECK.few_points:
        return np.empty((0, 3))
    voxel = np.floor((standing - standing.min(axis=0)) / LEAN_CHECK.patch_m).astype(np.int64)
    key = np.ravel_multi_index(tuple(voxel.T), tuple(voxel.max(axis=0) + 1))
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(np.append(starts, len(key)))
    points = standing[order] - standing.mean(axis=0)
    points -= np.repeat(np.add.reduceat(points, starts) / count[:, None], count, axis=0)
    covariance = np.add.reduceat(points[:, :, None] * points[:, None, :], starts) / count[:, None, None]
    spread, axes = np.linalg.eigh(covariance[count >= LEAN_CHECK.patch_points])
    wall = (spread[:, 0] < 0.06**2) & (spread[:, 1] > 0.2**2) & (spread[:, 0] < 0.1 * spread[:, 1])
    wall &= np.abs(axes[:, 2, 0]) < LEAN_CHECK.upright
    pole = (
        (spread[:, 1] < 0.1**2)
        & (spread[:, 2] > 0.25**2)
        & (np.abs(axes[:, 2, 2]) > np.sqrt(1.0 - LEAN_CHECK.upright**2))
    )
    return np.concatenate([axes[wall, :, 0], axes[pole, :, 0], axes[pole, :, 1]])


def ghost_layer(height: F64) -> float | None:
    """How far above (+) or below the ground a second one lies, metres; None if there is none.

    ``height`` (n,) of points over the ground. A second road is as sharp a peak of their histogram as the first; kerbs,
    cars and hedges are broad.
    """
    if (np.abs(height) < 1.0).sum() < MAP_POINT_CHECK.few_points:
        return None
    count, edges = np.histogram(height[np.isfinite(height)], bins=np.arange(-2.5, 2.5, MAP_CHECK.bin_m))
    peak = np.convolve(count, np.ones(3), mode="same")
    middle = 0.5 * (edges[1:] + edges[:-1])
    ground = float(peak[np.abs(middle) < 0.15].max())
    away = np.abs(middle) >= 0.35
    best = int(np.argmax(np.where(away, peak, 0)))
    around = np.abs(middle - middle[best])
    beside = float(np.median(peak[(around > 0.15) & (around < 0.4) & (np.abs(middle) > 0.15)]))
    return float(middle[best]) if peak[best] > 0.3 * ground and peak[best] > 2.0 * beside else None


def ghost_shift(standing: F64) -> tuple[float, float] | None:
    """(x, y) by which what stands is there twice, metres; None if it is not.

    ``standing`` (n, 3), points of walls and poles. Their picture from above is compared with itself, shifted. Farther
    than a metre only a copy makes a sharp peak, apart from shifts along straight walls. Nearer, walls are like
    themselves at every shift along them, but less so the larger it is: only a copy is more alike at its shift than at
    half of that.
    """
    if len(standing) < MAP_POINT_CHECK.few_points:
        return None
    reach = int(COPY_CHECK.farthest_m / COPY_CHECK.cell_m)
    near = _likeness(standing, COPY_CHECK.cell_m, COPY_CHECK.side, reach)
    usual = 1.4826 * float(np.median(np.abs(near - np.median(near))))
    # A copy rises above everything half a metre around it.
    ring = np.ones((7, 7), dtype=bool)
    ring[2:5, 2:5] = False
    sharp = near - scipy.ndimage.percentile_filter(near, 90, footprint=ring)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] * COPY_CHECK.cell_m
    sharp[(np.hypot(x, y) < COPY_CHECK.nearest_m) | (near < scipy.ndimage.maximum_filter(near, 5))] = 0.0
    best = np.unravel_index(int(np.argmax(sharp)), sharp.shape)
    if sharp[best] >= COPY_CHECK.peak * usual:
        return float(x[best]), float(y[best])
    return _shift_beside(standing)


def _likeness(standing: F64, cell_m: float, side: int, reach: int) -> F64:
    """(2 reach + 1, 2 reach + 1) how much the picture from above is like itself, by shift in cells along y and x."""
    centre = np.median(standing[:, :2], axis=0)
    cells = np.floor((standing[:, :2] - centre) / cell_m).astype(np.int64) + side // 2
    cells = cells[((cells >= 0) & (cells < side)).all(axis=1)]
    picture = np.zeros((side, side))
    picture[cells[:, 1], cells[:, 0]] = 1.0
    picture -= scipy.ndimage.uniform_filter(picture, 25)
    # Half of the whitening that would leave only phases: walls are like themselves all along, copies are not.
    spectrum = np.abs(np.fft.rfft2(picture, s=(2 * side, 2 * side)))
    likeness = np.fft.fftshift(np.fft.irfft2(spectrum))
    near = likeness[side - reach : side + reach + 1, side - reach : side + reach + 1]
    return np.asarray(scipy.ndimage.uniform_filter(near, 3))


def _shift_beside(standing: F64) -> tuple[float, float] | None:
    reach = int(1.7 * COPY_CHECK.fine_shift_m[1] / COPY_CHECK.fine_cell_m)
    near = _likeness(standing, COPY_CHECK.fine_cell_m, COPY_CHECK.fine_side, reach)
    near /= near[reach, reach]
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float64)
    half, more = (
        scipy.ndimage.map_coordinates(near, [reach + f * y, reach + f * x], order=1, mode="nearest") for f in (0.5, 1.5)
    )
    contrast = near - np.maximum(half, more)
    away_m = np.hypot(x, y) * COPY_CHECK.fine_cell_m
    contrast[(away_m < COPY_CHECK.fine_shift_m[0]) | (away_m > COPY_CHECK.fine_shift_m[1])] = 0.0
    best = np.unravel_index(int(np.argmax(contrast)), contrast.shape)
    if contrast[best] < COPY_CHECK.contrast:
        return None
    return float(x[best]) * COPY_CHECK.fine_cell_m, float(y[best]) * COPY_CHECK.fine_cell_m
