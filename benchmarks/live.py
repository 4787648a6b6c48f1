"""Resources of a live vehicle. Real DDS between processes, on loopback.

    python benchmarks/live.py drive DRIVE MAP --rate 1   # share of scans that voted, latency from sending to vote
    python benchmarks/live.py kills DRIVE MAP --kills 50 # kill -9 at random moments, in half of them without a server
    python benchmarks/live.py priors DRIVE MAP           # scans that vote by each kind of prior, without DDS
    python benchmarks/live.py packets DRIVE MAP          # the same on a bag of tenths of revolutions
    python benchmarks/live.py lidars DRIVE MAP           # CPU of two LiDARs against one with the same points, from bags

DRIVE is one that ``mapvote simulate`` wrote, MAP what ``mapvote build`` made of its surveys. For kills the drive goes
round and round with stamps that go on; at the end of a lap the vehicle leaps back to the start, where some scans are
lost.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import socket
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F64, I64, Bool, Drive, PosePrior, Scan
from mapvote.formats import open_drive, read_map
from mapvote.formats.drives.fixes import Fixes, fixes_of, prior_at
from mapvote.formats.drives.frames import BASE_FRAME
from mapvote.formats.drives.ros_types import CLOUD, ODOMETRY
from mapvote.formats.drives.trajectory import read_poses
from mapvote.formats.geo.frame import MapFrame
from mapvote.live.dds import Network
from mapvote.live.play import cloud_message, odometry_message, opened
from mapvote.vehicle import Vehicle, vote_drive

sys.path[0] = str(Path(__file__).parents[1] / "tests")  # instead of this folder, whose live.py would hide tests/live
from bag_recorder import Recorder  # noqa: E402
from live.loopback_dds import LOOPBACK, own_domain  # noqa: E402
from live_server import mapvote  # noqa: E402
from odometry_errors import odometry  # noqa: E402

OWN_FRAME = from_xyz_rpy(100.0, 50.0, 0.0, 0.0, 0.0, 0.6)


def laps(domain: int, drive: str, shown: Path) -> None:
    """The other process: the drive round and round, and the stamp of the last scan in a file."""
    network, messages = Network(domain), list(opened(Path(drive))[1]())
    out = {m.topic: network.publish(m.topic, m.kind, transient_local=m.topic == "/tf_static") for m in messages}
    first = messages[0].time_ns
    lap_ns, start, k = messages[-1].time_ns - first + 100_000_000, time.monotonic(), 0
    while True:
        for message in messages:
            shift_ns = k * lap_ns
            time.sleep(max(0.0, start + 1e-9 * (message.time_ns - first + shift_ns) - time.monotonic()))
            stamp_ns, data = message.time_ns + shift_ns, bytearray(message.data)
            if message.topic != "/tf_static":
                data[4:12] = struct.pack("<II", *divmod(stamp_ns, 10**9))
                shown.write_text(str(stamp_ns))
            elif k:
                continue
            out[message.topic].send(bytes(data))
        k += 1


def last_stamp(shown: Path) -> int:
    """That of the last scan sent, once there is one."""
    while not (shown.exists() and (text := shown.read_text())):
        time.sleep(0.05)
    return int(text)


class Server:
    """mapvote serve, which can be taken away and brought back."""

    def __init__(self, home: Path, map_path: str) -> None:
        with socket.socket() as one:
            one.bind(("127.0.0.1", 0))
            self.port = one.getsockname()[1]
        self.home, self.map_path = home, map_path
        self.start()

    def start(self) -> None:
        new = [] if (self.home / "fleet.db").exists() else ["--map", self.map_path]
        command = ["serve", self.home / "fleet.db", *new, "--open", "--port", self.port]
        self.process = subprocess.Popen(mapvote(*command), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait()

    def ballots(self) -> list[tuple[str, int, int]]:
        """(drive, first stamp, last stamp) of every ballot that was ever taken."""
        with sqlite3.connect(self.home / "fleet.db") as database:
            return database.execute("select drive, start_ns, end_ns from ballots order by start_ns").fetchall()


def kills(drive: str, map_path: str, n: int, within_s: tuple[float, float]) -> None:
    """Kill a live drive n times, each ``within_s`` seconds after its start, and count what is missing and what came
    twice. Exit code 1 if a ballot is, or more than 30 s of road."""
    home, chance = Path(tempfile.mkdtemp()), random.Random(4)
    os.environ |= {"CYCLONEDDS_URI": LOOPBACK, "XDG_CACHE_HOME": str(home / "cache"), "PYTHONUNBUFFERED": "1"}
    domain, server, shown, log = own_domain(), Server(home, map_path), home / "stamp", home / "log"
    sender = subprocess.Popen(
        [sys.executable, __file__, "laps", drive, str(shown), "--domain", str(domain)], start_new_session=True
    )
    url = f"http://127.0.0.1:{server.port}"
    options = ["--map", map_path, "--send", url, "--vehicle", "car", "--name", "day", "--every-m", 150]
    # Each lap begins with a leap back to the start, for which the check of places would keep its ballot.
    command = mapvote("drive", *options, "--domain", domain, "--sensor", "hdl32e", "--unchecked")
    killed_ns = []
    """(stamp when it began to listen, stamp when it was killed) of each."""
    with log.open("w") as out:
        for k in range(n + 1):
            process = subprocess.Popen(command, stdout=out, stderr=out)
            said = log.read_text().count("listening")
            while log.read_text().count("listening") == said:
                assert process.poll() is None, log.read_text()
                time.sleep(0.2)
            began_ns, away = last_stamp(shown), k % 2 == 1 and k < n
            if away:
                server.stop()
            time.sleep(chance.uniform(*within_s) if k < n else 20.0)
            if k < n:
                process.kill()
                killed_ns.append((began_ns, last_stamp(shown)))
            else:
                process.terminate()
            process.wait()
            if away:
                server.start()
    sender.kill()
    server.stop()
    told = log.read_text()
    closed = set(re.findall(r"(day-\d+): \d+ of \d+ scans voted", told)) | set(
        re.findall(r"(day-\d+): was cut off", told)
    )
    ballots = server.ballots()
    lost = closed - {name for name, _, _ in ballots}
    twice = len(ballots) - len({name for name, _, _ in ballots})
    shared = sum(b[1] <= a[2] for a, b in pairwise(ballots))
    gaps = [1e-9 * (at - max([began, *(end for _, _, end in ballots if end <= at)])) for began, at in killed_ns]
    print(f"{n} kills, the server away in {n // 2}: {len(ballots)} ballots, {len(closed)} said to be closed")
    print(f"{len(lost)} lost, {twice} twice, {shared} share scans with the next")
    print(f"road missing at a kill: median {np.median(gaps):.1f} s, at most {max(gaps):.1f} s ({log})")
    sys.exit(bool(lost or twice or not ballots or max(gaps) > 30.0))


def play_and_drive(drive: str, map_path: str, rate: float, sensor: str, core: str) -> None:
    """Two processes, as the two terminals of docs/live.md; ``core``: the one that drive has, "" for any."""
    home = Path(tempfile.mkdtemp())
    os.environ |= {"CYCLONEDDS_URI": LOOPBACK, "XDG_CACHE_HOME": str(home)}
    domain = own_domain()
    player = subprocess.Popen(mapvote("play", drive, "--rate", rate, "--domain", domain), stdout=subprocess.DEVNULL)
    options = ["--map", map_path, "--out", home, "--vehicle", "car", "--sensor", sensor, "--idle", 20]
    before = os.times()
    command = (["taskset", "-c", core] if core else []) + mapvote("drive", *options, "--domain", domain)
    result = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    after = os.times()
    player.wait()
    print(result.stdout.splitlines()[-1])
    print(f"CPU of drive: {after.children_user - before.children_user:.1f} s user, start and kernels included")


@dataclass(frozen=True)
class Receiver:
    """A satellite receiver at 1 Hz. Its heights count from an ellipsoid 40 m below the map's."""

    sigma_m: float = 2.0
    lasting_s: float = 0.0
    """Time for which an error lasts; 0: errors are independent."""
    outliers: float = 0.0
    """Share of the fixes that are 20 m off beside."""
    late_s: float = 0.0
    """Time of the first fix."""
    off_m: float = 0.0
    """Error to the east that stays."""

    def fixes(self, poses: F64, stamps_ns: I64) -> Fixes:
        """Fixes of every tenth of the poses (n, 4, 4) at 10 Hz, which state ``sigma_m``."""
        rng = np.random.default_rng(0)
        noise = rng.normal(0.0, 1.0, (len(poses), 3))
        if self.lasting_s:
            weights = np.exp(-np.arange(0.0, 5.0 * self.lasting_s, 0.1) / self.lasting_s)
            longer = np.concatenate([rng.normal(0.0, 1.0, (len(weights) - 1, 3)), noise])
            noise = np.column_stack([np.convolve(axis, weights, "valid") for axis in longer.T])
            noise /= np.sqrt((weights**2).sum())
        noise *= self.sigma_m
        wrong = rng.random(len(poses)) < self.outliers
        noise[wrong] += rng.normal(0.0, 20.0, (int(wrong.sum()), 3))
        chosen = np.arange(0, len(poses), 10)
        chosen = chosen[stamps_ns[chosen] - stamps_ns[0] >= self.late_s * 1e9]
        frame = MapFrame("EPSG:32632", (457_000.0, 5_428_000.0, 0.0))
        lonlat = frame.to_lonlat(poses[:, :3, 3] + noise + [self.off_m, 0.0, 40.0])
        covariances = np.tile(np.diag([self.sigma_m**2] * 3).ravel(), (len(poses), 1))
        return fixes_of(stamps_ns[chosen], lonlat[chosen], covariances[chosen], frame)


