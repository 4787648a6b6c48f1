"""What a live vehicle costs and keeps. Real DDS between processes, on loopback.

    python benchmarks/live.py cloud                      # CPU of reading clouds of 70,000 points
    python benchmarks/live.py drive DRIVE MAP --rate 1   # share of scans that voted, latency from sending to vote
    python benchmarks/live.py kills DRIVE MAP --kills 50 # kill -9 at random moments, in half of them without a server
    python benchmarks/live.py hours DRIVE MAP --hours 8  # memory over a long drive, in one process, as fast as it goes

DRIVE is one that ``mapvote simulate`` wrote, MAP what ``mapvote build`` made of its surveys. For kills the drive goes
round and round with stamps that go on; at the end of a lap the vehicle leaps back to the start, where some scans are
lost. For hours three columns of the map's tiles, and the part of the drive through them, are laid end to end as often
as it takes; where two copies meet, the scan shows another street than the map, and some scans are lost. 2 scans a
second are fed.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import resource
import socket
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from mapvote.config import Settings
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.point_map import LazyTiles
from mapvote.core.sensors import SENSORS
from mapvote.core.tile import Tile
from mapvote.core.types import Scan
from mapvote.formats import open_drive, read_map
from mapvote.formats.drives.point_fields import scan_from_point_cloud2
from mapvote.live.cdr import from_cdr
from mapvote.live.dds import Network
from mapvote.live.drive import LiveDrive, WaitingScan
from mapvote.live.messages import CLOUD
from mapvote.live.outbox import Outbox
from mapvote.live.play import cloud_message, opened
from mapvote.live.road_map import OneMap
from mapvote.vehicle import Vehicle
from mapvote.warmup import warm_vehicle

sys.path[0] = str(Path(__file__).parents[1] / "tests")  # instead of this folder, whose live.py would hide tests/live
from live.loopback_dds import LOOPBACK, own_domain  # noqa: E402
from live_server import mapvote  # noqa: E402

TILES, POINTS = 3, 70_000
"""Columns of tiles that are repeated; points of a cloud."""
PERIOD_M = TILES * TILE_CELLS * CELL_SIZE


def send_clouds(domain: int, seconds: float) -> None:
    """The other process: clouds at 10 Hz, with 22 bytes a point as Velodyne's driver sends them."""
    rng, azimuth = np.random.default_rng(3), np.linspace(0, 2 * np.pi, POINTS)
    far, height = rng.uniform(4, 60, POINTS), rng.uniform(-2, 8, POINTS)
    points = np.column_stack([far * np.cos(azimuth), far * np.sin(azimuth), height]).astype(np.float32)
    time_s, ring = np.linspace(-0.1, 0, POINTS, dtype=np.float32), np.arange(POINTS).astype(np.uint16) % 32
    intensity = rng.uniform(0, 1, POINTS).astype(np.float32)
    out, data = Network(domain).publish("/points", CLOUD), cloud_message(Scan(0, points, time_s, intensity, ring))
    start = time.monotonic()
    for k in range(int(10 * seconds)):
        time.sleep(max(0.0, start + 0.1 * k - time.monotonic()))
        out.send(data)


def read_clouds(seconds: float) -> None:
    """CPU of this process for each cloud, received and made a scan; what an idle reader costs is in it."""
    os.environ["CYCLONEDDS_URI"] = LOOPBACK
    domain = own_domain()
    options = ["--domain", str(domain), "--seconds", str(seconds)]
    sender = subprocess.Popen([sys.executable, __file__, "send-clouds", *options])
    network, n, before, after = Network(domain), 0, (0.0, 0.0), (0.0, 0.0)
    incoming = network.subscribe("/points", CLOUD, reliable=True)
    while sender.poll() is None:
        network.wait(0.2)
        for _, data in incoming.take():
            scan_from_point_cloud2(from_cdr(CLOUD, data), SENSORS["hdl32e"])
            n, after = n + 1, (time.process_time(), time.thread_time())
            before = after if n == 20 else before
    process, ours = (1e3 * (b - a) / (n - 20) for a, b in zip(before, after, strict=True))
    print(f"{n - 20} clouds: {process:.2f} ms of CPU each, {process - ours:.2f} of it in the threads of DDS")


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


