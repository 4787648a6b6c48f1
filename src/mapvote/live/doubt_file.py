"""Files of clouds around doubtful changes, written by a process of its own: in a thread, each of the hundreds of steps
of a file would wait for the interpreter, and on a busy machine the scans would wait for it in turn.

    python -m mapvote.live.doubt_file   # a line of JSON for each file, answered by a line: its trouble, or nothing
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mapvote.core.geometry import transform
from mapvote.core.record import record
from mapvote.core.types import F32, F64, MapvoteError
from mapvote.formats.drives.ros_types import CLOUD, TF
from mapvote.live.mcap import HIDDEN, FileMessage, write_mcap
from mapvote.live.messages import LIDAR_FRAME, MAP_FRAME, cloud_of, to_cdr
from mapvote.live.play import frames_message


@record()
@dataclass(frozen=True, slots=True)
class KeptFile:
    """Numbers of a file."""

    near_m: float = 40.0
    """Points farther from the change are left out, metres."""
    overhead: int = 200
    """Bytes of a message in an MCAP file beside its data: record, index, and its share of the summary."""
    definitions: int = 20_000
    """Bytes of the definitions of types in an MCAP file."""
    niceness: int = 10
    """Of the process that writes, above that of the drive."""


KEPT_FILE = KeptFile()


class PlacedCloud(NamedTuple):
    """A cloud and where it was taken."""

    stamp_ns: int
    points: F32
    """(n, 3) lidar frame."""
    T_map_lidar: F64


class Job(NamedTuple):
    """A file to write."""

    path: Path
    place: F64
    """(2,) the change, map metres."""
    clouds: list[PlacedCloud]


class FileWriter:
    """Has files written by a process, which begins with the first of them."""

    def __init__(self, most_bytes: int) -> None:
        """``most_bytes``: of all files in a folder; the oldest go first."""
        self._most_bytes = most_bytes
        self._process: subprocess.Popen[str] | None = None

    def write(self, job: Job) -> str:
        """Write a file; returns why it was not written, "" if it was. OSError if the disk is full."""
        raw = job.path.with_name(f"{HIDDEN}raw")
        try:
            _save(raw, job)
            return self._answer(json.dumps([str(raw), str(job.path), self._most_bytes]))
        finally:
            raw.unlink(missing_ok=True)

    def _answer(self, line: str) -> str:
        if self._process is not None and self._process.poll() is not None:
            self.close()
        if self._process is None:
            command = [sys.executable, "-m", "mapvote.live.doubt_file"]
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        return answer.strip() if answer else "the process that writes them has ended"

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.communicate()
            self._process = None


def _save(raw: Path, job: Job) -> None:
    """The job in a file: few large writes, during which the interpreter is free."""
    with raw.open("wb") as out:
        np.save(out, job.place)
        np.save(out, np.array([cloud.stamp_ns for cloud in job.clouds], dtype=np.int64))
        np.save(out, np.array([cloud.T_map_lidar for cloud in job.clouds]))
        for cloud in job.clouds:
            np.save(out, cloud.points)


def _saved(raw: Path, path: Path) -> Job:
    with raw.open("rb") as read:
        place = np.load(read)
        stamps_ns = np.load(read).tolist()
        poses = np.load(read)
        clouds = [PlacedCloud(ns, np.load(read), T) for ns, T in zip(stamps_ns, poses, strict=True)]
    return Job(path, place, clouds)


def write_file(job: Job, most_bytes: int, numbers: KeptFile = KEPT_FILE) -> None:
    """Write a file; the oldest of its folder go until all have ``most_bytes`` at most. MapvoteError if it cannot be
    written, or is larger than that by itself."""
    messages = list(_messages(job, numbers.near_m))
    size = sum(len(message.data) + numbers.overhead for message in messages) + numbers.definitions
    if size > most_bytes:
        raise MapvoteError(f"{size / 1e6:.0f} MB are more than --keep-doubt-mb allows")
    files = sorted(job.path.parent.glob("*.mcap"), key=lambda file: file.stat().st_mtime_ns)
    used = sum(file.stat().st_size for file in files)
    while used + size > most_bytes:
        oldest = files.pop(0)
        used -= oldest.stat().st_size
        oldest.unlink()
    write_mcap(job.path, messages)


def _messages(job: Job, near_m: float) -> Iterator[FileMessage]:
    """Place of each cloud, and its points near the change."""
    for cloud in job.clouds:
        points_map = transform(cloud.T_map_lidar, cloud.points)
        away_m = points_map[:, :2] - job.place
        near = np.flatnonzero(np.einsum("ij,ij->i", away_m, away_m) <= near_m * near_m)
        if not len(near):
            continue
        columns = dict(zip("xyz", cloud.points.take(near, axis=0).T, strict=True))
        data = to_cdr(CLOUD, cloud_of(columns, cloud.stamp_ns, LIDAR_FRAME))
        way = frames_message(cloud.stamp_ns, {LIDAR_FRAME: cloud.T_map_lidar}, MAP_FRAME)
        yield FileMessage("/tf", TF, cloud.stamp_ns, way)
        yield FileMessage("/points", CLOUD, cloud.stamp_ns, data)


def main() -> None:
    """Write files until the input ends."""
    for ends in (signal.SIGINT, signal.SIGTERM):  # they end the drive too, which waits for its last file
        signal.signal(ends, signal.SIG_IGN)
    os.nice(KEPT_FILE.niceness)
    for line in sys.stdin:
        raw, path, most_bytes = json.loads(line)
        trouble = ""
        try:
            write_file(_saved(Path(raw), Path(path)), most_bytes)
        except (MapvoteError, OSError) as error:
            trouble = " ".join(str(error).split())
        print(trouble, flush=True)


if __name__ == "__main__":
    main()