RECEIVERS = {
    "GNSS, 2 m, 1 Hz": Receiver(),
    "the same, first fix after 15 s": Receiver(late_s=15.0),
    "the same, a fifth of them 20 m off": Receiver(outliers=0.2),
    "GNSS, 3 m, errors that last 20 s": Receiver(sigma_m=3.0, lasting_s=20.0),
    "GNSS, 10 m": Receiver(sigma_m=10.0),
    "GNSS, 2 m stated, all of them 15 m off": Receiver(off_m=15.0),
}


def priors(drive_path: str, map_path: str) -> None:
    """Scans that vote, and the largest error of those, by odometry in a frame of its own, without a prior and by
    satellite fixes."""
    drive = open_drive(Path(drive_path))
    point_map = read_map(Path(map_path))
    poses = read_poses(Path(drive_path).parent / "truth" / Path(drive_path).name / "poses.txt")
    kinds: dict[str, list[F64 | PosePrior | None]] = {
        "odometry turned and shifted, drifting by 2 %": list(odometry(poses, OWN_FRAME @ poses[0], drift=0.02)),
        "no prior": [None] * len(drive),
    }
    for name, receiver in RECEIVERS.items():
        fixes = receiver.fixes(poses, drive.stamps_ns)
        kinds[name] = [prior_at(fixes, int(stamp_ns), np.eye(4)) for stamp_ns in drive.stamps_ns]
    for name, told in kinds.items():
        vehicle = Vehicle("car", drive.sensor, point_map)
        if name.startswith("odometry"):
            vehicle.expect_own_frame()
        start_s = time.process_time()
        for i, prior in enumerate(told):
            vehicle.observe(drive.read_scan(i), prior)
        vehicle.finish()
        report = vehicle.report
        voted = np.setdiff1d(np.arange(len(drive)), report.lost)
        off_m = np.linalg.norm(np.array(report.T_map_lidar)[voted, :3, 3] - poses[voted, :3, 3], axis=1)
        misfit_m = report.prior_misfit_m()
        told_misfit = "" if misfit_m is None else f"; off the prior by {misfit_m:.3f} m (median)"
        print(
            f"{name}: {len(voted)} of {len(drive)} scans voted, at most {off_m.max(initial=0.0):.3f} m off the truth"
            f"{told_misfit}; {time.process_time() - start_s:.0f} s of CPU",
            flush=True,
        )


