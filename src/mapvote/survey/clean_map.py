"""The second pass: scans at known poses become a map of points without moving objects, ground and known-free columns.

A draft of the map gives the ground and the occupied voxels. Each scan is then counted as a vehicle counts it: the scans
that hit a voxel, and the scans whose rays passed it (rules/evidence.py). At the end points on no standing surface are
dropped, one function a rule. Their voxels are unknown, not free. :class:`Cleaning` holds the numbers.

| rule | a point is dropped if | cause |
|---|---|---|
| ``seen_through`` | rays crossed its voxel in six scans or more, and most scans did not hit it | a trail |
| ``trails`` | its low group of cells was passed more often than hit | a trail of a vehicle far off |
| ``strays`` | few of the places near by hit it, or it lies just over the face of another surface's voxel | noise |
| ``specks`` | it is one of a few voxels that touch no other surface, each hit by one scan | noise |
| ``mirrored`` | it lies below unbroken ground | a reflection |

Only points that passed the filter of moving objects enter the map, at whatever range: a car that drives ahead of the
surveyor is too far off for the counting. Returns from beyond the filter's reach are left out.

Reflections. A wet road, a window or the side of a car deflects a ray, and the range puts its return below the ground.
A point below ground that is known and level on all sides is such a return. Two kinds of points below ground stay:
beside a step of the ground, where a wall may go down to a yard, and near places where vehicles drove above each other.

Strays. A beam that grazes an edge returns a place between two surfaces; a pane shows a room that is not there. No ray
speaks against such points, because other scans saw the wall in front of them. A surface is hit by more than 3 %
of the scans that pass within 20 m of it; strays are not. A wall two centimetres from a voxel's face has points in two
voxels: the fewer points just over the face belong to the same wall.

Specks. Mixed pixels and mirrored rooms leave points that touch nothing, each hit once. A vehicle that comes by denies
them, and would be right: the map would change where nothing changed. ``import --clean`` asks the same of a map that
comes from elsewhere, by how many points each voxel holds.

Trails. A standing thing is hit as often as rays pass through its voxels, as a whole if not in each voxel. A thing that
drove was hit once or twice in each place, and rays passed there before and after.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mapvote.config import Settings
from mapvote.core.columns import TOP_BIT, column_bits, rebased
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.core.kernel import kernel
from mapvote.core.point_map import SCANS, PointMap, cut_tiles, map_from_points
from mapvote.core.record import record
from mapvote.core.reference import LocalMap
from mapvote.core.sensor_height import crossings
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, U64, Bool
from mapvote.core.voxels import BESIDE, VoxelCloud, slot_of, thin, voxel_keys
from mapvote.matching.localiser import GivenPoses
from mapvote.perception.frontend import Frontend, Observation
from mapvote.perception.moving_objects import MOVERS, MovingFilter
from mapvote.rules.evidence import count_scan, free_words, least_passed
from mapvote.rules.packed_tiles import count_of
from mapvote.rules.voxel_counts import HIT, PASSES, VoxelCounts
from mapvote.survey.pose_graph import DriveTrack


@record()
@dataclass(frozen=True, slots=True)
class Cleaning:
    """Numbers of the rules that drop points."""

    road_m: float = 0.1
    """Height above the ground up to which points are the road itself, also under a car."""
    below_m: float = 0.5
    """Depth below the ground from which a point is no part of it, however rough."""
    level_cells: int = 2
    """Cells to each side of a reflection in which the ground must be known and level."""
    bridge_m: float = 80.0
    """Distance from a crossing of two roads on two levels within which points below ground stay: scans enter the map
    from as far."""
    near_m: float = 20.0
    """Distance in the plane within which a scan should hit a standing surface."""
    hit_share: float = 0.03
    """Share of these places from which a surface must be hit: two scans of seventy, at 10 Hz and 40 km/h twice past."""
    spill_m: float = 0.06
    """Points of two voxels so near on both sides of their common face are one surface: three sigmas of range noise."""
    place_m: float = 1.0
    """Distance between two places that count."""
    most_hits: int = 16
    """Voxels hit by more scans are not tested: 500 places within 20 m are a survey of a dozen passes."""
    seen_through: int = 6
    """Scans that must have crossed a voxel before it can be a trail."""
    trail_share: float = 0.3
    """Share of the scans that crossed or hit a voxel below which, if hit, it is a trail."""
    largest_speck: int = 5
    """Voxels that touch each other and no other surface."""
    tall_m: float = 4.0
    """Height of a group of cells that is no vehicle: no lorry is taller (Directive 96/53/EC)."""


CLEANING = Cleaning()


class Mapper:
    """Collects the scans of all drives, then gives the map."""

    def __init__(
        self, draft: PointMap, settings: Settings, road: F64 | None = None, numbers: Cleaning = CLEANING
    ) -> None:
        """``road`` (n, 3), map metres: where vehicles drove, from which the ground grows."""
        self.draft = draft
        self.road = road
        self.settings = settings
        self.numbers = numbers
        self.cloud = VoxelCloud(draft.lattice)
        self.counts = VoxelCounts(draft.lattice)
        self._driven = [np.zeros((0, 3))]
        self._around = LocalMap(draft, 2.0 * settings.mapping.reach_m)
        self._near = LocalMap(draft, settings.voting.window_m)

    def enter(self, track: DriveTrack) -> Iterator[None]:
        """Enter the registered scans of one drive at their poses, a scan a step."""
        drive = track.drive
        frontend = Frontend(
            GivenPoses(drive.stamps_ns, track.T_map_lidar),
            MovingFilter(drive.sensor, self.settings.moving, replace(MOVERS, reach_m=self.settings.mapping.reach_m)),
            self._around,
            self._near,
            with_sight=False,
            sensor=drive.sensor,
        )
        self._driven.append(track.driven)
        for i, scan in enumerate(drive):
            if track.registered[i]:
                self._add(frontend.observe(scan))
            yield
        self._add(frontend.finish())

    def _add(self, seen: list[Observation]) -> None:
        for observation in seen:
            scan = observation.scan
            moving = observation.moving
            ground_z = scan.reference.ground_z
            left_out = np.empty(len(moving), np.bool_)
            reach2 = self.settings.mapping.reach_m**2
            beside = np.zeros(ground_z.size, np.bool_)
            points_map = scan.points_map
            places = points_map, scan.origin_map, reach2, self.numbers.road_m
            _leave_out(*places, moving, scan.obstacle, scan.cell, ground_z, beside, left_out)
            self.cloud.enter(points_map, left_out)
            count_scan(self.counts, observation)

    def finish(self) -> PointMap:
        """The map of all points added so far."""
        numbers = self.numbers
        points, scans = self.cloud.points()
        counts = self._counts(points)
        kept = ~(_standing(points, self.draft) & seen_through(counts, numbers))
        points = points[kept]
        scans = scans[kept]
        counts = counts[kept]
        # The ground anew without trails, which lift the draft's: undersides of cars had passed for ground.
        laid = map_from_points(points, lattice=self.draft.lattice, road=self.road)
        lattice = self.draft.lattice
        obstacle = _standing(points, laid)
        dropped = (obstacle & seen_through(counts, numbers)) | mirrored(points, laid, self.road, numbers)
        if self.settings.mapping.drop_strays:
            dropped |= obstacle & strays(points, scans, np.concatenate(self._driven), lattice, numbers)
            left = np.flatnonzero(obstacle & ~dropped)
            height = points[left, 2] - laid.ground_under(points[left])
            dropped[left] |= trails(points[left], counts[left, 0] - counts[left, 1], height, lattice, numbers)
            left = np.flatnonzero(obstacle & ~dropped)
            dropped[left] |= specks(points[left], scans[left], lattice, numbers.largest_speck)
        # The map of the points that are left, with its known-free columns.
        fields = {SCANS: np.minimum(scans[~dropped], 255).astype(np.uint8)}
        point_map = map_from_points(points[~dropped], lattice=lattice, road=self.road, fields=fields)
        tiles = {tile: replace(content, free=self._free(content)) for tile, content in point_map.tiles.items()}
        return replace(point_map, tiles=tiles)

    def _counts(self, points: F64) -> I64:
        """(n, 3) scans that hit, passed and crossed the voxels of points (n, 3); 0 outside columns."""
        out = np.zeros((len(points), 3), dtype=np.int64)
        counted = self.counts.settled()
        for index, within in cut_tiles(points, self.draft.lattice):
            if index in counted:
                tile = self.draft.tile(index)
                rows, cols, _ = tile.window.indices_of(points[within])
                bits = np.floor(points[within, 2] / CELL_SIZE).astype(np.int64) - tile.base[rows, cols]
                counts = np.zeros((len(within), 3), dtype=np.int64)
                _counts_of(counted[index], rows, cols, bits, counts)
                out[within] = counts
        return out

    def _free(self, after: Tile) -> U64:
        """Known-free columns of one tile of the finished map, on its own ground."""
        counted = self.counts.settled()
        if after.index not in counted:
            return np.zeros(after.window.shape, dtype=np.uint64)
        before = self.draft.tile(after.index).base
        free = free_words(counted[after.index])
        after = replace(after)  # a copy: the columns that it computes for this alone are freed with it
        out = rebased(free, before - after.base) & ~after.obstacle_words
        out[np.isnan(after.ground_z)] = 0
        return out


def _standing(points: F64, ground: PointMap) -> Bool:
    """(n,) which points (n, 3) stand above the ground of ``ground``; none outside its tiles."""
    out = np.zeros(len(points), dtype=np.bool_)
    for tile, chosen, cell in ground.by_tile(points):
        out[chosen] = column_bits(points[chosen, 2], tile.ground_z[cell], tile.base[cell])[1]
    return out


@kernel
def _leave_out(
    points: F64, origin: F64, reach2: float, road_m: float, moving: Bool, obstacle: Bool, cell: I32, ground_z: F32,
    beside: Bool, out: Bool,
) -> None:  # fmt: skip
    """Enter into ``out`` (n,) which of the points (n, 3) do not enter the map: moving points, points beyond the reach,
    and points higher than ``road_m`` that are too low to be obstacles, in or next to cells with moving points: wheels
    and bumpers, not road.

    ``cell`` (n,) row * cols + col of ``ground_z`` (rows, cols), -1 outside it; ``beside`` (rows * cols,): scratch, all
    False.
    """
    rows, cols = ground_z.shape
    for i in range(len(points)):
        if moving[i] and cell[i] >= 0:
            r, c = divmod(cell[i], cols)
            for k in range(max(r - 1, 0), min(r + 2, rows)):
                for j in range(max(c - 1, 0), min(c + 2, cols)):
                    beside[k * cols + j] = True
    for i in range(len(points)):
        x = points[i, 0] - origin[0]
        y = points[i, 1] - origin[1]
        out[i] = moving[i] | (x * x + y * y > reach2)
        if cell[i] >= 0 and beside[cell[i]] and not obstacle[i]:
            r, c = divmod(cell[i], cols)
            out[i] |= points[i, 2] - ground_z[r, c] > road_m


@kernel
def _counts_of(planes: U64, rows: I64, cols: I64, bits: I64, out: I64) -> None:
    """Enter into ``out`` (n, 3) the scans that hit, passed and crossed the voxels (row, col, bit) of a tile; outside
    columns ``out`` stays as it is."""
    for i in range(len(bits)):
        if 0 <= bits[i] < TOP_BIT:
            cell = planes[rows[i], cols[i]]
            out[i, 0] = count_of(cell, HIT, bits[i])
            out[i, 1] = count_of(cell, PASSES, bits[i])
            out[i, 2] = least_passed(cell, bits[i])


def mirrored(points: F64, point_map: PointMap, road: F64 | None, numbers: Cleaning = CLEANING) -> Bool:
    """(n,) which of the points (n, 3), map metres, are reflections below the ground of ``point_map``.

    ``road`` (m, 3): the road under all drives.
    """
    out = points[:, 2] - point_map.ground_under(points) < -numbers.below_m
    below = np.flatnonzero(out)
    for tile, within, cell in point_map.by_tile(points[below]):
        out[below[within]] = _unbroken(tile.ground_z, numbers)[cell]
    if road is not None and len(road):
        above_each_other = road[np.unique(crossings(road))]
        if len(above_each_other):
            below = np.flatnonzero(out)
            tree = scipy.spatial.cKDTree(above_each_other[:, :2])
            out[below] = np.isinf(tree.query(points[below, :2], distance_upper_bound=numbers.bridge_m)[0])
    return out


def _unbroken(ground_z: F32, numbers: Cleaning = CLEANING) -> Bool:
    """(rows, cols) cells around which the ground is known and has no step."""
    side = 2 * numbers.level_cells + 1
    measured = np.isfinite(ground_z)
    highest = scipy.ndimage.maximum_filter(np.where(measured, ground_z, np.inf), side, mode="nearest")
    lowest = scipy.ndimage.minimum_filter(np.where(measured, ground_z, -np.inf), side, mode="nearest")
    with np.errstate(invalid="ignore"):
        return np.asarray(highest - lowest <= numbers.below_m)


def strays(points: F64, scans: I32, driven: F64, lattice: Lattice, numbers: Cleaning = CLEANING) -> Bool:
    """(n,) which of a map's points (n, 3), one a voxel, in map metres, are no surface of their own.

    ``scans`` (n,): how many scans hit each; ``driven`` (m, 3): where all scans were taken. Places a metre apart count,
    not scans: a vehicle that waits at a light sees the same again.
    """
    places = driven[thin(driven, numbers.place_m)]
    return _hardly_hit(points, scans, places, numbers) | _spilled(points, scans, lattice, numbers)


def _hardly_hit(points: F64, scans: I32, places: F64, numbers: Cleaning) -> Bool:
    out = np.zeros(len(points), dtype=np.bool_)
    if not len(places):
        return out
    tree = scipy.spatial.cKDTree(places[:, :2])
    # Places near one point are near each other: voxels hit oftener than the largest number required are skipped.
    most = tree.query_ball_point(places[:, :2], 2.001 * numbers.near_m, return_length=True).max()
    tested = np.flatnonzero(scans < min(numbers.most_hits, numbers.hit_share * most))
    if len(tested):
        passed = tree.query_ball_point(points[tested, :2], numbers.near_m, return_length=True)
        out[tested] = scans[tested] < numbers.hit_share * passed
    return out


def _spilled(points: F64, scans: I32, lattice: Lattice, numbers: Cleaning) -> Bool:
    """(n,) which points lie just over the side of a voxel whose surface more scans hit, nearer than ``spill_m``."""
    keys = voxel_keys(points, lattice.x0, lattice.y0)
    order = np.argsort(keys)
    out = np.zeros(len(points), dtype=np.bool_)
    if not len(points):
        return out
    for axis, origin in ((0, lattice.x0), (1, lattice.y0)):
        within = (points[:, axis] - origin) % CELL_SIZE
        for sign in (-1, 1):
            wanted = keys + sign * BESIDE[axis]
            beside = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
            own_m = CELL_SIZE - within if sign > 0 else within
            other_m = within[beside] if sign > 0 else CELL_SIZE - within[beside]
            same = (keys[beside] == wanted) & (own_m + other_m < numbers.spill_m)
            out |= same & (own_m < other_m) & (scans < scans[beside])
    return out


def seen_through(counts: I64, numbers: Cleaning = CLEANING) -> Bool:
    """(n,) which voxels scans saw through, by ``counts`` (n, 3): scans that hit, passed and crossed each.

    A voxel of a standing surface can be crossed, too. So the bound is far below that of a vehicle that calls it gone.
    """
    hit = counts[:, 0]
    crossed = counts[:, 2]
    return np.asarray((crossed >= numbers.seen_through) & (hit < numbers.trail_share * (hit + crossed)))


def specks(points: F64, times: I32, lattice: Lattice, largest: int = CLEANING.largest_speck) -> Bool:
    """(n,) which of a map's obstacle points (n, 3), map metres, lie on nothing: in a group of at most ``largest``
    voxels that touch each other (26), touch no other voxel, and were hit once each.

    ``times`` (n,): how many scans hit the voxel of each point; in a map from elsewhere, how many points it holds.
    """
    keys = voxel_keys(points, lattice.x0, lattice.y0)
    table = np.zeros(1 << max(2 * len(keys), 2).bit_length(), dtype=np.int64)
    often = np.zeros(len(table), dtype=np.bool_)
    out = np.zeros(len(keys), dtype=np.bool_)
    _specks(keys, times <= 1, table, often, np.empty(largest + 1, np.int64), out)
    return out


def lone_points(tile: Tile) -> Bool:
    """(n,) which points of a tile of somebody's map are specks: an obstacle that is alone in its voxel, and whose voxel
    touches no other. Points within a voxel of the tile's edge are none: they may touch points of the next tile.

    Voxels are counted from the tile's corner: a map may hold a point 900 km away, beyond the keys of its lattice.
    """
    points = tile.points.astype(np.float64)
    inside = (points[:, :2] >= CELL_SIZE).all(axis=1) & (points[:, :2] < (TILE_CELLS - 1) * CELL_SIZE).all(axis=1)
    once = np.ones(len(points), dtype=np.int32)
    return np.asarray(inside & tile.columns[1] & specks(points, once, Lattice(0.0, 0.0), largest=1))


def without_lone_points(point_map: PointMap) -> tuple[PointMap, int]:
    """The map without its :func:`lone_points`, and how many these were. Tiles without any stay the same objects."""
    tiles = dict(point_map.tiles)
    dropped = 0
    for index, tile in point_map.tiles.items():
        lone = lone_points(tile)
        if lone.any():
            tiles[index] = tile.without(lone)
            dropped += int(lone.sum())
    return replace(point_map, tiles=tiles), dropped


@kernel
def _specks(keys: I64, once: Bool, table: I64, often: Bool, group: I64, out: Bool) -> None:
    """:func:`specks` into ``out`` (n,), by flood fill from each voxel hit ``once``, which ends as soon as the group is
    no speck. ``table``, a hash table of the voxels, and ``often``, whether a voxel of it was hit more than once:
    scratch, zeros. ``group`` (largest + 1,): scratch."""
    largest = len(group) - 1
    for i in range(len(keys)):
        slot = slot_of(keys[i], table)
        often[slot] |= not once[i] or table[slot] == keys[i]  # a second point in one voxel
        table[slot] = keys[i]
    for i in range(len(keys)):
        group[0] = keys[i]
        n = 1
        k = 0
        alone = not often[slot_of(keys[i], table)]
        while alone and k < n:
            for around in range(27):
                dx = around // 9 - 1
                dy = around // 3 % 3 - 1
                dz = around % 3 - 1
                beside = group[k] + dx * BESIDE[0] + dy * BESIDE[1] + dz * BESIDE[2]
                slot = slot_of(beside, table)
                empty_or_entered = table[slot] == 0
                for j in range(n):
                    empty_or_entered |= group[j] == beside
                if empty_or_entered:
                    continue
                if often[slot] or n == largest:
                    alone = False
                    break
                group[n] = beside
                n += 1
            k += 1
        out[i] = alone


def trails(points: F64, balance: I64, height_m: F64, lattice: Lattice, numbers: Cleaning = CLEANING) -> Bool:
    """(n,) which of the points (n, 3), one a voxel, above the ground, are trails.

    ``balance`` (n,): the scans that hit each point's voxel, less the scans whose rays passed it without a return;
    ``height_m`` (n,) over the ground, NaN if unknown. The points of an 8-connected group of cells that was passed more
    often than hit are a trail, without cells that rise to ``tall_m``: those did not drive.
    """
    if not len(points):
        return np.zeros(0, dtype=np.bool_)
    rows, cols = lattice.cells_of(points)
    width = int(cols.max()) + 1 - int(cols.min())  # one number a cell: pairs are sorted 20 times as slowly
    flat, at = np.unique((rows - rows.min()) * width + cols - cols.min(), return_inverse=True)
    top = np.full(len(flat), -np.inf)
    np.maximum.at(top, at, np.nan_to_num(height_m, nan=np.inf))
    tree = scipy.spatial.cKDTree(np.column_stack([flat // width, flat % width]))
    beside = tree.query_pairs(1.5, output_type="ndarray")
    graph = scipy.sparse.coo_matrix((np.ones(len(beside), np.bool_), tuple(beside.T)), shape=(len(flat), len(flat)))
    group = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    passed = np.bincount(group, weights=np.bincount(at, weights=balance))[group] < 0
    return np.asarray((passed & (top < numbers.tall_m))[at])
