"""Through how many files a scan, a tile, a ballot, the desk, a cell, a map, a diagnosis and an evaluation walk.

    python benchmarks/walks.py [--show tile]

A walk is what runs of mapvote's own functions, in all threads; kernels count as their caller. *Files*: those in which
anything runs, and how many of them do more than serve (core, config, codec). *Stays*: handovers, each pair of a calling
and a called file once, to files that do. *Returns*: calls into a file that waits further up in the same stack, every
call counted; *places*: pairs of a calling and a called function between which they happen.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import FrameType

import httpx2
import numpy as np
from msgspec.structs import replace as replaced

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import mapvote
from fusion import said
from fusion import street as two_facades
from hand_made import make_ballot, unpack_all
from mapvote.codec.ballot import encode, pack_path
from mapvote.config import FuseSettings, Settings
from mapvote.core.point_map import map_from_points
from mapvote.core.rule import SURFACES
from mapvote.core.types import CellState
from mapvote.doctor.diagnosis import diagnose
from mapvote.formats.drives.scan_folder import DriveWriter
from mapvote.fusion.fuse import fuse_tile
from mapvote.survey.build import build_map
from mapvote.vehicle import Vehicle
from mapvote_lab.evaluation.cases import choose_cases
from mapvote_lab.evaluation.evaluate import evaluate
from mapvote_lab.evaluation.scene import Scene
from mapvote_server.api.app import URL, in_process
from mapvote_server.store.policy import Policy
from mapvote_server.store.store import Store
from streets import drive_along, path, street

SRC = str(Path(mapvote.__file__).parents[1]) + "/"
SERVING = "mapvote/core", "mapvote/config", "mapvote/codec", "mapvote/__init__.py"
POLICY = FuseSettings(min_votes=2, max_deleted_share=1.0)


class Walk:
    """The files that run, and who hands over to whom, while it is on."""

    def __init__(self) -> None:
        self.on = False
        self.files: set[str] = set()
        self.stays: set[tuple[str, str]] = set()
        self.returns: Counter[tuple[str, str]] = Counter()
        """Calls back into a waiting file, by the calling and the called function, each as "file:function"."""

    def watch(self, frame: FrameType, event: str, arg: object) -> None:
        """For :func:`sys.setprofile`."""
        here = file_of(frame.f_code.co_filename)
        if not self.on or event != "call" or here is None:
            return
        self.files.add(here)
        above: list[str] = []
        waiting = frame.f_back
        caller: FrameType | None = None
        while waiting is not None:
            there = file_of(waiting.f_code.co_filename)
            if there is not None:
                caller = caller or waiting
                above.append(there)
            waiting = waiting.f_back
        if above and above[0] != here and not here.startswith(SERVING):
            self.stays.add((above[0], here))
            if here in above:
                assert caller is not None
                calling = f"{above[0]}:{caller.f_code.co_name}"
                self.returns[calling, f"{here}:{frame.f_code.co_name}"] += 1


@cache
def file_of(source: str) -> str | None:
    """A file of mapvote's packages, from ``src``; None for any other."""
    inside = source.removeprefix(SRC) if source.startswith(SRC) else ""
    return inside if inside.startswith("mapvote") else None


@contextmanager
def counted(walk: Walk) -> Iterator[None]:
    walk.on = True
    sys.setprofile(walk.watch)
    try:
        yield
    finally:
        sys.setprofile(None)
        walk.on = False


def scan(walk: Walk) -> None:
    """One scan, while those of a second before it vote."""
    poses = path(14)
    drive = drive_along(poses, 1, poses, sigma_m=0.2)
    vehicle = Vehicle("v", drive.sensor, map_from_points(street(0)), prior_sigma_m=0.2)
    for i in range(len(poses) - 1):
        vehicle.observe(drive.read_scan(i), poses[i])
    last = drive.read_scan(len(poses) - 1)
    with counted(walk):
        vehicle.observe(last, poses[-1])