def kills(drive: str, map_path: str, n: int, longest_s: float) -> None:
    """Kill a live drive n times, each up to ``longest_s`` after its start, and count what is missing and what came
    twice. Exit code 1 if a ballot is, or more than 30 s of road."""
    home, chance = Path(tempfile.mkdtemp()), random.Random(4)
    os.environ |= {"CYCLONEDDS_URI": LOOPBACK, "XDG_CACHE_HOME": str(home / "cache"), "PYTHONUNBUFFERED": "1"}
    domain, server, shown, log = own_domain(), Server(home, map_path), home / "stamp", home / "log"
    sender = subprocess.Popen(
        [sys.executable, __file__, "laps", drive, str(shown), "--domain", str(domain)], start_new_session=True
    )
    url = f"http://127.0.0.1:{server.port}"
    options = ["--map", map_path, "--send", url, "--vehicle", "car", "--name", "day", "--every-m", 150]
    command = mapvote("drive", *options, "--domain", domain, "--sensor", "hdl32e")
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
            time.sleep(chance.uniform(2.0, longest_s) if k < n else 20.0)
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


def hours(drive_path: str, map_path: str, length_h: float) -> None:
    """A LiveDrive fed in one process; resident memory beside the map and interpreter, and ballots."""
    drive, street = open_drive(Path(drive_path)), read_map(Path(map_path))
    priors = drive.T_map_lidar_prior
    assert priors is not None
    x0 = 0.5 * (np.ptp(priors[:, 0, 3]) - PERIOD_M) + priors[:, 0, 3].min()
    part = np.flatnonzero((priors[:, 0, 3] >= x0) & (priors[:, 0, 3] < x0 + PERIOD_M))
    step_ns = 500_000_000
    part = part[:: max(1, round(step_ns / float(np.median(np.diff(drive.stamps_ns)))))]
    scans, total = [drive.read_scan(int(i)) for i in part], int(3.6e12 * length_h / step_ns)
    ours = {index: tile for index, tile in street.tiles.items() if 0 <= index[1] < TILES}
    copies = range(-1, 2 + total // len(scans))
    points = {(r, c + TILES * k): len(tile.points) for (r, c), tile in ours.items() for k in copies}

    def made(index: TileIndex) -> Tile:
        return replace(ours[index[0], index[1] % TILES], window=street.lattice.tile(index))

    maps = OneMap(replace(street, tiles=LazyTiles(made, points), driven=()))
    home = Path(tempfile.mkdtemp())
    (home / "out").mkdir()
    outbox = Outbox(home / "state", "car", folder=home / "out", say=lambda _: None)
    warm_vehicle(Settings())
    live = LiveDrive(lambda m: Vehicle("car", drive.sensor, m), maps, outbox, name="day")

    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6

    base = resident_mb()
    print(f"base {base:.0f} MB with the scans that are fed")
    print("| hours | km | scans voted | ballots | MB |\n|---|---|---|---|---|")
    for n in range(1, total + 1):
        k, i = divmod(n - 1, len(scans))
        stamp_ns, prior = scans[0].stamp_ns + step_ns * n, priors[part[i]].copy()
        prior[0, 3] += k * PERIOD_M
        live.on_pose(stamp_ns, prior)
        scan = replace(scans[i], stamp_ns=stamp_ns)
        live.on_scan(WaitingScan(stamp_ns, time.time_ns(), lambda scan=scan: scan))
        while live.step():
            pass
        if n % max(1, total // 16) == 0:
            c, km = live.counts, 1e-3 * n / len(scans) * PERIOD_M
            mb = resident_mb() - base
            print(
                f"| {n * step_ns / 3.6e12:.2f} | {km:.1f} | {c.localised} of {n} | {c.ballots} | {mb:.0f} |", flush=True
            )
    live.finish()
    outbox.close()
    left = [f.name for f in (home / "state/car").iterdir() if not f.name.startswith(".")]
    print(f"{total} scans, {live.counts.localised} voted, {live.counts.ballots} ballots; files left behind: {left}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["cloud", "send-clouds", "drive", "kills", "laps", "hours"])
    parser.add_argument("paths", nargs="*")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--sensor", default="hdl32e")
    parser.add_argument("--core", default="", help="that the process which drives is held to")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--longest", type=float, default=25.0, help="seconds before a kill")
    parser.add_argument("--hours", type=float, default=8.0)
    o = parser.parse_args()
    runs = {
        "send-clouds": lambda: send_clouds(o.domain, o.seconds),
        "cloud": lambda: read_clouds(o.seconds),
        "drive": lambda: play_and_drive(*o.paths, o.rate, o.sensor, o.core),
        "kills": lambda: kills(*o.paths, o.kills, o.longest),
        "laps": lambda: laps(o.domain, o.paths[0], Path(o.paths[1])),
        "hours": lambda: hours(*o.paths, o.hours),
    }
    runs[o.what]()


if __name__ == "__main__":
    main()
