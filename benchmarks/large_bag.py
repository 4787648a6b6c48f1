"""Does the memory of the verbs that read a drive follow the size of its bag? It should not.

    python benchmarks/large_bag.py --drive DRIVE --map MAP --passes 1 4 --out results/large_bags.csv

Writes a drive as a ROS 2 bag (MCAP, 48 bytes a point as drivers of spinning sensors send them, with /odom and
/tf_static), once or several times over one after another, and runs the verbs on it as a user would. Memory is that of
the verb's processes together, sampled ten times a second.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from bag_recorder import START, Recorder
from large_map import measured, write
from mapvote.core.geometry import inverse
from mapvote.core.types import Drive, Scan
from mapvote.formats import open_drive

STEP = 48
"""Bytes of a point: x, y, z and intensity as float32, the rest is padding."""
PRIOR = ["--prior", "/odom"]
VERBS = {
    "info": ["info", "{bag}"],
    "doctor": ["doctor", "{bag}", *PRIOR],
    "vote": ["vote", "{bag}", "--map", "{map}", "--out", "{folder}/ballot", *PRIOR],
    "build": ["build", "{bag}", "--out", "{folder}/built", *PRIOR],
}


def write_bag(file: Path, drive: Drive, passes: int) -> float:
    """The drive, ``passes`` times over. Returns how large the bag is, in GB."""
    recorder = Recorder(file)
    recorder.static({"lidar": drive.T_base_lidar})
    assert drive.T_map_lidar_prior is not None
    step_ns = int(np.median(np.diff(drive.stamps_ns)))
    for k in range(passes * len(drive)):
        i, ns = k % len(drive), START + k * step_ns
        cloud(recorder, ns, drive.read_scan(i))
        odometry(recorder, ns, drive.T_map_lidar_prior[i] @ inverse(drive.T_base_lidar))
    recorder.bag.close()
    return sum(part.stat().st_size for part in file.rglob("*") if part.is_file()) / 1e9


def cloud(recorder: Recorder, ns: int, scan: Scan) -> None:
    """One PointCloud2."""
    kind, field = "sensor_msgs/msg/PointCloud2", recorder.types["sensor_msgs/msg/PointField"]
    rows = np.zeros((len(scan.points), STEP // 4), dtype="<f4")
    rows[:, :3] = scan.points
    if scan.intensity is not None:
        rows[:, 3] = scan.intensity
    fields = [field(name, 4 * i, 7, 1) for i, name in enumerate(("x", "y", "z", "intensity"))]
    n, raw = len(rows), rows.view(np.uint8).ravel()
    message = recorder.types[kind](recorder.header(ns, "lidar"), 1, n, fields, False, STEP, STEP * n, raw, True)
    recorder.write("/points", kind, ns, message)


def odometry(recorder: Recorder, ns: int, T_map_base: np.ndarray) -> None:
    """One Odometry."""
    g, types = "geometry_msgs/msg/", recorder.types
    q = types[g + "Quaternion"](*Rotation.from_matrix(T_map_base[:3, :3]).as_quat().tolist())
    pose = types[g + "PoseWithCovariance"](types[g + "Pose"](types[g + "Point"](*T_map_base[:3, 3]), q), np.zeros(36))
    still = types[g + "TwistWithCovariance"](
        types[g + "Twist"](types[g + "Vector3"](0, 0, 0), types[g + "Vector3"](0, 0, 0)), np.zeros(36)
    )
    kind = "nav_msgs/msg/Odometry"
    recorder.write("/odom", kind, ns, types[kind](recorder.header(ns, "map"), "base_link", pose, still))


def main() -> None:
    """Parse and run."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--drive", required=True, type=Path)
    asked.add_argument("--map", required=True, type=Path, help="of the same street")
    asked.add_argument("--passes", type=int, nargs="+", default=[1, 4])
    asked.add_argument("--verbs", default="info,doctor,vote", help=f"of {', '.join(VERBS)}")
    asked.add_argument("--out", type=Path, help="CSV; rows of the same size and verb replace older ones")
    asked.add_argument("--scratch", type=Path, help="where there is room for the bags")
    options = asked.parse_args()
    drive = open_drive(options.drive)
    for passes in options.passes:
        with tempfile.TemporaryDirectory(dir=options.scratch) as name:
            places = {"bag": Path(name) / "bag", "folder": Path(name), "map": options.map}
            size = write_bag(places["bag"], drive, passes)
            for verb in options.verbs.split(","):
                memory, cpu_s, clock_s, code = measured([part.format(**places) for part in VERBS[verb]])
                row = {"bag_gb": f"{size:.2f}", "scans": str(passes * len(drive)), "verb": verb, "exit": str(code)}
                row |= {"memory_mb": f"{memory:.0f}", "cpu_s": f"{cpu_s:.0f}", "clock_s": f"{clock_s:.0f}"}
                print(row, flush=True)
                if options.out:
                    write(options.out, row, ("bag_gb", "verb"))


if __name__ == "__main__":
    main()
