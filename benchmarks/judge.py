"""Every scan of a drive through our vehicle, through that of another checkout, and through peers: in turn, on one core.

    python benchmarks/judge.py OUT --street street:2 --kitti ../shared/data/kitti/* [--last N]
        [--source OTHER/src --python OTHER/.venv/bin/python]... [--against REV]

Times are CPU time, so that a busy neighbour counts little. Ours is everything that ``Vehicle.observe`` does, moving
windows and first looks included. A first drive compiles; of the judged one the first WARM_UP scans do not count. Peers
run where they are installed (extra ``bench``), each as its documentation advises, on one thread: VGICP of small_gicp
localises, dufomap finds what moves. They get what favours them: points de-skewed with the true motion, targets made
outside the clock. Open3D's cloud-to-cloud distances, both ways, find what changed. *whole chain* is the sum of the
peers. Poses are compared with the truth, each trajectory laid on it as a whole. A KITTI map is made of every second
scan, and its truth is odometry. Drives and maps are kept in OUT. Each checkout makes its map by its own ``build``.

``--against REV`` fails where our whole scan costs a tenth more than that of a revision, in the mean without the dearest
twentieth of the scans, which the machine may have stopped. Both have the same peers in the same run, so that the ratio
of their ratios to a peer is the ratio of the two. The revision has our interpreter and our map. It fails only where
RUNS runs say so, each with new processes: beside other work one run in CI gave 1.15 for two commits with equal kernels.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import json
import subprocess
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from mapvote.core.geometry import inverse, transform
from mapvote.core.point_map import all_points
from mapvote.core.types import F32, F64, Drive, MapvoteError
from mapvote.formats import open_drive, read_map, read_T_map_lidar
from mapvote.matching.prepare import deskew, motion_at

WARM_UP = 25
"""Scans: the first leaves for the voter after some fifteen."""
LOOK_AHEAD = 10
"""Scans in a second: how late a peer says what moves, as we do."""
VEHICLE = Path(__file__).parent / "judged_vehicle.py"
LOST_M = 1.0
STAGES_OF = {"see + vote": ("see", "vote"), "whole chain": ("whole scan",)}
"""Our stages beside that of a peer, where they are not one of the same name."""
VOXEL_M = 0.2
"""dufomap: at its usual 0.1 m a 32-beam scan hardly ever makes a voxel void."""
AROUND_M = 40.0
"""Half of the square around the sensor in which clouds are compared, as large as our window."""
MOST_OF_REV = 1.1
"""Ratio of our whole scan to that of the revision, from which --against fails."""
RUNS = 3
"""How often --against asks at most."""
COUNTED = 0.95
"""Share of the scans, the cheapest, whose mean is compared."""
Checkout = tuple[Path, Path]
"""A source tree, and the interpreter that has its dependencies."""
Times = dict[tuple[str, str], F64]
"""CPU milliseconds of each scan by side and stage."""
Clock = Callable[[str, Callable[[], Any]], Any]
"""Runs something and adds its CPU time to a stage."""


class Watched:
    """A process of judged_vehicle.py, with the source tree and the interpreter of a checkout."""

    def __init__(self, checkout: Checkout, drive: Path, map_path: Path) -> None:
        src, python = checkout
        command = [str(python), str(VEHICLE), str(drive), str(map_path), str(WARM_UP)]
        environment = environment_of(src)
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.process = subprocess.Popen(command, env=environment, text=True, **pipes)  # type: ignore[call-overload]
        assert self.process.stdout.readline() == "ready\n"

    def ask(self, what: str) -> Any:
        """Its answer to a line."""
        self.process.stdin.write(f"{what}\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


def environment_of(src: Path) -> dict[str, str]:
    """The environment of a process that runs a source tree."""
    return {**os.environ, "PYTHONPATH": str(src)}


def name_of(src: Path) -> str:
    """The commit of a source tree, or the name of its folder where it has none."""
    command = ["git", "-C", str(src), "rev-parse", "--short=8", "HEAD"]
    told = subprocess.run(command, capture_output=True, text=True, check=False)
    return told.stdout.strip() or src.resolve().parent.name


def tree_of(rev: str, out: Path) -> Path:
    """The source tree of a revision of this repository, in ``out``. MapvoteError if this clone lacks it."""
    git = ["git", "-C", str(Path(__file__).parents[1])]
    if subprocess.run([*git, "cat-file", "-e", f"{rev}^{{commit}}"], capture_output=True, check=False).returncode:
        raise MapvoteError(f"{rev} is not in this clone; git fetch --unshallow brings the history of a shallow one")
    folder = out / f"at_{rev}"
    if not folder.exists():
        packed = subprocess.run([*git, "archive", rev, "src"], capture_output=True, check=True).stdout
        folder.mkdir(parents=True)
        subprocess.run(["tar", "-x", "-C", str(folder)], input=packed, check=True)
    return folder / "src"


def times_of_rev(ms: Times, rev: str) -> float:
    """How many times the whole scan of a revision costs ours takes, by the scans that count."""
    ours, theirs = (np.sort(ms[side, "whole scan"][WARM_UP:]) for side in ("ours", rev))
    counted = round(COUNTED * len(ours))
    return float(ours[:counted].mean() / theirs[:counted].mean())


def build(checkout: Checkout, surveys: Sequence[str], map_path: Path) -> None:
    """Make a map by the command line of a checkout, unless it is there: formats of maps differ between commits."""
    src, python = checkout
    if not map_path.exists():
        command = [str(python), "-m", "mapvote", "build", *surveys, "--out", str(map_path)]
        subprocess.run(command, env=environment_of(src), check=True, stdout=subprocess.DEVNULL)


class Vgicp:
    """Tracks with a perfect odometry: 0.5 m down-sampling, covariances of 10 neighbours, 1 m voxels.

    Each guess is its last pose moved on by the true motion since: by constant velocity it was lost on 20 of 70 scans of
    ``street`` 2. It begins at the true pose, and anew from it where it is more than LOST_M off.
    """

    def __init__(self, gicp: ModuleType, map_points: F64, T_true: F64) -> None:
        self.gicp, self.T_true, self.lost, self.poses = gicp, T_true, 0, list[F64]()
        self.middle = map_points.mean(axis=0)  # its voxels hold float32 offsets
        self.target = gicp.GaussianVoxelMap(1.0)
        self.target.insert(self._prepared(map_points - self.middle, 0.3))

    def _prepared(self, points: F64, size: float) -> Any:
        return self.gicp.preprocess_points(points, downsampling_resolution=size, num_neighbors=10, num_threads=1)[0]

    def __call__(self, points: F32, clock: Clock) -> None:
        i = len(self.poses)
        guess = self.T_true[i].copy() if i < 1 else self.poses[-1] @ inverse(self.T_true[i - 1]) @ self.T_true[i]
        guess[:3, 3] -= self.middle
        cloud = points.astype(np.float64)
        T = clock("localise", lambda: self._align(cloud, guess)).copy()
        T[:3, 3] += self.middle
        if not np.linalg.norm((T - self.T_true[i])[:3, 3]) < LOST_M:
            T, self.lost = self.T_true[i], self.lost + 1
        self.poses.append(T)

    def _align(self, cloud: F64, guess: F64) -> F64:
        source = self._prepared(cloud, 0.5)
        found = self.gicp.align(self.target, source, guess, num_threads=1, max_iterations=30)
        return np.asarray(found.T_target_source)


class Dufomap:
    """Decides a scan as late as we do, by true poses."""

    def __init__(self, module: ModuleType, T_true: F64) -> None:
        self.dufo, self.T_true, self.done = module.dufomap(VOXEL_M, VOXEL_M, 1, num_threads=1), T_true, 0
        self.waiting: deque[tuple[F32, F64]] = deque()

    def __call__(self, points: F32, clock: Clock) -> None:
        T, self.done = self.T_true[self.done], self.done + 1
        self.waiting.append((points, T))
        clock("moving", lambda: self.dufo.run(points, T, True))
        if len(self.waiting) > LOOK_AHEAD:
            scan = self.waiting.popleft()
            clock("moving", lambda: self.dufo.segment(*scan, True))


class CloudToCloud:
    """Distances both ways between each scan, at its true pose, and the map's points around it."""

    def __init__(self, module: ModuleType, map_points: F64, T_true: F64) -> None:
        self.o3d = module
        self.map_points = map_points
        self.T_true = T_true
        self.done = 0

    def __call__(self, points: F32, clock: Clock) -> None:
        T = self.T_true[self.done]
        self.done += 1
        scan, near = (
            self._cloud(cloud[np.abs(cloud[:, :2] - T[:2, 3]).max(axis=1) < AROUND_M])
            for cloud in (transform(T, points), self.map_points)
        )
        clock("see + vote", lambda: (scan.compute_point_cloud_distance(near), near.compute_point_cloud_distance(scan)))

    def _cloud(self, points: F64) -> Any:
        return self.o3d.geometry.PointCloud(self.o3d.utility.Vector3dVector(points))


