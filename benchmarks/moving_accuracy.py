"""How well moving objects are found: precision and recall per obstacle point, online, and the CPU time it takes.

    python benchmarks/moving_accuracy.py street:2 paper:3          simulate (kept under --cache) and score
    python benchmarks/moving_accuracy.py street:2 --stride 2 --pose-noise 0.05
    python benchmarks/moving_accuracy.py --kitti DRIVE --pictures OUT        a real drive with tracklets.json

Poses are the true ones (with noise if asked for), so that the filter alone is scored. An obstacle point lies more
than 0.3 m above the ground measured over the whole drive. Points beyond the filter's reach count against recall.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mapvote.config import MovingSettings
from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.geometry import exp, transform
from mapvote.core.grid import Grid, Lattice
from mapvote.core.point_map import map_from_points
from mapvote.core.reference import reference_window
from mapvote.core.types import F32, F64, Bool, Drive
from mapvote.core.voxels import voxel_downsample
from mapvote.formats import open_drive
from mapvote.perception import moving_objects
from mapvote.perception.frontend import Movers
from mapvote.perception.moving_objects import MovingFilter
from mapvote_lab.evaluation.baselines.occupied_briefly import OccupiedBriefly
from mapvote_lab.simulation import simulate


@dataclass
class Score:
    """Obstacle points by truth and verdict, and seconds a scan."""

    points: int = 0
    moving: int = 0
    found: int = 0
    right: int = 0
    seconds: list[float] = field(default_factory=list)

    def add(self, truth: Bool, found: Bool) -> None:
        self.points += len(truth)
        self.moving += int(truth.sum())
        self.found += int(found.sum())
        self.right += int((truth & found).sum())

    def __iadd__(self, other: Score) -> Score:
        self.points += other.points
        self.moving += other.moving
        self.found += other.found
        self.right += other.right
        self.seconds += other.seconds
        return self

    @property
    def precision(self) -> float:
        return self.right / max(self.found, 1)

    @property
    def recall(self) -> float:
        return self.right / max(self.moving, 1)

    def row(self, name: str) -> str:
        return (
            f"{name:24} {self.points:11,} {self.moving / max(self.points, 1):7.1%} "
            f"{self.precision:9.4f} {self.recall:7.4f} "
            f"{1e3 * float(np.median(self.seconds)):6.2f}"
        )


HEADER = f"{'drive':24} {'obstacle pts':>11} {'moving':>7} {'precision':>9} {'recall':>7} {'ms':>6}"


def poses_of(path: Path) -> F64:
    """(n, 4, 4) T_map_lidar of a file of 3 x 4 rows."""
    T = np.tile(np.eye(4), (len(rows := np.loadtxt(path, ndmin=2)), 1, 1))
    T[:, :3, :] = rows.reshape(-1, 3, 4)
    return T


def measure_ground(drive: Drive, T_map_lidar: F64) -> tuple[Grid, F32]:
    """The road under the whole drive, from the points within 60 m of every second scan."""
    parts = []
    for i in range(0, len(drive), 2):
        points = drive.read_scan(i).points
        near = points[np.hypot(points[:, 0], points[:, 1]) < 60.0]
        points_map = transform(T_map_lidar[i], near)
        parts.append(points_map[voxel_downsample(points_map, 0.2)])
    points_map = np.concatenate(parts)
    lattice = Lattice()
    rows, cols = lattice.cells_of(np.array([points_map.min(axis=0), points_map.max(axis=0)]))
    grid = Grid(lattice, int(rows[0]), int(cols[0]), int(rows[1] - rows[0]) + 1, int(cols[1] - cols[0]) + 1)
    return grid, reference_window(map_from_points(points_map), grid).ground_z


def obstacles(points_map: F64, grid: Grid, ground_z: F32) -> Bool:
    """(n,) more than 0.3 m above known ground."""
    rows, cols, inside = grid.indices_of(points_map)
    out = np.zeros(len(points_map), dtype=bool)
    out[inside] = points_map[inside, 2] - ground_z[rows[inside], cols[inside]] > GROUND_MARGIN_M
    return out


def run(
    drive: Drive, T_map_lidar: F64, settings: MovingSettings | None, seconds: list[float], pose_noise_m: float = 0.0
) -> Iterator[tuple[int, F32, Bool, Bool]]:
    """(scan, its points in the lidar frame, obstacle mask, moving mask) of every scan, in order.

    ``settings`` None: by [9] read literally.
    """
    grid, ground_z = measure_ground(drive, T_map_lidar)
    rng = np.random.default_rng(0)
    movers: Movers = MovingFilter(drive.sensor, settings) if settings else OccupiedBriefly()
    kept: deque[tuple[int, F32, Bool]] = deque()
    for i in range(len(drive)):
        scan = drive.read_scan(i)
        T = T_map_lidar[i].copy()
        T[:3, :3] = exp(np.r_[0.0, 0.0, 0.0, rng.normal(size=3) * pose_noise_m / 30.0])[:3, :3] @ T[:3, :3]
        T[:3, 3] += rng.normal(size=3) * pose_noise_m
        obstacle = obstacles(transform(T_map_lidar[i], scan.points), grid, ground_z)
        kept.append((i, scan.points, obstacle))
        points_map = transform(T, scan.points)
        start = time.process_time()
        decided = movers.push(points_map, T[:3, 3], obstacle, scan.stamp_ns)
        seconds.append(time.process_time() - start)
        for moving in decided:
            yield *kept.popleft(), moving
    for moving in movers.flush():
        yield *kept.popleft(), moving


def score_simulated(folder: Path, stride: int, settings: MovingSettings | None, pose_noise_m: float) -> Score:
    """Prints a row per vehicle and the pooled one, which it returns."""
    pooled = Score()
    for path in sorted(folder.glob("v[0-9]*")):
        truth = folder / "truth" / path.name
        drive = open_drive(path, scans=f"::{stride}")
        T_map_lidar = poses_of(truth / "poses.txt")[::stride]
        score = Score()
        for i, points, obstacle, moving in run(drive, T_map_lidar, settings, score.seconds, pose_noise_m):
            labels = np.load(truth / "moving" / f"{i * stride:06d}.npy")
            if len(labels) != len(points):
                raise SystemExit(f"{path}: scan {i * stride} has {len(points)} points but {len(labels)} labels")
            score.add(labels[obstacle], moving[obstacle])
        print(score.row(f"{folder.name} {path.name}"), flush=True)
        pooled += score
    print(pooled.row(f"{folder.name} all"), flush=True)
    return pooled


def inside(points: F32, thing: dict[str, object], grow_m: float = 0.2) -> Bool:
    """(n,) points in the box of a tracklet: footprint (4+, 3) and height, in the lidar frame, grown a little."""
    corners = np.array(thing["footprint"])[:4]
    centre = corners.mean(axis=0)
    out = points[:, 2] < centre[2] + float(str(thing["height"])) + 0.3
    for edge in (corners[1] - corners[0], corners[2] - corners[1]):
        half = 0.5 * float(np.hypot(*edge[:2]))
        out &= np.abs((points[:, :2] - centre[:2]) @ edge[:2]) / (2 * half) < half + grow_m
    return out


def score_kitti(path: Path, settings: MovingSettings, pictures: Path | None) -> None:
    """Recall per tracked object and what was removed elsewhere, in front where objects were labelled and behind."""
    tracklets = path / "tracklets.json"
    frames = json.loads(tracklets.read_text()) if tracklets.exists() else []
    things = {f["frame"]: f["objects"] for f in frames}
    drive = open_drive(path)
    seconds: list[float] = []
    T_map_lidar = poses_of(path / "poses.txt")
    counts: dict[str, list[int]] = {}
    track: dict[str, list[F64]] = {}
    total = removed = elsewhere = ahead = 0
    for i, points, obstacle, moving in run(drive, T_map_lidar, settings, seconds):
        labelled = np.zeros(len(points), dtype=bool)
        for thing in things.get(i, []):
            within = inside(points, thing) & obstacle
            labelled |= within
            name = f"{thing['cls']} {thing['id'][:4]}"
            row = counts.setdefault(name, [0, 0])
            row[0] += int(within.sum())
            row[1] += int((within & moving).sum())
            centre = np.mean(np.array(thing["footprint"])[:4], axis=0)
            track.setdefault(name, []).append(transform(T_map_lidar[i], centre[None])[0])
        stray = moving & ~labelled
        view = (points[:, 0] > 0) & (np.abs(points[:, 1]) < points[:, 0] * np.tan(np.radians(40.0)))
        total += int(obstacle.sum())
        removed += int(moving.sum())
        elsewhere += int(stray.sum())
        ahead += int((stray & view).sum())
        if pictures is not None and i % 6 == 5:
            draw(points, obstacle, moving, things.get(i, []), pictures / f"{path.name}_{i:06d}.png")
    print(f"{path.name}: {total:,} obstacle points in {len(drive)} scans, {removed:,} removed")
    for name, (count, found) in sorted(counts.items()):
        way = float(np.hypot(*(track[name][-1] - track[name][0])[:2]))
        print(f"  {name:16} moved {way:5.1f} m: {count:7,} points, {found / max(count, 1):.3f} of them removed")
    print(f"  removed outside every labelled box: {elsewhere:,}, {elsewhere / total:.2%} of obstacle points;")
    print(f"  of these in the camera's view, the only part that is labelled: {ahead:,}, {ahead / total:.3%}")
    print(f"  median {1e3 * float(np.median(seconds)):.2f} ms a scan")


def draw(points: F32, obstacle: Bool, moving: Bool, things: list[dict[str, object]], path: Path) -> None:
    """One scan from above, 100 m wide: obstacles grey, moving red, labelled boxes blue."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 9))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.scatter(*points[obstacle][:, :2].T, s=0.5, c="0.6")
    axes.scatter(*points[moving][:, :2].T, s=2.0, c="red")
    for thing in things:
        axes.plot(*np.array(thing["footprint"])[:, :2].T, c="blue")
    axes.set(xlim=(-50, 50), ylim=(-50, 50), aspect="equal")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)