def packets(drive_path: str, map_path: str) -> None:
    """Scans that vote on a bag in which each revolution is ten clouds, as some drivers publish them."""
    drive = open_drive(Path(drive_path))
    assert drive.T_map_lidar_prior is not None
    with tempfile.TemporaryDirectory() as home:
        bag = Recorder(Path(home) / "bag")
        for i, scan in enumerate(drive):
            assert scan.time_s is not None
            bag.write_raw("/odom", ODOMETRY, scan.stamp_ns, odometry_message(scan.stamp_ns, drive.T_map_lidar_prior[i]))
            first_s = float(scan.time_s.min())
            tenth = np.clip(((scan.time_s - first_s) * 100.0).astype(np.int64), 0, 9)
            for k in np.unique(tenth).tolist():
                part = tenth == k
                begin_s = first_s + 0.01 * k
                ns = scan.stamp_ns + round(begin_s * 1e9)
                fields = {name: values[part] for name, values in scan.fields.items()}
                ring = None if scan.ring is None else scan.ring[part]
                packet = Scan(ns, scan.points[part], scan.time_s[part] - np.float32(begin_s), fields, ring)
                bag.write_raw("/points", CLOUD, ns, cloud_message(packet, BASE_FRAME))
        bag.bag.close()
        recorded = open_drive(Path(home) / "bag", as_live=True)
        _, report = vote_drive(recorded, read_map(Path(map_path)))
    voted = report.scans - len(report.lost)
    print(f"packets of a tenth in a bag: {voted} of {report.scans} revolutions voted ({len(drive)} were recorded)")