Peer = Vgicp | Dufomap | CloudToCloud


def peers_of(map_points: F64, T_true: F64) -> dict[str, Peer]:
    """The peers that are installed."""
    peers: dict[str, Peer] = {}
    if find_spec("small_gicp"):
        peers["VGICP"] = Vgicp(import_module("small_gicp"), map_points, T_true)
    if find_spec("dufomap"):
        peers["dufomap"] = Dufomap(import_module("dufomap"), T_true)
    if find_spec("open3d"):
        peers["Open3D"] = CloudToCloud(import_module("open3d"), map_points, T_true)
    return peers


def judge(
    out: Path, drive: Drive, maps: dict[str, Path], T_true: F64, checkouts: dict[str, Checkout], last: int | None
) -> tuple[Times, str]:
    """Rows of the table: CPU milliseconds of each side and stage, and how far its poses are off."""
    count = min(len(drive), last or len(drive))
    peers = peers_of(all_points(read_map(maps["ours"])), T_true)
    watched = {name: Watched(checkout, drive.path, maps[name]) for name, checkout in checkouts.items()}
    ms: Times = defaultdict(lambda: np.zeros(count))
    order = np.random.default_rng(0)

    def ours(name: str, i: int) -> None:
        for stage, took in watched[name].ask(str(i)).items():
            ms[name, stage][i] = took

    def theirs(name: str, peer: Peer, points: F32, i: int) -> None:
        def clock(stage: str, work: Callable[[], Any]) -> Any:
            start = time.process_time()
            result = work()
            ms[name, stage][i] += 1e3 * (time.process_time() - start)
            return result

        peer(points, clock)

    for i in range(count):
        points = deskew(drive.read_scan(i), motion_at(drive.stamps_ns, T_true, i))
        turns = [partial(ours, name, i) for name in watched]
        turns += [partial(theirs, name, peer, points, i) for name, peer in peers.items()]
        for k in order.permutation(len(turns)):  # who comes after a peer finds the caches cold
            turns[k]()
    chain = [took for (name, _), took in ms.items() if name in peers]
    if chain:
        ms[" + ".join(peers), "whole chain"] = np.sum(chain, axis=0)
    poses = {name: (out / f"{name}.npy", one.ask(str(out / f"{name}.npy"))) for name, one in watched.items()}
    found = {name: (np.load(path), lost) for name, (path, lost) in poses.items()}
    found |= {name: (np.array(peer.poses), peer.lost) for name, peer in peers.items() if isinstance(peer, Vgicp)}
    return ms, "\n".join([*rows_of(drive.path.name, ms), *pose_rows_of(drive.path.name, found, T_true)])


