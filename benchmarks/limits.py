"""``mapvote drive`` on a part of a core, and beside other processes: scans voted, CPU, memory, latency.

    python benchmarks/limits.py MAP DRIVE... --share 1 .5 .25       # cgroup's limits, as docker --cpus sets them
    python benchmarks/limits.py MAP DRIVE --load 0 2 4 --rate 1 3   # on one core, beside so many busy loops

Real DDS on loopback, ``mapvote play`` in a process of its own. Needs root and a cgroup v1 at /sys/fs/cgroup/cpu. A
group holds `drive`, `play` and the loops; it has the weight of 256 others, so that what else runs on the machine takes
little. A limit holds for `drive` alone, from its first import on, with a period of 0.1 s. CPU and memory (the largest
resident set) are those of `drive`; its share of a core counts from the first cloud to the last. `mapvote warmup` runs
before: kernels are loaded, not compiled. Large clouds need `sysctl net.core.rmem_max=8388608`.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from mapvote.formats import open_drive

sys.path[0] = str(Path(__file__).parents[1] / "tests")  # instead of this folder, whose live.py would hide tests/live
from live.loopback_dds import LOOPBACK, own_domain  # noqa: E402
from live_server import mapvote  # noqa: E402

CPU_GROUPS = Path("/sys/fs/cgroup/cpu")
PERIOD_US = 100_000
MOST_WEIGHT = 262_144
BUSY = "while True: pass"


class Trial(NamedTuple):
    """One run."""

    drive: Path
    share: float
    """Of one core, that `drive` may use; 0: no limit, on one core."""
    load: int
    """Busy loops on the same core."""
    rate: float
    """Speed of the drive, in multiples of the recorded one."""


class Outcome(NamedTuple):
    """What came of it."""

    told: str
    """The last line of `drive`."""
    ready_s: float
    """From the start of `drive` until it listens."""
    ready_cpu_s: float
    cpu_share: float
    """CPU over time while clouds come."""
    end_s: float
    """From the last cloud to the end of `drive`, which waits 5 s for a further one."""
    peak_mb: float


@contextmanager
def cpu_group(name: str, share: float) -> Iterator[Path]:
    """A group of processes that may use this share of a core; 0: all. One in another has the weight of a process."""
    group = CPU_GROUPS / name
    group.mkdir()
    try:
        if "/" not in name:
            (group / "cpu.shares").write_text(str(MOST_WEIGHT))
        if share:
            (group / "cpu.cfs_period_us").write_text(str(PERIOD_US))
            (group / "cpu.cfs_quota_us").write_text(str(round(share * PERIOD_US)))
        yield group
    finally:
        while (group / "cgroup.procs").read_text():
            time.sleep(0.1)
        group.rmdir()


def started(command: list[str], group: Path, core: int | None = None) -> subprocess.Popen[str]:
    """A process in this group from its first instruction on, held to a core."""

    def enter() -> None:
        (group / "cgroup.procs").write_text(str(os.getpid()))
        if core is not None:
            os.sched_setaffinity(0, [core])

    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=enter)


def cpu_s(pid: int) -> float:
    """CPU of a process so far, seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(trial: Trial, map_path: Path) -> Outcome:
    """Play one drive, and vote on it."""
    core = max(os.sched_getaffinity(0)) if not trial.share else None
    domain = own_domain()
    name = f"mapvote-{os.getpid()}"
    with tempfile.TemporaryDirectory() as home, cpu_group(name, 0.0) as all_of_it:
        os.environ |= {"CYCLONEDDS_URI": LOOPBACK, "XDG_CACHE_HOME": home, "PYTHONUNBUFFERED": "1"}
        options = ["--map", map_path, "--out", home, "--vehicle", "car", "--idle", 5, "--domain", domain]
        recorded = open_drive(trial.drive)
        sensor = recorded.sensor.name
        played_s = 1e-9 * float(recorded.stamps_ns[-1] - recorded.stamps_ns[0]) / trial.rate
        loops = [started([sys.executable, "-c", BUSY], all_of_it, core) for _ in range(trial.load)]
        play = mapvote("play", trial.drive, "--rate", trial.rate, "--domain", domain)
        player = started(play, all_of_it)
        try:
            with cpu_group(f"{name}/drive", trial.share) as limited:
                drive = started(mapvote("drive", *options, "--sensor", sensor), limited, core)
                return watched(drive, player, played_s)
        finally:
            player.kill()
            for loop in loops:
                loop.kill()


def watched(drive: subprocess.Popen[str], player: subprocess.Popen[str], played_s: float) -> Outcome:
    """The outcome of `drive`, once ``player`` has sent its clouds, which takes ``played_s``."""
    start_s = time.monotonic()
    assert drive.stdout is not None
    while "listening" not in (line := drive.stdout.readline()):
        assert line, "drive ended before it listened"
    ready_s = time.monotonic() - start_s
    ready_cpu_s = cpu_s(drive.pid)
    player.wait()
    end_s = time.monotonic()
    share = (cpu_s(drive.pid) - ready_cpu_s) / played_s
    lines = drive.stdout.read().splitlines()
    _, status, used = os.wait4(drive.pid, 0)
    drive.returncode = os.waitstatus_to_exitcode(status)
    assert drive.returncode == 0, lines
    return Outcome(lines[-1], ready_s, ready_cpu_s, share, time.monotonic() - end_s, used.ru_maxrss / 1024)


def row(trial: Trial, outcome: Outcome) -> str:
    """Of the table in docs/live.md."""
    found = re.search(r"(\d+) of (\d+) scans voted, (\d+) lost, (\d+) scans left out", outcome.told)
    latency = re.search(r"p50, p99: (.*)", outcome.told)
    assert found is not None, outcome.told
    assert latency is not None, outcome.told
    voted, scans, lost, left_out = found.groups()
    allowed = f"{trial.share:g}" if trial.share else f"1, beside {trial.load}"
    sensor = open_drive(trial.drive).sensor.name
    return (
        f"| {sensor} | {allowed} | {trial.rate:g} | {voted} of {scans} | {lost}, {left_out}"
        f" | {latency[1]} | {outcome.cpu_share:.0%} | {outcome.peak_mb:.0f} | {outcome.ready_cpu_s:.1f} in "
        f"{outcome.ready_s:.1f} | {outcome.end_s:.1f} | {os.getloadavg()[0]:.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("drives", type=Path, nargs="+")
    parser.add_argument("--share", type=float, nargs="+", default=[], help="of one core")
    parser.add_argument("--load", type=int, nargs="+", default=[], help="busy loops beside it")
    parser.add_argument("--rate", type=float, nargs="+", default=[1.0])
    o = parser.parse_args()
    subprocess.run(mapvote("warmup"), check=True, stdout=subprocess.DEVNULL)
    print("| sensor | cores | rate | voted | lost, left out | p50, p99 | CPU | MB | start, s | end, s | load |")
    print("|---|---|---|---|---|---|---|---|---|---|---|", flush=True)
    limits = [(share, 0) for share in o.share] + [(0.0, load) for load in o.load]
    for drive in o.drives:
        for share, load in limits:
            for rate in o.rate:
                trial = Trial(drive, share, load, rate)
                print(row(trial, run(trial, o.map)), flush=True)


if __name__ == "__main__":
    main()
