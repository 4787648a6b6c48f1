"""A bag is played on DDS, a vehicle drives by it: its ballots are those of `vote` on the same bag and cuts."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import pytest

from bag_recorder import START, Recorder
from command_line import type_in
from mapvote.codec.ballot import encode
from mapvote.core.geometry import from_xyz_rpy, interpolate, inverse, transform
from mapvote.core.point_map import map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Scan
from mapvote.formats import open_drive, read_map, write_map
from mapvote.formats.drives.frames import BASE_FRAME
from mapvote.formats.drives.ros_types import CLOUD, GNSS, IMU, ODOMETRY, TF
from mapvote.formats.geo.frame import MapFrame
from mapvote.live.play import cloud_message, frames_message, odometry_message
from mapvote.vehicle import Cuts, Vehicle, vote_in_stretches
from receiver_messages import fix_message, imu_message
from streets import path, street, sweep, twist_of

pytest.importorskip("cyclonedds")
SCANS = 40


def record(
    bag: Path,
    world: Callable[[int], F64] = lambda i: street(1000 + i, 0.6),
    points: str = "/points",
    odometry: str = "/odometry",
) -> None:
    """A drive through ``world``, of which each scan measures other points."""
    recorder, poses = Recorder(bag), path(SCANS)
    for i, T in enumerate(poses):
        ns = START + i * 100_000_000
        scan = sweep(world(i), T, twist_of(poses, i), ns)
        recorder.write_raw(odometry, ODOMETRY, ns, odometry_message(ns, T))
        recorder.write_raw(points, CLOUD, ns, cloud_message(Scan(ns, scan.points), BASE_FRAME))
    recorder.bag.close()


def assert_live_and_recorded_alike(home: Path, domain: int, both: str = "", live: str = "") -> None:
    """Play ``home``/bag for a live drive on ``home``/map: every scan votes, and the ballots are those of `vote --cuts`.
    Options of ``both``, and of the ``live`` drive alone."""
    for folder in ("live", "offline"):
        (home / folder).mkdir()
    play = f"play {home}/bag --domain {domain} --rate 0.2 --wait 600"
    player = subprocess.Popen([sys.executable, "-m", "mapvote", *play.split()])
    drive = f"--map {home}/map --vehicle car --name day {both} --every-m 12"
    try:
        said = type_in(f"mapvote drive {drive} {live} --idle 20 --out {home}/live --domain {domain}")
    finally:
        player.wait(120)
    offline = type_in(f"mapvote vote {home}/bag {drive} --cuts --out {home}/offline")
    ballots = {folder: {f.name: f.read_bytes() for f in (home / folder).iterdir()} for folder in ("live", "offline")}
    assert f"{SCANS} of {SCANS} scans voted" in said, said + offline
    assert len(ballots["live"]) >= 2
    assert ballots["live"] == ballots["offline"], said + offline


@pytest.mark.slow
def test_a_live_drive_by_a_played_bag_casts_the_ballots_of_vote_on_that_bag_bit_for_bit(
    tmp_path: Path, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    bag, folder = tmp_path / "bag", tmp_path / "ballots"
    record(bag)
    write_map(map_from_points(street(1)), tmp_path / "map")
    folder.mkdir()
    options = ["--domain", str(domain), "--rate", "0.5", "--wait", "3600"]
    player = subprocess.Popen([sys.executable, "-m", "mapvote", "play", str(bag), *options])
    try:
        said = type_in(
            f"mapvote drive --map {tmp_path}/map --sensor hdl32e --vehicle car --name day --every-m 12 --idle 20 "
            f"--out {folder} --domain {domain}"
        )
    finally:
        player.wait(120)
    drive = open_drive(bag, sensor="hdl32e", vehicle="car", prior="/odometry")
    voter = Vehicle("car", SENSORS["hdl32e"], read_map(tmp_path / "map"), drive_id="day")
    named = replace(drive, drive_id="day")
    wanted = [stretch.written() for stretch in vote_in_stretches(named, voter, Cuts(length_m=12.0))]
    assert " 0 scans left out, 0 without odometry" in said
    assert len(wanted) >= 2
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == {f"car~{b.drive}.ballot": encode(b) for b in wanted}


@pytest.mark.slow
def test_vote_on_a_bag_with_no_option_chooses_what_a_live_drive_chooses_and_the_ballots_are_equal_bit_for_bit(
    tmp_path: Path, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Odometry at 50 Hz in a frame of its own, a LiDAR upside down by /tf_static, a sensor to measure."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    hung = from_xyz_rpy(0.0, 0.0, 0.0, np.pi)
    mount = from_xyz_rpy(1.2, 0.1, 1.5, 0.0, 0.02, 0.05) @ hung
    T_odom_map = from_xyz_rpy(100.0, 50.0, 0.0, 0.0, 0.0, 0.6)
    recorder, poses = Recorder(tmp_path / "bag"), path(SCANS)
    recorder.write_raw("/tf_static", TF, START, frames_message(START, {"lidar": mount}))
    bodies = [T_odom_map @ T @ hung @ inverse(mount) for T in poses]
    for i, T in enumerate(poses):
        ns = START + i * 100_000_000
        for k in range(5):
            at_ns = ns + k * 20_000_000
            T_body = interpolate(bodies[i], bodies[min(i + 1, SCANS - 1)], 0.2 * k)
            recorder.write_raw("/wheels", ODOMETRY, at_ns, odometry_message(at_ns, T_body, "odom"))
            if k == 0:
                points = transform(inverse(hung), sweep(street(1000 + i, 0.6), T, twist_of(poses, i), ns).points)
                recorder.write_raw("/lidar", CLOUD, ns, cloud_message(Scan(ns, points.astype(np.float32)), "lidar"))
    recorder.bag.close()
    write_map(map_from_points(street(1)), tmp_path / "map")
    assert_live_and_recorded_alike(tmp_path, domain)


@pytest.mark.slow
def test_a_vehicle_with_satellite_fixes_and_an_imu_alone_votes_with_every_scan_live_and_recorded_alike(
    tmp_path: Path, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fixes of 2 m at 1 Hz, whose heights count from an ellipsoid; an IMU at 50 Hz that does not know north."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    frame = MapFrame("EPSG:32632", (457_000.0, 5_428_000.0, 0.0))
    noise = np.random.default_rng(4).normal(0.0, 2.0, (SCANS, 3))
    recorder, poses = Recorder(tmp_path / "bag"), path(SCANS)
    recorder.write_raw("/tf_static", TF, START, frames_message(START, {"lidar": np.eye(4)}))
    for i, T in enumerate(poses):
        ns = START + i * 100_000_000
        for k in range(5):
            at_ns = ns + k * 20_000_000
            yaw_rad = float(np.arctan2(T[1, 0], T[0, 0])) + 1.0
            recorder.write_raw("/imu", IMU, at_ns, imu_message(at_ns, yaw_rad))
        if i % 10 == 0:
            place = frame.to_lonlat((T[:3, 3] + noise[i] + [0.0, 0.0, 47.0])[None])[0]
            recorder.write_raw("/fix", GNSS, ns, fix_message(ns, place, sigma_m=2.0))
        scan = sweep(street(1000 + i, 0.6), T, twist_of(poses, i), ns)
        recorder.write_raw("/lidar", CLOUD, ns, cloud_message(Scan(ns, scan.points), "lidar"))
    recorder.bag.close()
    town = replace(map_from_points(street(1)), georeference=frame.georeference())
    write_map(town, tmp_path / "map")
    assert_live_and_recorded_alike(tmp_path, domain, "--sensor hdl32e", live="--odometry /fix")


@pytest.mark.slow
def test_no_ballot_is_lost_or_comes_twice_after_kills_with_and_without_a_server(tmp_path: Path) -> None:
    record(tmp_path / "bag")
    write_map(map_from_points(street(1)), tmp_path / "map")
    bench = Path(__file__).parents[2] / "benchmarks/live.py"
    kills = os.environ.get("KILLS", "2")
    arguments = ["kills", tmp_path / "bag", tmp_path / "map", "--kills", kills, "--longest", "30"]
    result = subprocess.run([sys.executable, *map(str, [bench, *arguments])], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 lost, 0 twice" in result.stdout


@pytest.mark.slow
def test_a_first_start_without_a_compiled_kernel_is_ready_when_it_is_and_never_silent_for_20_s(
    tmp_path: Path, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """systemd is played: what the service says to it, with the times."""
    record(tmp_path / "bag")
    write_map(map_from_points(street(1)), tmp_path / "map")
    (tmp_path / "ballots").mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "numba"))
    drive = f"drive --map {tmp_path}/map --sensor hdl32e --vehicle car --idle 15 --out {tmp_path}/ballots"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(120.0)
        command = [sys.executable, "-m", "mapvote", *drive.split(), "--domain", str(domain)]
        environment = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify")}
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
        play = [sys.executable, "-m", "mapvote", "play", str(tmp_path / "bag"), "--domain", str(domain)]
        player = subprocess.Popen([*play, "--rate", "0.5", "--wait", "600"])
        came = list[tuple[float, str]]()
        while not came or came[-1][1] != "STOPPING=1":
            text = systemd.recv(100).decode()
            came.append((time.monotonic(), text))
        said, _ = process.communicate(timeout=60)
        player.wait(60)
    order = [text for text, _ in groupby(text for _, text in came)]
    assert order == ["EXTEND_TIMEOUT_USEC=30000000", "READY=1", "WATCHDOG=1", "STOPPING=1"]
    assert max(b - a for (a, _), (b, _) in pairwise(came)) < 20.0
    assert "1 ballots, 40 of 40 scans voted" in said
