"""What a live vehicle costs and keeps. Real DDS between processes, on loopback.

python benchmarks/live.py cloud                          # CPU of reading clouds of 70,000 points
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from mapvote.core.sensors import SENSORS
from mapvote.core.types import Scan
from mapvote.formats.drives.point_fields import scan_from_point_cloud2
from mapvote.live.cdr import from_cdr
from mapvote.live.dds import Network
from mapvote.live.play import cloud_message

sys.path[0] = str(Path(__file__).parents[1] / "tests")  # instead of this folder, whose live.py would hide tests/live
from live.loopback_dds import LOOPBACK, domain_of  # noqa: E402

CLOUD, POINTS = "sensor_msgs/msg/PointCloud2", 70_000


def cloud(n: int = POINTS) -> bytes:
    """A PointCloud2 as Velodyne's driver sends it: 22 bytes a point, times among them."""
    rng, azimuth = np.random.default_rng(3), np.linspace(0, 2 * np.pi, n)
    far, height = rng.uniform(4, 60, n), rng.uniform(-2, 8, n)
    points = np.column_stack([far * np.cos(azimuth), far * np.sin(azimuth), height]).astype(np.float32)
    time_s, ring = np.linspace(-0.1, 0, n, dtype=np.float32), np.arange(n).astype(np.uint16) % 32
    return cloud_message(Scan(time.time_ns(), points, time_s, rng.uniform(0, 1, n).astype(np.float32), ring))


def send_clouds(domain: int, seconds: float) -> None:
    """The other process: clouds at 10 Hz."""
    out, data = Network(domain).publish("/points", CLOUD), cloud()
    start, k = time.monotonic(), 0
    while time.monotonic() < start + seconds:
        out.send(data)
        k += 1
        time.sleep(max(0.0, start + 0.1 * k - time.monotonic()))


def cpu_by_thread() -> dict[str, float]:
    """CPU milliseconds of each thread of this process, by name."""
    out: dict[str, float] = {}
    for task in Path("/proc/self/task").iterdir():
        name, _, rest = (task / "stat").read_text().partition("(")[2].rpartition(")")
        runtime = (task / "schedstat").read_text().split()[0]
        out[name] = out.get(name, 0.0) + int(runtime) / 1e6
        del rest
    return out


def read_clouds(seconds: float = 20.0) -> None:
    """CPU of this process for each cloud, received and made a scan; what an idle reader costs is in it."""
    os.environ["CYCLONEDDS_URI"] = LOOPBACK
    domain = domain_of("benchmark")
    sender = subprocess.Popen(
        [sys.executable, __file__, "send-clouds", "--domain", str(domain), "--seconds", str(seconds + 5)]
    )
    network = Network(domain)
    incoming = network.subscribe("/points", CLOUD, reliable=True)
    end, n, before, ours = None, 0, {}, 0.0
    while end is None or time.monotonic() < end:
        network.wait(0.2)
        t = time.thread_time()
        for data in incoming.take():
            scan_from_point_cloud2(from_cdr(CLOUD, data), SENSORS["hdl32e"])
            n += 1
            if n == 20:
                end, before, ours, n, t = time.monotonic() + seconds, cpu_by_thread(), 0.0, 20, time.thread_time()
        ours += time.thread_time() - t
    after = cpu_by_thread()
    n -= 20
    each = {name: (ms - before.get(name, 0.0)) / n for name, ms in after.items()}
    print(f"{n} clouds in {seconds:.0f} s: {sum(each.values()):.2f} ms of CPU each, {1e3 * ours / n:.2f} in our code")
    print("| thread | ms a cloud |\n|---|---|")
    for name, ms in sorted(each.items(), key=lambda pair: -pair[1]):
        if ms > 0.005:
            print(f"| {name} | {ms:.2f} |")
    sender.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["cloud", "send-clouds"])
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    if options.what == "send-clouds":
        send_clouds(options.domain, options.seconds)
    else:
        read_clouds(options.seconds)


if __name__ == "__main__":
    main()