def with_value(settings: MovingSettings, key: str, value: float) -> MovingSettings:
    """The settings with another value; a constant is changed where it stands."""
    if not key.isupper():
        return MovingSettings.model_validate({**settings.model_dump(), key: value})
    setattr(moving_objects, key, type(getattr(moving_objects, key))(value))
    return settings


def sweep(folder: Path, stride: int, out: Path) -> None:
    """Precision and recall with every constant halved and doubled, one at a time."""
    rows = ["constant,value,precision,recall"]
    numbers = {name: value for name, value in vars(moving_objects).items() if isinstance(value, int | float)}
    for name, usual in numbers.items():
        if not name.isupper() or name == "CELL_SIZE":
            continue
        for value in (usual, usual / 2, 2 * usual):
            with_value(MovingSettings(), name, min(value, 1.0) if "SHARE" in name else value)
            score = score_simulated(folder, stride, MovingSettings(), 0.0)
            rows.append(f"{name},{getattr(moving_objects, name):g},{score.precision:.4f},{score.recall:.4f}")
        setattr(moving_objects, name, usual)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text("\n".join(rows) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help="SCENARIO:SEED, or a folder that mapvote simulate wrote")
    parser.add_argument("--cache", type=Path, default=Path("/tmp/mapvote_moving"), help="where drives are kept")
    parser.add_argument("--stride", type=int, default=1, help="use every so many scans (2 of 10 Hz is 5 Hz)")
    parser.add_argument("--sensor", help="simulate with this sensor instead of the scenario's")
    parser.add_argument(
        "--pose-noise", type=float, default=0.0, metavar="M", help="sigma of white noise, and a 30th in radians"
    )
    parser.add_argument("--kitti", type=Path, nargs="*", default=[], help="real drives with poses.txt")
    parser.add_argument("--pictures", type=Path, help="write pictures of the real drives here")
    parser.add_argument(
        "--set", nargs="*", default=[], metavar="KEY=VALUE", help="settings and constants of the filter"
    )
    parser.add_argument("--sweep", type=Path, metavar="CSV", help="half and twice of every constant, on the scenes")
    parser.add_argument("--literal", action="store_true", help="also [9] read literally, on the scenes")
    args = parser.parse_args()
    settings = MovingSettings()
    for key, value in (pair.split("=") for pair in args.set):
        settings = with_value(settings, key, float(value))
    if args.scenes:
        print(HEADER)
    for scene in args.scenes:
        folder = Path(scene)
        if not folder.is_dir():
            scenario, seed = scene.split(":")
            sensor = {"sensor": args.sensor} if args.sensor else {}
            folder = args.cache / "_".join([scenario, seed, *sensor.values()])
            if not folder.exists():
                args.cache.mkdir(parents=True, exist_ok=True)
                simulate(scenario, folder, int(seed), overrides=sensor)
        if args.sweep:
            sweep(folder, args.stride, args.sweep)
        else:
            score_simulated(folder, args.stride, settings, args.pose_noise)
            if args.literal:
                print("[9] read literally:")
                score_simulated(folder, args.stride, None, args.pose_noise)
    for path in args.kitti:
        score_kitti(path, settings, args.pictures)


if __name__ == "__main__":
    main()
