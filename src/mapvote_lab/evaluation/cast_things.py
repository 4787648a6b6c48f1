"""Things that stood in no recorded street, as boxes of voxels, cast into its scans: rays that hit them end there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.grid import CELL_SIZE
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I64, Bool, Drive, Scan
from mapvote.matching.prepare import deskew, motion_at
from mapvote_lab.simulation.lidar import Caster
from mapvote_lab.simulation.shapes import box, cylinder, hedge, join, place, sign


@record()
@dataclass(frozen=True, slots=True)
class PlacingRule:
    """Where things are placed in a recorded street, and which rays hit them."""

    reach_m: float = 60.0
    """Things farther than this from the sensor are not cast, metres."""
    again_m: float = 0.05
    """Hits closer than this to the recorded return belong to the same surface, metres."""
    apart_m: float = 5.0
    """Least distance between the middles of two things, metres: one must not hide another, nor decide its cells."""
    path_m: tuple[float, float] = (3.5, 15.0)
    """Least and greatest distance of a thing from the path, metres."""
    along_m: float = 15.0
    """Things stand up to this far before the drive's first scan and behind its last, metres."""
    tries: int = 4000
    """Places that are tried for one thing."""
    wall_side_m: float = 4.0
    """Length of a piece of wall that is moved, metres."""
    wall_shift_m: float = 0.5
    """Distance by which a wall is set back or forward, metres."""
    around_m: float = 40.0
    """Obstacles within this of a removed car are what rays through it can meet, metres."""


PLACING = PlacingRule()


@dataclass
class Thing:
    """Something that comes or goes. Coordinates in the frame of the reference trajectory."""

    kind: str
    comes: F64
    """(n, 3, 3) triangles that scans meet after the change; none if it only goes."""
    goes: tuple[F64, F64] | None = None
    """(T (4, 4) from its own axes, half extents (3,)) of the box whose points are taken out of the scans."""
    behind: F64 = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """(n, 3, 3) triangles that the rays meet that go on through the box."""
    met: list[F64] = field(default_factory=list)
    """Where rays ended on it, (m, 3), a scan after the other."""
    left: list[F64] = field(default_factory=list)
    """Points that were taken out, (m, 3), a scan after the other."""

    @property
    def centre(self) -> F64:
        """(2,) its middle from above."""
        if self.goes is not None:
            return self.goes[0][:2, 3]
        return np.asarray(self.comes.reshape(-1, 3)[:, :2].mean(axis=0))


def with_things(drive: Drive, things: Sequence[Thing], reference: F64, rule: PlacingRule = PLACING) -> Drive:
    """The drive as it would have been recorded among ``things``; ``reference`` (n, 4, 4): where it was.

    Every scan read notes in the things where its rays ended. Scans come out de-skewed.
    """

    def read_scan(i: int) -> Scan:
        scan = drive.read_scan(i)
        T = reference[i]
        points = deskew(scan, motion_at(drive.stamps_ns, reference, i)).astype(np.float32)
        rng = np.random.default_rng([i, 2])
        keep = np.ones(len(points), dtype=np.bool_)
        at = points.copy()
        ends_on = np.full(len(points), -1)
        for k, thing in enumerate(things):
            if np.linalg.norm(thing.centre - T[:2, 3]) < rule.reach_m:
                if thing.goes is not None:
                    inside, on = _take_out(points, keep, at, thing, T, drive.sensor.range_sigma_m, rng, rule)
                    ends_on[inside] = -1
                    ends_on[on] = k
                if len(thing.comes):
                    ends_on[_put_in(points, at, thing, T, drive.sensor.range_sigma_m, rng, rule)] = k
        for k, thing in enumerate(things):
            met = keep & (ends_on == k)  # and not on a thing before it, whichever was placed first
            thing.met.append(transform(T, at[met]))
        fields = {name: values[keep] for name, values in scan.fields.items()}
        return replace(scan, points=points[keep], time_s=None, fields=fields)

    return replace(drive, read_scan=read_scan)