def tile(walk: Walk) -> None:
    """Three ballots take a house down and put a kiosk up."""
    rng, point_map = np.random.default_rng(1), two_facades([(0, 0)])
    ballots = [make_ballot(point_map, {(0, 0): said(rng)}, f"v{i}", "d", end_ns=10**18 + i) for i in range(3)]
    votes = [replace(vote, vehicle=one.vehicle, digest=one.vehicle) for one in ballots for vote in unpack_all(one)]
    with counted(walk):
        decision, _ = fuse_tile(point_map.tiles[0, 0], votes, SURFACES, POLICY, 2, lambda: votes)
    assert (decision.states == CellState.CHANGED_EMPTY).any(), "nothing was decided"


def ask(walk: Walk, act: Callable[[httpx2.Client, bytes], httpx2.Response]) -> None:
    """A request to a store with two ballots, and a third at hand."""
    rng, point_map = np.random.default_rng(1), two_facades([(0, 0)])
    way = pack_path([np.array([x, 3.0]) for x in range(0, 60, 6)], point_map.lattice)
    first, second, third = (
        encode(replaced(make_ballot(point_map, {(0, 0): said(rng)}, vehicle, "d", end_ns=10**18 + i), path=way))
        for i, vehicle in enumerate("abc")
    )
    with tempfile.TemporaryDirectory() as folder:
        store = Store.create(f"sqlite:///{folder}/s.db", point_map, Policy(fuse=POLICY))
        with in_process(store, owner="walker") as transport, httpx2.Client(transport=transport, base_url=URL) as client:
            for vehicle, ballot in (("a", first), ("b", second)):
                client.put(f"/v1/ballots/{vehicle}/d", content=ballot).raise_for_status()
            with counted(walk):
                act(client, third).raise_for_status()
        store.close()


def ballot(walk: Walk) -> None:
    """A third ballot is sent."""
    ask(walk, lambda client, third: client.put("/v1/ballots/c/d", content=third))


def desk(walk: Walk) -> None:
    """The review desk is opened."""
    ask(walk, lambda client, third: client.get("/v1/desk"))


def cell(walk: Walk) -> None:
    """The votes on a cell are explained."""
    ask(walk, lambda client, third: client.get("/v1/cells", params={"x": 30.0, "y": 3.0}))


def build(walk: Walk) -> None:
    """A map of a drive of 20 scans."""
    poses = path(20)
    drive = drive_along(poses, 1, poses, sigma_m=0.2)
    scans = list(drive)
    with counted(walk):
        build_map([replace(drive, read_scan=scans.__getitem__)])


def diagnosis(walk: Walk) -> None:
    """A drive of 20 scans on its map."""
    poses = path(20)
    drive = drive_along(poses, 1, poses)
    with tempfile.TemporaryDirectory() as folder:
        writer = DriveWriter(Path(folder) / "d", "v", drive.sensor, start_ns=0).open()
        for i in range(len(poses)):
            writer.write_scan(i, drive.read_scan(i).points)
        writer.close(drive.stamps_ns, poses)
        with counted(walk):
            diagnose(Path(folder) / "d", None, map_from_points(street(0)))


def evaluation(walk: Walk) -> None:
    """The corner is simulated, mapped, driven, voted on and scored, in one process."""
    with tempfile.TemporaryDirectory() as folder:
        scene = Scene("corner", 3, Settings(), Path(folder), {"rate_hz": 4.0, "sensor": "vlp16"})
        cases, _ = choose_cases(scene.settings, "1,3,5,surfaces")
        os.cpu_count = lambda: 1
        with counted(walk):
            evaluate(scene, cases)


WALKS = (scan, tile, ballot, desk, cell, build, diagnosis, evaluation)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--show", choices=[walk.__name__ for walk in WALKS], help="print one walk's handovers")
    options = parser.parse_args()
    for act in WALKS:
        if options.show in (None, act.__name__):
            walk = Walk()
            threading.setprofile(walk.watch)
            act(walk)
            threading.setprofile(None)
            doing = [file for file in walk.files if not file.startswith(SERVING)]
            print(
                f"| {act.__name__} | {len(walk.files)} | {len(doing)} | {len(walk.stays)} | "
                f"{walk.returns.total()} | {len(walk.returns)} |",
                flush=True,
            )
            if options.show:
                for pair in sorted(walk.stays):
                    print(*pair, sep="  ")
                for (calling, called), times in sorted(walk.returns.items()):
                    print("returns", calling, called, times, sep="  ")


if __name__ == "__main__":
    main()