def rows_of(drive: str, ms: Times) -> list[str]:
    """Rows of the table: CPU milliseconds of each side and stage, and their ratio to ours in the same stage."""
    rows = []
    for (name, stage), took in ms.items():
        kept = took[WARM_UP:]
        beside = [ms["ours", part] for part in STAGES_OF.get(stage, (stage,))]
        own = np.sum(beside, axis=0)[WARM_UP:]
        rows.append(
            f"| {drive} | {stage} | {name} | {np.median(kept):.2f} / {kept.mean():.2f} / {kept.max():.1f} "
            f"| {kept.mean() / own.mean():.3f} |"
        )
    return rows


def pose_rows_of(drive: str, found: dict[str, tuple[F64, int]], T_true: F64) -> list[str]:
    """Rows of the table: how far the poses of each side are off."""
    from mapvote_lab.evaluation.truths import error_summary, rigid_between

    rows = []
    for name, (T, lost) in found.items():
        errors = error_summary(T, rigid_between(T, T_true[: len(T)]) @ T_true[: len(T)])
        off = f"{errors.median_m:.4f} / {errors.max_m:.4f} m"
        rows.append(f"| {drive} | poses off by | {name} | {off} | {lost} lost |")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--street", action="append", default=[], metavar="SCENARIO:SEED[:SENSOR]")
    parser.add_argument("--kitti", type=Path, nargs="*", default=[], metavar="DRIVE")
    parser.add_argument("--source", type=Path, action="append", default=[], metavar="OTHER/src", help="to compare with")
    parser.add_argument(
        "--python", type=Path, action="append", default=[], metavar="OTHER/bin/python",
        help="the interpreter of the source beside which it stands; by default this one",
    )  # fmt: skip
    parser.add_argument("--against", metavar="REV", help="fail where a scan costs a tenth more than at this revision")
    parser.add_argument("--last", type=int, metavar="N", help="stop each drive after so many scans")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    own = Path(sys.executable)
    checkouts = {"ours": (Path(__file__).parents[1] / "src", own)}
    checkouts |= {name_of(src): (src, python) for src, python in zip_longest(options.source, options.python)}
    checkouts = {name: (src, python or own) for name, (src, python) in checkouts.items()}
    if options.against:
        checkouts[options.against] = tree_of(options.against, options.out), own
    dearer = False
    print("| drive | stage | side | CPU ms: median / mean / worst | times ours, means |\n|---|---|---|---|---|")

    def judged(name: str, folder: Path, surveys: list[str], poses: Path) -> None:
        nonlocal dearer
        maps = {side: options.out / f"map_{name}_{side}" for side in checkouts if side != options.against}
        maps |= {options.against: maps["ours"]} if options.against else {}
        for side, checkout in checkouts.items():
            build(checkout, surveys, maps[side])
        T_true = read_T_map_lidar(poses, folder)
        for _ in range(RUNS):
            ms, table = judge(options.out, open_drive(folder), maps, T_true, checkouts, options.last)
            print(table, flush=True)
            if not options.against:
                return
            times = times_of_rev(ms, options.against)
            print(f"whole scan: {times:.3f} times that of {options.against}; at most {MOST_OF_REV}", flush=True)
            if times <= MOST_OF_REV:
                return
        dearer = True

    for scene in options.street:
        from mapvote_lab.simulation import simulate

        scenario, seed, *sensor = scene.split(":")
        folder = options.out / scene.replace(":", "_")
        if not folder.exists():
            simulate(scenario, folder, int(seed), overrides={"sensor": sensor[0]} if sensor else {})
        surveys = [str(one) for one in sorted(folder.glob("survey_*"))]
        judged(folder.name, folder / "v1", surveys, folder / "truth" / "v1" / "poses.txt")
    for folder in options.kitti:
        if not (folder / "poses.txt").is_file():
            raise MapvoteError(f"{folder} has no poses.txt")
        judged(folder.name, folder, [str(folder), "--scans", "::2"], folder / "poses.txt")
    sys.exit(1 if dearer else 0)


if __name__ == "__main__":
    try:
        main()
    except MapvoteError as error:
        sys.exit(f"error: {error}")
