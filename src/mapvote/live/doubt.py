"""Clouds around a doubtful change, kept as files beside the votes: what a vehicle saw where it is not sure.

A change is doubtful if half of its cells are less sure than ``DoubtRule.sure`` and more than the opposite, by the
vehicle's own evidence. Then the clouds of the last ten seconds are kept as one MCAP file: each near the change, in the
frame of the LiDAR, with its place in the map on /tf. A thread writes. While it is busy, and where there is no room, a
change is left out: nothing waits for the disk.
"""

from __future__ import annotations

import logging
import math
import queue
import shutil
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from scipy import ndimage

from mapvote.codec.ballot import Ballot, BallotTile, Odds, in_nats, unpack_planes
from mapvote.core.extras import require
from mapvote.core.geometry import transform
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.record import record
from mapvote.core.types import F32, F64, MapvoteError
from mapvote.live.log_lines import Repeated
from mapvote.live.mcap import HIDDEN, FileMessage, write_mcap
from mapvote.live.messages import CLOUD, LIDAR_FRAME, MAP_FRAME, TF, cloud_of, to_cdr
from mapvote.live.play import frames_message

log = logging.getLogger("mapvote.live")


@record()
@dataclass(frozen=True, slots=True)
class DoubtRule:
    """Which changes are doubtful, and which clouds are kept."""

    sure: float = 0.8
    """Probability of a change from which it is no longer doubtful, and 1 minus it up to which it is none."""
    cells: int = 8
    """Least cells of a doubtful change: smaller ones are rims of others, 0.7 m2."""
    before_ns: int = 10 * 10**9
    """Time before the newest scan of which clouds are kept, nanoseconds."""
    clouds: int = 50
    """Clouds that are held at most, evenly spread over that time: 40 MB for 32 beams."""
    near_m: float = 40.0
    """Points farther from the change are left out, metres."""
    jobs: int = 2
    """Changes that wait to be written at most."""
    pause_s: float = 0.02
    """Pause of the writer after each message, seconds: on a busy machine it would keep the interpreter from the scans.
    """
    overhead: int = 200
    """Bytes of a message in an MCAP file beside its data: record, index, and its share of the summary."""
    definitions: int = 20_000
    """Bytes of the definitions of types in an MCAP file."""


DOUBT_RULE = DoubtRule()


class PlacedCloud(NamedTuple):
    """A cloud and where it was taken."""

    stamp_ns: int
    points: F32
    """(n, 3) lidar frame."""
    T_map_lidar: F64


class _Job(NamedTuple):
    path: Path
    place: F64
    """(2,) the change, map metres."""
    clouds: list[PlacedCloud]