def _cast(triangles: F64, T: F64, directions: F32) -> F32:
    """Ranges (n,) of rays from the sensor at pose T (4, 4) to triangles (m, 3, 3) of the reference frame."""
    local = transform(inverse(T), triangles.reshape(-1, 3)).reshape(-1, 3, 3).astype(np.float32)
    caster = Caster(local, np.zeros(len(local), dtype=np.int32))
    return caster.cast(np.zeros_like(directions), directions)[0]


def _directions(points: F32) -> tuple[F32, F32]:
    reach = np.maximum(np.linalg.norm(points, axis=1), 1e-3).astype(np.float32)
    return reach, (points / reach[:, None]).astype(np.float32)


def _put_in(
    points: F32, at: F32, thing: Thing, T: F64, sigma_m: float, rng: np.random.Generator, rule: PlacingRule
) -> Bool:
    """(n,) the rays that end on the thing now; ``points`` (n, 3) and, without noise, ``at`` (n, 3) are told where."""
    reach, directions = _directions(points)
    hit = _cast(thing.comes, T, directions)
    nearer = hit < reach - rule.again_m
    at[nearer] = directions[nearer] * hit[nearer, None]
    noisy = hit[nearer] + sigma_m * rng.standard_normal(np.count_nonzero(nearer), dtype=np.float32)
    points[nearer] = directions[nearer] * noisy[:, None]
    return nearer


def _take_out(
    points: F32,
    keep: Bool,
    at: F32,
    thing: Thing,
    T: F64,
    sigma_m: float,
    rng: np.random.Generator,
    rule: PlacingRule,
) -> tuple[Bool, I64]:
    """((n,) the rays that had ended in what goes, (m,) those of them that go on to the thing itself, set back); as
    :func:`_put_in` the rest, and ``keep`` (n,) loses those that meet nothing within ``rule.reach_m``."""
    assert thing.goes is not None
    T_ref_box, half = thing.goes
    inside = keep & (np.abs(transform(inverse(T_ref_box) @ T, points)) <= half).all(axis=1)
    rays = np.flatnonzero(inside)
    if not len(rays):
        return inside, rays
    thing.left.append(transform(T, points[inside]))
    reach, directions = _directions(points[inside])
    beyond = np.full(len(reach), np.inf, dtype=np.float32)
    if len(thing.behind):
        beyond = _cast(thing.behind, T, directions)
        beyond[beyond < reach] = np.inf
    on = rays[np.isfinite(beyond)] if len(thing.comes) else rays[:0]
    at[inside] = directions * np.where(np.isfinite(beyond), beyond, 1.0)[:, None]
    beyond += sigma_m * rng.standard_normal(len(beyond), dtype=np.float32)
    keep[rays[~(beyond < rule.reach_m)]] = False
    points[inside] = directions * np.where(beyond < rule.reach_m, beyond, 1.0)[:, None]
    return inside, on


def voxel_boxes(points: F64) -> F64:
    """(12 n, 3, 3) cubes of the occupied 0.3 m voxels of points (m, 3): what stands, coarsely."""
    corners = np.unique(np.floor(points / CELL_SIZE).astype(np.int64), axis=0) * CELL_SIZE
    unit = box(0, CELL_SIZE, 0, CELL_SIZE, 0, CELL_SIZE)
    return np.asarray((corners[:, None, None, :] + unit[None]).reshape(-1, 3, 3))


SHAPES: dict[str, tuple[float, Callable[[np.random.Generator], F64]]] = {
    "pole": (0.1, lambda rng: cylinder(0.08, 0.0, 5.0, 8)),
    "sign": (0.4, lambda rng: sign(rng)),
    "bollard": (0.1, lambda rng: cylinder(0.08, 0.0, 0.9, 8)),
    "cabinet": (0.5, lambda rng: box(-0.4, 0.4, -0.2, 0.2, 0.0, 1.3)),
    "container": (1.7, lambda rng: box(-1.5, 1.5, -0.8, 0.8, 0.0, 1.6)),
    "wall": (2.1, lambda rng: box(-2.0, 2.0, -0.1, 0.1, 0.0, 2.2)),
    "wall behind a hedge": (2.3, lambda rng: box(-2.0, 2.0, 0.5, 0.7, 0.0, 2.2)),
}
"""Kind: (radius of the room it needs, its triangles (n, 3, 3) with the foot's middle at the origin), metres."""


