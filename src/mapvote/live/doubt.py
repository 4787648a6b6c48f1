"""Clouds around a doubtful change, kept as files beside the votes: what a vehicle saw where it is not sure.

A change is doubtful if half of its cells are less sure than ``DoubtRule.sure`` and more than the opposite, by the
vehicle's own evidence. Then the clouds of the last ten seconds are kept as one MCAP file: each near the change, in the
frame of the LiDAR, with its place in the map on /tf. A process writes (live/doubt_file.py). While it is busy, and where
there is no room, a change is left out: nothing waits for the disk.
"""

from __future__ import annotations

import logging
import math
import queue
import shutil
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import scipy

from mapvote.codec.ballot import Ballot, BallotTile, Odds, in_nats, unpack_planes
from mapvote.core.extras import require
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.record import record
from mapvote.core.types import F32, F64, MapvoteError
from mapvote.live.doubt_file import FileWriter, Job, PlacedCloud
from mapvote.live.log_lines import Repeated
from mapvote.live.mcap import HIDDEN

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
    jobs: int = 2
    """Changes that wait to be written at most."""


DOUBT_RULE = DoubtRule()


class DoubtKeeper:
    """Keeps the clouds of one vehicle in a folder, of so many bytes at most: the oldest files go first."""

    def __init__(
        self, folder: Path, most_bytes: int, rule: DoubtRule = DOUBT_RULE, writer: FileWriter | None = None
    ) -> None:
        """MapvoteError if the folder cannot be made, or without rosbags (extra ``ros``)."""
        self._folder = folder
        self._writer = writer or FileWriter(most_bytes)
        self._rule = rule
        self._waiting: dict[int, F32] = {}
        """Points of scans that have no place yet, by stamp."""
        self._clouds: deque[PlacedCloud] = deque(maxlen=rule.clouds)
        self._kept: set[str] = set()
        self._repeated = Repeated(log.warning)
        self._jobs: queue.Queue[Job | None] = queue.Queue(rule.jobs)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for left in folder.glob(f"{HIDDEN}*"):  # of a crash
                left.unlink() if left.is_file() else shutil.rmtree(left, ignore_errors=True)
        except OSError as error:
            raise MapvoteError(f"--keep-doubt {folder}: {error.strerror}; name a folder that can be written") from error
        require("rosbags.rosbag2", "ros", "--keep-doubt")
        self._thread = threading.Thread(target=self._write, name="doubt", daemon=True)
        self._thread.start()

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
        job = Job(self._folder / name, place, [cloud for cloud in self._clouds if cloud.stamp_ns >= since_ns])
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
        self._jobs.put(None)
        self._thread.join()

    def _write(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                trouble = self._writer.write(job)
            except OSError as error:
                trouble = str(error)
            if trouble:
                self._kept.discard(job.path.name)
                self._repeated("disk", f"no clouds are kept of a doubtful change: {trouble}")
        self._writer.close()


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
    group, count = scipy.ndimage.label(np.isfinite(plane), np.ones((3, 3)))
    each = np.arange(1, count + 1)
    middle = np.abs(scipy.ndimage.median(plane, group, each))
    size = np.bincount(group.ravel(), minlength=count + 1)[1:]
    doubtful = (middle < math.log(rule.sure / (1.0 - rule.sure))) & (size >= rule.cells)
    if not doubtful.any():
        return None
    largest = int(each[np.argmax(np.where(doubtful, size, 0))])
    row, col = np.argwhere(group == largest).mean(axis=0) + 0.5
    window = lattice.tile(tile.tile)
    return np.array([window.x0 + col * CELL_SIZE, window.y0 + row * CELL_SIZE])