class DoubtKeeper:
    """Keeps the clouds of one vehicle in a folder, of so many bytes at most: the oldest files go first."""

    def __init__(self, folder: Path, most_bytes: int, rule: DoubtRule = DOUBT_RULE) -> None:
        """MapvoteError if the folder cannot be made, or without rosbags (extra ``ros``)."""
        self._folder = folder
        self._most_bytes = most_bytes
        self._rule = rule
        self._waiting: dict[int, F32] = {}
        """Points of scans that have no place yet, by stamp."""
        self._clouds: deque[PlacedCloud] = deque(maxlen=rule.clouds)
        self._kept: set[str] = set()
        self._repeated = Repeated(log.warning)
        self._jobs: queue.Queue[_Job | None] = queue.Queue(rule.jobs)
        self._closing = threading.Event()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for left in folder.glob(f"{HIDDEN}*"):  # of a crash
                shutil.rmtree(left, ignore_errors=True)
        except OSError as error:
            raise MapvoteError(f"--keep-doubt {folder}: {error.strerror}; name a folder that can be written") from error
        require("rosbags.rosbag2", "ros", "--keep-doubt")
        self._try_out()
        self._thread = threading.Thread(target=self._write, name="doubt", daemon=True)
        self._thread.start()

    def _try_out(self) -> None:
        """Write a file and delete it: what the first one loads, 0.3 s of CPU, is loaded before there are scans."""
        cloud = PlacedCloud(0, np.zeros((1, 3), np.float32), np.eye(4))
        trial = self._folder / f"{HIDDEN}trial"
        try:
            write_mcap(trial, _messages(_Job(trial, np.zeros(2), [cloud]), self._rule.near_m))
            trial.unlink()
        except (MapvoteError, OSError) as error:
            self._repeated("disk", f"no clouds are kept of a doubtful change: {error}")

    def add(self, stamp_ns: int, points: F32) -> None:
        """A scan that has no place yet, (n, 3) in the lidar frame; some are skipped, so that the held ones span the
        time."""
        step_ns = self._rule.before_ns // self._rule.clouds
        last_ns = max(self._waiting, default=self._clouds[-1].stamp_ns if self._clouds else stamp_ns - step_ns)
        if abs(stamp_ns - last_ns) >= step_ns:
            self._waiting[stamp_ns] = points

    def placed(self, stamp_ns: int, T_map_lidar: F64 | None) -> None:
        """A scan is decided, in the order of stamps: it has a place (4, 4), or none."""
        points = self._waiting.pop(stamp_ns, None)
        if points is not None and T_map_lidar is not None:
            self._clouds.append(PlacedCloud(stamp_ns, points, T_map_lidar))

    def forget(self) -> None:
        """The clock jumped: scans before it are of no use."""
        self._waiting.clear()
        self._clouds.clear()

    def marked(self, drive_id: str, ballot: Ballot, lattice: Lattice) -> Ballot:
        """The ballot, whose tiles state where clouds are kept; those of newly doubtful tiles go to the writer."""
        tiles = [
            msgspec.structs.replace(tile, clouds=True) if self._keeps(drive_id, tile, lattice) else tile
            for tile in ballot.tiles
        ]
        return msgspec.structs.replace(ballot, tiles=tiles)

    def _keeps(self, drive_id: str, tile: BallotTile, lattice: Lattice) -> bool:
        name = file_name(drive_id, tile.tile)
        if name in self._kept:
            return True
        place = doubtful_place(tile, lattice, self._rule)
        if place is None or not self._clouds:
            return False
        since_ns = self._clouds[-1].stamp_ns - self._rule.before_ns
        job = _Job(self._folder / name, place, [cloud for cloud in self._clouds if cloud.stamp_ns >= since_ns])
        try:
            self._jobs.put_nowait(job)
        except queue.Full:
            self._repeated("busy", f"the disk is slow: no clouds are kept of a doubtful change ({name})")
            return False
        self._kept.add(name)
        return True

    def flagging(self, drive_id: str, written: Callable[[], Ballot]) -> Callable[[], Ballot]:
        """A function that gives the ballot of ``written``, whose tiles state where clouds were kept."""

        def flagged() -> Ballot:
            ballot = written()
            kept = [file_name(drive_id, tile.tile) in self._kept for tile in ballot.tiles]
            tiles = [msgspec.structs.replace(tile, clouds=has) for tile, has in zip(ballot.tiles, kept, strict=True)]
            return msgspec.structs.replace(ballot, tiles=tiles)

        return flagged

    def close(self) -> None:
        """Write what waits."""
        self._closing.set()
        self._jobs.put(None)
        self._thread.join()

    def _write(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                messages = list(self._slowly(_messages(job, self._rule.near_m)))
                size = sum(len(message.data) + self._rule.overhead for message in messages)
                self._make_room(size + self._rule.definitions)
                write_mcap(job.path, self._slowly(messages))
            except (MapvoteError, OSError) as error:
                self._kept.discard(job.path.name)
                self._repeated("disk", f"no clouds are kept of a doubtful change: {error}")

    def _slowly(self, messages: Iterable[FileMessage]) -> Iterator[FileMessage]:
        """The messages, with a pause after each while nobody waits for the last file."""
        for message in messages:
            yield message
            self._closing.wait(self._rule.pause_s)

    def _make_room(self, size: int) -> None:
        """Delete the oldest files until ``size`` bytes more are within the bound. MapvoteError if they never are."""
        if size > self._most_bytes:
            raise MapvoteError(f"{size / 1e6:.0f} MB are more than --keep-doubt-mb allows")
        files = sorted(self._folder.glob("*.mcap"), key=lambda file: file.stat().st_mtime_ns)
        used = sum(file.stat().st_size for file in files)
        while used + size > self._most_bytes:
            oldest = files.pop(0)
            used -= oldest.stat().st_size
            oldest.unlink()


def file_name(drive_id: str, tile: TileIndex) -> str:
    """The file with the clouds of a tile: DRIVE_ROW_COL.mcap."""
    return f"{drive_id}_{tile[0]}_{tile[1]}.mcap"


def doubtful_place(tile: BallotTile, lattice: Lattice, rule: DoubtRule = DOUBT_RULE) -> F64 | None:
    """(2,) the middle of the largest doubtful change on a tile, map metres; None if there is none, or if the ballot
    does not say how sure it is. MapvoteError if a plane is damaged."""
    odds: Odds | None = unpack_planes(tile).odds if tile.odds is not None else None
    if odds is None or not len(odds.cells):
        return None
    flat = np.full(TILE_CELLS * TILE_CELLS, np.nan)
    flat[odds.cells] = in_nats(odds.steps)
    plane = flat.reshape(TILE_CELLS, TILE_CELLS)
    group, count = ndimage.label(np.isfinite(plane), np.ones((3, 3)))
    each = np.arange(1, count + 1)
    middle = np.abs(ndimage.median(plane, group, each))
    size = np.bincount(group.ravel(), minlength=count + 1)[1:]
    doubtful = (middle < math.log(rule.sure / (1.0 - rule.sure))) & (size >= rule.cells)
    if not doubtful.any():
        return None
    largest = int(each[np.argmax(np.where(doubtful, size, 0))])
    row, col = np.argwhere(group == largest).mean(axis=0) + 0.5
    window = lattice.tile(tile.tile)
    return np.array([window.x0 + col * CELL_SIZE, window.y0 + row * CELL_SIZE])


def _messages(job: _Job, near_m: float) -> Iterator[FileMessage]:
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