@dataclass(frozen=True)
class Site:
    """The recorded street, in the frame of the reference trajectory."""

    obstacles: F64
    """(n, 3) points that stand above the ground, one a voxel."""
    ground: Callable[[F64], F64]
    """Height (m,) of the ground at points (m, 2); NaN where unknown."""
    path: F64
    """(k, 3) positions of the sensor."""
    rule: PlacingRule = PLACING

    def placed(self, seed: int, each: int) -> tuple[list[Thing], list[F64]]:
        """(``each`` things of every kind that find room, hedges (n, 3, 3) that stand before and after)."""
        rng = np.random.default_rng(seed)
        tree = cKDTree(self.obstacles[:, :2])
        things: list[Thing] = []
        hedges = []
        for kind, (radius, shape) in [*SHAPES.items()] * each:  # one of each before the second of any
            spot = self._room(rng, tree, radius, things)
            if spot is None:
                continue
            x, y, z, yaw = spot
            things.append(Thing(kind, place(shape(rng), x, y, z, yaw)))
            if kind == "wall behind a hedge":
                hedges.append(place(hedge(rng, 4.0, 0.5, 1.1) - np.array([2.0, 0, 0]), x, y, z, yaw))
        return things, hedges

    def _room(
        self, rng: np.random.Generator, tree: cKDTree, radius: float, taken: list[Thing]
    ) -> tuple[float, float, float, float] | None:
        """(x, y, ground, yaw) of a free place beside the path, its back turned to it; None if there is none."""
        for _ in range(self.rule.tries):
            k = int(rng.integers(1, len(self.path)))
            ahead = self.path[k, :2] - self.path[k - 1, :2]
            if np.linalg.norm(ahead) < 1e-3:
                continue
            yaw = float(np.arctan2(ahead[1], ahead[0]))
            side = rng.choice([-1.0, 1.0])
            away = rng.uniform(*self.rule.path_m)
            spot = self.path[k, :2] + side * away * np.array([-np.sin(yaw), np.cos(yaw)])
            spot = spot + rng.uniform(-self.rule.along_m, self.rule.along_m) * np.array([np.cos(yaw), np.sin(yaw)])
            z = float(self.ground(spot[None])[0])
            clear = tree.query(spot)[0] > radius + 0.6
            off_path = np.linalg.norm(self.path[:, :2] - spot, axis=1).min() > radius + 1.5
            apart = all(np.linalg.norm(thing.centre - spot) > self.rule.apart_m for thing in taken)
            if clear and off_path and apart and np.isfinite(z):
                return float(spot[0]), float(spot[1]), z, yaw if side > 0 else yaw + np.pi
        return None

    def moved_walls(self, seed: int, most: int) -> list[Thing]:
        """Pieces of real walls, 4 m long, set back and forward by 0.5 m in turn."""
        rng = np.random.default_rng([seed, 1])
        cells = np.floor(self.obstacles[:, :2] / CELL_SIZE)
        _, column, layers = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        tall = self.obstacles[layers[column.ravel()] >= 5, :2]
        tree = cKDTree(tall) if len(tall) else None
        out = list[Thing]()
        for k in rng.permutation(len(tall)):
            assert tree is not None
            near = tall[tree.query_ball_point(tall[k], 0.5 * self.rule.wall_side_m)]
            away = np.linalg.norm(self.path[:, :2] - tall[k], axis=1).min()
            if len(near) < 50 or not self.rule.path_m[0] < away < 20.0:
                continue
            middle = near.mean(axis=0)
            spread, axes = np.linalg.eigh(np.cov((near - middle).T))
            if np.sqrt(spread[0]) > 0.13 or any(np.linalg.norm(t.centre - middle) < 2 * self.rule.apart_m for t in out):
                continue
            thing = self._moved_wall(middle, axes[:, 0], "set back" if len(out) % 2 == 0 else "set forward")
            if thing is not None:
                out.append(thing)
            if len(out) == most:
                break
        return out

    def _moved_wall(self, middle: F64, normal: F64, how: str) -> Thing | None:
        toward = self.path[np.linalg.norm(self.path[:, :2] - middle, axis=1).argmin(), :2] - middle
        normal = normal if normal @ toward > 0 else -normal  # towards the path
        ground = float(self.ground(middle[None])[0])
        if not np.isfinite(ground):
            return None
        shift = self.rule.wall_shift_m * (-1.0 if how == "set back" else 1.0)
        yaw = float(np.arctan2(normal[1], normal[0]) - 0.5 * np.pi)  # y of the wall's own frame is its normal
        near = self.obstacles[np.linalg.norm(self.obstacles[:, :2] - middle, axis=1) < 0.5 * self.rule.wall_side_m]
        top = float(near[:, 2].max())
        half = 0.5 * self.rule.wall_side_m
        plane = place(
            box(-half, half, shift - 0.02, shift + 0.02, 0.0, top - ground), middle[0], middle[1], ground, yaw
        )
        T = from_xyz_rpy(middle[0], middle[1], ground + 0.5 * (top - ground) + 0.1, yaw=yaw)
        goes = T, np.array([half, 0.3, 0.5 * (top - ground)])
        return Thing(f"wall {how}", plane, goes, behind=plane if how == "set back" else np.zeros((0, 3, 3)))

    def gone_cars(self, most: int) -> list[Thing]:
        """Things of a parked car's size that stood there all along, taken away."""
        low = self.obstacles[self._heights(self.obstacles) < 2.2]
        if len(low) == 0:
            return []
        origin = np.floor(low[:, :2].min(axis=0) / CELL_SIZE) - 1
        cells = (np.floor(low[:, :2] / CELL_SIZE) - origin).astype(np.int64)
        plane = np.zeros(cells.max(axis=0) + 2, dtype=np.bool_)
        plane[cells[:, 0], cells[:, 1]] = True
        label, _ = ndimage.label(plane, np.ones((3, 3)))
        group = label[cells[:, 0], cells[:, 1]]
        out: list[Thing] = []
        for k, slices in enumerate(ndimage.find_objects(label), 1):
            if max(s.stop - s.start for s in slices) * CELL_SIZE > 7.0:
                continue
            thing = self._gone_car(low[group == k])
            if thing is not None and all(np.linalg.norm(t.centre - thing.centre) > self.rule.apart_m for t in out):
                out.append(thing)
        out.sort(key=lambda t: float(np.linalg.norm(self.path[:, :2] - t.centre, axis=1).min()))
        return out[:most]

    def _gone_car(self, points: F64) -> Thing | None:
        middle = points[:, :2].mean(axis=0)
        spread, axes = np.linalg.eigh(np.cov((points[:, :2] - middle).T)) if len(points) > 20 else (None, np.eye(2))
        local = (points[:, :2] - middle) @ axes[:, ::-1]
        low = local.min(axis=0)
        high = local.max(axis=0)
        length, width = high - low
        tall = float(self._heights(points).max())
        if spread is None or not (2.8 < length < 5.8 and 1.0 < width < 2.6 and 1.1 < tall < 2.1):
            return None
        centre = middle + axes[:, ::-1] @ (0.5 * (low + high))
        away = np.linalg.norm(self.path[:, :2] - centre, axis=1).min()
        ground = float(self.ground(centre[None])[0])
        if not (2.0 < away < 20.0 and np.isfinite(ground)):
            return None
        yaw = float(np.arctan2(axes[1, 1], axes[0, 1]))
        T = from_xyz_rpy(centre[0], centre[1], ground + GROUND_MARGIN_M + 0.5 * tall, yaw=yaw)
        half = np.array([0.5 * length + 0.2, 0.5 * width + 0.2, 0.5 * tall + 0.1])
        # Rays through the car meet the obstacles around it, or the road.
        around_m = self.rule.around_m
        near = self.obstacles[np.linalg.norm(self.obstacles[:, :2] - centre, axis=1) < around_m]
        outside = (np.abs((near - T[:3, 3]) @ T[:3, :3]) > half).any(axis=1)
        road = place(box(-around_m, around_m, -around_m, around_m, -0.05, 0.0), centre[0], centre[1], ground)
        return Thing("parked car gone", np.zeros((0, 3, 3)), (T, half), join([voxel_boxes(near[outside]), road]))

    def _heights(self, points: F64) -> F64:
        above: F64 = points[:, 2] - self.ground(points[:, :2])
        return np.where(np.isfinite(above), above, np.inf)