@dataclass(frozen=True)
class LidarPair:
    """Two LiDARs that share the points of one."""

    phase_s: float = 0.0
    """By how much the second one's clouds begin later."""
    yaw_rad: float = 0.0
    """How the second one is turned on the vehicle."""
    lost: int = 0
    """Each cloud of the second one whose number is a multiple of this is lost; 0: none."""
    first_until: float = 1.0
    """The share of the drive after which the first one is silent."""


LIDAR_PAIRS = {
    "in phase": LidarPair(),
    "13 ms later, turned by 180 deg": LidarPair(0.013, np.pi),
    "50 ms later": LidarPair(0.05),
    "90 ms later": LidarPair(0.09),
    "50 ms later, each third cloud of the second lost": LidarPair(0.05, lost=3),
    "13 ms later, the first silent after a half": LidarPair(0.013, first_until=0.5),
}


def record_lidars(path: Path, drive: Drive, pair: LidarPair | None) -> Path:
    """A bag of the drive by one LiDAR, or by a pair of which each has every second point."""
    assert drive.T_map_lidar_prior is not None
    bag = Recorder(path)
    T_first_second = from_xyz_rpy(0.0, 0.0, 0.0, 0.0, 0.0, 0.0 if pair is None else pair.yaw_rad)
    bag.static({BASE_FRAME: np.eye(4), "second": T_first_second})
    end: Scan | None = None
    for i, scan in enumerate(drive):
        ns = scan.stamp_ns
        bag.write_raw("/odom", ODOMETRY, ns, odometry_message(ns, drive.T_map_lidar_prior[i]))
        if pair is None:
            bag.write_raw("/points", CLOUD, ns, cloud_message(scan, BASE_FRAME))
            continue
        assert scan.time_s is not None
        second = np.arange(len(scan.points)) % 2 == 1
        if i < pair.first_until * len(drive):
            bag.write_raw("/points", CLOUD, ns, cloud_message(chosen_points(scan, ~second), BASE_FRAME))
        begun = scan.time_s - scan.time_s.min() < pair.phase_s
        if end is not None and not (pair.lost and i % pair.lost == 0):
            _write_second(bag, end, chosen_points(scan, second & begun), pair)
        end = chosen_points(scan, second & ~begun)
    bag.bag.close()
    return path


def chosen_points(scan: Scan, chosen: Bool) -> Scan:
    """The scan with the ``chosen`` points (n,) alone."""
    assert scan.time_s is not None
    fields = {name: values[chosen] for name, values in scan.fields.items()}
    return Scan(scan.stamp_ns, scan.points[chosen], scan.time_s[chosen], fields)


def _write_second(bag: Recorder, end: Scan, begin: Scan, pair: LidarPair) -> None:
    """One cloud of the second LiDAR: the end of one revolution of the first and the begin of the next one."""
    scan = replace(Scan.sweep(end.stamp_ns, [end, begin]), others=())
    assert scan.time_s is not None
    late_ns = round(1e9 * pair.phase_s)
    R = from_xyz_rpy(0.0, 0.0, 0.0, 0.0, 0.0, -pair.yaw_rad)[:3, :3].astype(np.float32)
    time_s = scan.time_s - np.float32(pair.phase_s)
    turned = Scan(scan.stamp_ns + late_ns, scan.points @ R.T, time_s, scan.fields)
    bag.write_raw("/second", CLOUD, turned.stamp_ns, cloud_message(turned, "second"))


def lidars(drive_path: str, map_path: str, runs: int = 3) -> None:
    """Scans that vote, and CPU from the bag to the ballot, of one LiDAR and of pairs with the same points, in turns."""
    drive = open_drive(Path(drive_path))
    point_map = read_map(Path(map_path))
    with tempfile.TemporaryDirectory() as home:
        bags: dict[str, tuple[Path, dict[str, str]]] = {
            "one LiDAR": (record_lidars(Path(home) / "one", drive, None), {})
        }
        for k, (name, pair) in enumerate(LIDAR_PAIRS.items()):
            topics = {"topic": "/points,/second"}
            bags[f"two LiDARs, {name}"] = record_lidars(Path(home) / f"two_{k}", drive, pair), topics
        taken: dict[str, list[float]] = {name: [] for name in bags}
        for run in range(runs + 1):  # the first one compiles
            for name, (bag, options) in bags.items():
                start_s = time.process_time()
                recorded = open_drive(bag, as_live=True, sensor=drive.sensor.name, **options)
                _, report = vote_drive(recorded, point_map)
                if run:
                    taken[name].append(time.process_time() - start_s)
                else:
                    print(f"{name}: {report.scans - len(report.lost)} of {report.scans} scans voted", flush=True)
    one_s = np.array(taken["one LiDAR"])
    for name, seconds in taken.items():
        ratio = np.array(seconds) / one_s
        print(
            f"{name}: {np.median(seconds):.2f} s of CPU, {np.median(ratio):.3f} times {np.round(ratio, 2)}", flush=True
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["drive", "kills", "laps", "priors", "packets", "lidars"])
    parser.add_argument("paths", nargs="*")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--sensor", default="hdl32e")
    parser.add_argument("--core", default="", help="that the process which drives is held to")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--shortest", type=float, default=2.0, help="seconds before a kill at least")
    parser.add_argument("--longest", type=float, default=25.0, help="seconds before a kill at most")
    o = parser.parse_args()
    runs = {
        "drive": lambda: play_and_drive(*o.paths, o.rate, o.sensor, o.core),
        "kills": lambda: kills(*o.paths, o.kills, (o.shortest, o.longest)),
        "priors": lambda: priors(*o.paths),
        "packets": lambda: packets(*o.paths),
        "lidars": lambda: lidars(*o.paths),
        "laps": lambda: laps(o.domain, o.paths[0], Path(o.paths[1])),
    }
    runs[o.what]()


if __name__ == "__main__":
    main()
