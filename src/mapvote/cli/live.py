"""The verbs of a vehicle on ROS 2's network: topics, play, drive."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.door import client_of, is_url, key_in, map_at
from mapvote.cli.options import Config, KeyFile, MotionCompensated, Projector, TimeField

if TYPE_CHECKING:
    from mapvote.live.drive import LiveDrive
    from mapvote.live.outbox import Outbox
    from mapvote.live.road_map import Maps
    from mapvote.live.status import StatusBoard

Domain = Annotated[
    int | None, typer.Option(min=0, max=232, metavar="N", help="DDS domain; default: $ROS_DOMAIN_ID, else 0")
]


def topics(
    seconds: Annotated[float, typer.Option(min=0.5, metavar="SECONDS", help="how long to listen")] = 5.0,
    domain: Domain = None,
) -> None:
    """List the ROS 2 topics on this network with types and rates, and the topics that `drive` needs and are missing.

    mapvote topics
    """
    from mapvote.live.choice import missing_for_drive
    from mapvote.live.dds import Network, measure_rates

    network = Network(domain)
    rates = measure_rates(network, seconds)
    for one in rates:
        rate = "not read here" if one.rate_hz is None else f"{one.rate_hz:.1f} Hz"
        quality = "reliable" if one.published.reliable else "best effort"
        frame = f" in {one.frame}" if one.frame else ""
        print(f"{one.published.topic} [{one.published.kind}] {rate}, {quality}{frame}")
    for sentence in missing_for_drive(rates, network.domain):
        print(f"missing: {sentence}")


def show(
    ballot: Annotated[Path, typer.Argument(metavar="BALLOT", help="a ballot")],
    map_source: Annotated[str, typer.Option("--map", metavar="MAP|STORE|URL", help="the map that it was voted on")],
    mcap: Annotated[
        Path | None, typer.Option("--mcap", metavar="FILE", help="write an MCAP file, for Foxglove or RViz")
    ] = None,
    rrd: Annotated[Path | None, typer.Option("--rrd", metavar="FILE", help="write a recording for Rerun")] = None,
    key_file: KeyFile = None,
) -> None:
    """Show a ballot on its map in Foxglove, RViz or Rerun: points that come and go, states of cells, the road driven.

    mapvote show car_1.ballot --map my_map --mcap car_1.mcap
    """
    from mapvote.codec.ballot import decode
    from mapvote.core.types import MapvoteError
    from mapvote.formats.reading import read_whole, reading
    from mapvote.live.ballot_messages import map_cloud, messages_of_ballot
    from mapvote.live.mcap import write_mcap
    from mapvote.live.rerun_file import write_rrd

    if mcap is None and rrd is None:
        raise MapvoteError("show: give --mcap FILE, --rrd FILE, or both")
    with reading(ballot, "ballot"):
        shown = decode(read_whole(ballot))
    with map_at(map_source, key_file) as point_map:
        if shown.map_id != point_map.map_id:
            raise MapvoteError(
                f"{ballot}: voted on map {shown.map_id}, not on {point_map.map_id} of {map_source}; name its map"
            )
        messages = [map_cloud(shown, point_map), *messages_of_ballot(shown, point_map)]
    topics = ", ".join(f"/{message.topic}" for message in messages)
    if mcap is not None:
        write_mcap(mcap, [message.recorded for message in messages])
        print(f"{mcap}: {topics}")
    if rrd is not None:
        write_rrd(rrd, messages)
        print(f"{rrd}: {topics}, without the grid of states")


def play(
    path: Annotated[Path, typer.Argument(metavar="DRIVE|BAG", help="a ROS 2 bag, or a drive in any format")],
    rate: Annotated[float, typer.Option(min=0.01, metavar="N", help="speed, in multiples of the recorded one")] = 1.0,
    wait: Annotated[float, typer.Option(min=0.0, metavar="SECONDS", help="longest wait for a first reader")] = 600.0,
    loops: Annotated[
        int, typer.Option(min=1, metavar="N", help="send the drive N times, each time with the same stamps")
    ] = 1,
    domain: Domain = None,
) -> None:
    """Send a recorded drive or ROS 2 bag on DDS, as a vehicle would.

    mapvote play my_bag
    """
    from mapvote.live.dds import Network
    from mapvote.live.play import play as play_drive

    network = Network(domain)
    print(f"{path}: waits up to {wait:.0f} s for a first reader", flush=True)
    print(f"{path}: {play_drive(path, network, rate=rate, wait_s=wait, loops=loops)} messages sent")


def drive(
    map_source: Annotated[
        str, typer.Option("--map", metavar="MAP|URL", help="a map in any format, or the URL of a server")
    ],
    vehicle: Annotated[str, typer.Option(metavar="NAME", help="name of the vehicle in its ballots")],
    sensor: Annotated[
        str | None, typer.Option(metavar="NAME", help="LiDAR model; default: measured in the first ten scans")
    ] = None,
    points: Annotated[
        str | None,
        typer.Option(
            metavar="TOPICS", help="PointCloud2 topic, several LiDARs separated by commas; default: the only one"
        ),
    ] = None,
    odometry: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="topic of poses (Odometry, PoseStamped, PoseWithCovarianceStamped), of fixes (NavSatFix), or /tf",
        ),
    ] = None,
    mount: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS",
            help="pose of the LiDAR in the odometry's body: x,y,z,roll,pitch,yaw; default: /tf_static",
        ),
    ] = None,
    motion_compensated: MotionCompensated = None,
    time_field: TimeField = None,
    send: Annotated[str | None, typer.Option(metavar="URL", help="send the ballots to this server")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="write the ballots into this folder")] = None,
    key_file: KeyFile = None,
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="name of the drive; default: the time of its start")
    ] = None,
    every_m: Annotated[
        float, typer.Option(min=1.0, metavar="METRES", help="longest stretch of road in one ballot")
    ] = 2000.0,
    idle: Annotated[float, typer.Option(metavar="SECONDS", help="end after this time without a cloud; 0: never")] = 0.0,
    metrics: Annotated[
        int | None,
        typer.Option(min=0, max=65535, metavar="PORT", help="serve Prometheus metrics on this port of 127.0.0.1"),
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", help="show a live view in the terminal instead of the log")] = False,
    unchecked: Annotated[
        bool,
        typer.Option(
            "--unchecked", help="vote even if the checks of the first ten seconds, or of the places of scans, fail"
        ),
    ] = False,
    domain: Domain = None,
    namespace: Annotated[
        str, typer.Option(metavar="NAME", help="ROS 2 namespace of the vehicle's topics, for example /car1")
    ] = "",
    tf: Annotated[str, typer.Option(metavar="TOPIC", help="topic of moving frames; default: /tf")] = "",
    tf_static: Annotated[str, typer.Option(metavar="TOPIC", help="topic of fixed frames; default: /tf_static")] = "",
    remap: Annotated[
        list[str] | None, typer.Option("-r", "--remap", metavar="FROM:=TO", help="remap a topic, as in ROS 2")
    ] = None,
    parameter: Annotated[
        list[str] | None, typer.Option("-p", "--param", metavar="NAME:=VALUE", help="use_sim_time:=true")
    ] = None,
    ros_args: Annotated[
        bool, typer.Option("--ros-args", hidden=True, help="begins options of ROS 2; changes nothing")
    ] = False,
    threads: Annotated[
        int | None, typer.Option(min=1, metavar="CORES", help="run on at most this many processor cores")
    ] = None,
    nice: Annotated[
        int | None, typer.Option(min=-20, max=19, metavar="N", help="lower the priority by this, as nice(1) does")
    ] = None,
    keep_doubt: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="keep ten seconds of clouds around each doubtful change here")
    ] = None,
    keep_doubt_mb: Annotated[
        int, typer.Option(min=1, metavar="MB", help="size of that folder at most; the oldest clouds go first")
    ] = 2000,
    config: Config = None,
) -> None:
    """Vote while driving, from ROS 2 topics. A ballot closes every 2 km, every 10 minutes and after 2 minutes at rest.

    mapvote drive --map URL --vehicle car_1 --send URL
    """
    import logging
    import math
    import time
    from dataclasses import replace

    from mapvote.config import load_settings
    from mapvote.core.extras import require
    from mapvote.core.types import MapvoteError
    from mapvote.formats.drives.options import read_mount, read_sensor
    from mapvote.formats.drives.point_times import TimeRules
    from mapvote.formats.geo.frame import frame_of
    from mapvote.live.changes_topics import ChangesTopics
    from mapvote.live.choice import Voice, Wish, choose_topics
    from mapvote.live.dds import Network
    from mapvote.live.doubt import DoubtKeeper
    from mapvote.live.messages import POSE_TOPIC
    from mapvote.live.names import ros_names, sim_time_of
    from mapvote.live.process import limit_process
    from mapvote.live.service import Plan, Watcher, run
    from mapvote.live.status import Heartbeat, RosStatus, StatusBoard, serve_metrics
    from mapvote.live.subscriptions import Subscriptions
    from mapvote.vehicle import Cuts
    from mapvote.warmup import warm_vehicle

    if out is None and send is None:
        raise MapvoteError("drive: give --send URL, --out FOLDER, or both")
    # Packages that are missing are named before kernels are compiled and topics are waited for.
    require("cyclonedds.domain", "ros2", "mapvote drive")
    require("rosbags.typesys", "ros2", "mapvote drive")
    if metrics is not None:
        require("prometheus_client", "server", "--metrics")
    limit_process(threads, nice)
    logging.getLogger("mapvote.live").setLevel(logging.INFO)
    plan = Plan(
        vehicle,
        name or time.strftime("%Y%m%dT%H%M%SZ", time.gmtime()),
        load_settings(config),
        Cuts(length_m=every_m),
        None if mount is None else read_mount(mount, "--mount"),
        idle,
        not unchecked,
    )
    frames = [f"{topic}:={to}" for topic, to in (("/tf", tf), ("/tf_static", tf_static)) if to]
    names = ros_names(namespace, [*(remap or []), *frames])
    sim_time = sim_time_of(parameter or [])
    voice = Voice(lambda text: print(text, flush=True))
    model = None if sensor is None else read_sensor(sensor, "--sensor")
    network = Network(domain)
    stopped = [False]
    heartbeat = Heartbeat()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.append(True))

    def ended() -> bool:
        heartbeat()
        return stopped[-1]

    with maps_around(map_source, key_file) as maps, outbox_to(vehicle, send, out, key_in(key_file)) as outbox:
        warm_vehicle(plan.settings)
        heartbeat.ready()
        on_earth = frame_of(maps.current().georeference)
        odometry_topic = next(iter(names.named("odometry", odometry)), None)
        wish = Wish(names.named("points", points), odometry_topic, names, not on_earth.is_local)
        chosen = choose_topics(network, wish, voice, ended, idle or math.inf)
        if chosen is None:
            return
        listened = [one.topic for one in (*chosen.points, *filter(None, [chosen.odometry]))]
        print(f"listening to {' and '.join(listened)}", flush=True)
        rules = TimeRules(motion_compensated, time_field)
        topics = Subscriptions(network, chosen, model, names, sim_time=sim_time, rules=rules, on_earth=on_earth)
        ros = RosStatus(network, vehicle, names.resolve(POSE_TOPIC))
        board = StatusBoard(maps, outbox)
        board.tell(1.0, ros.diagnose)
        if metrics is not None:
            print(f"metrics at http://127.0.0.1:{serve_metrics(board, metrics)}/metrics", flush=True)
        with _view(board, vehicle) if watch else nullcontext():
            if not watch:
                board.tell(60.0, lambda status, *_: print(status.line(), flush=True))
            watchers: list[Watcher] = [board, ros.poses, ChangesTopics(network, names)]
            keeper = None if keep_doubt is None else DoubtKeeper(keep_doubt, 10**6 * keep_doubt_mb)
            with nullcontext() if keeper is None else closing(keeper):
                live = run(replace(plan, doubt=keeper), topics, maps, outbox, ended, watchers, voice)
        heartbeat.stopping()
    print(f"{vehicle}: {_result(live)}")


@contextmanager
def _view(board: StatusBoard, vehicle: str) -> Iterator[None]:
    """A live view of the drive in the terminal."""
    from rich.live import Live

    with Live(auto_refresh=False) as view:
        board.tell(0.5, lambda status, *_: view.update(status.table(vehicle), refresh=True))
        yield


@contextmanager
def maps_around(map_source: str, key_file: Path | None) -> Iterator[Maps]:
    """The tiles around the vehicle of a server's map, or a whole map from a file or store."""
    from mapvote.live.road_map import OneMap, RoadMap

    if is_url(map_source):
        with closing(RoadMap(lambda: client_of(map_source, key_in(key_file)))) as road_map:
            yield road_map
        return
    with map_at(map_source, key_file, or_kept=True) as point_map:
        yield OneMap(point_map)


@contextmanager
def outbox_to(vehicle: str, url: str | None, folder: Path | None, key: str | None) -> Iterator[Outbox]:
    """The outbox of the ballots; at its end it sends what can be sent now."""
    from mapvote.config import cache_folder
    from mapvote.live.outbox import Outbox

    with ExitStack() as stack:
        client = None if url is None else stack.enter_context(client_of(url, key))
        outbox = Outbox(
            cache_folder() / "live", vehicle, client=client, folder=folder, say=lambda text: print(text, flush=True)
        )
        try:
            yield outbox
        finally:
            outbox.close()


def _result(live: LiveDrive | None) -> str:
    """The result of the drive, in one line."""
    import numpy as np

    if live is None:
        return "no cloud came"
    c = live.counts
    latencies_s = live.latencies_s
    latency = ", ".join(f"{s:.2f} s" for s in np.quantile(latencies_s, (0.5, 0.99))) if latencies_s else "none"
    return (
        f"{c.ballots} ballots, {c.localised} of {c.scans} scans voted, {c.lost} lost, "
        f"{c.left_out} scans left out, {c.without_pose} without odometry, {c.without_map} without map, "
        f"{c.unusable} unusable, {c.late} late, {c.missing} never came; latency p50, p99: {latency}"
    )


def autoware(
    url: Annotated[str, typer.Argument(metavar="URL", help="the server with the map")],
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="folder that is kept at the newest version, in Autoware's tiles")
    ],
    projector: Projector = None,
    keep: Annotated[int, typer.Option(min=0, metavar="N", help="number of older versions whose tiles stay")] = 3,
    every: Annotated[float, typer.Option(min=0.1, metavar="SECONDS", help="seconds between two requests")] = 5.0,
    key_file: KeyFile = None,
    domain: Domain = None,
) -> None:
    """Serve the newest map to a running Autoware on rmw_cyclonedds, in place of its map loader. No ROS is needed.

    mapvote autoware https://maps.example.org map --key-file key
    """
    import os
    import threading

    from mapvote.cli.files import follow_once
    from mapvote.formats.maps.autoware import check_followed
    from mapvote.live.dds import Network
    from mapvote.live.following import Follower, serve_followed
    from mapvote.live.map_loader import LoaderService, MapLoader

    def say(text: str) -> None:
        print(f"{folder}: {text}", flush=True)

    check_followed(folder)
    implementation = os.environ.get("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    if implementation != "rmw_cyclonedds_cpp":
        say(f"RMW_IMPLEMENTATION={implementation}: only nodes on rmw_cyclonedds_cpp get answers; see docs/autoware.md")
    stopped = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.set())
    service = LoaderService(Network(domain), MapLoader(folder))
    with client_of(url, key_in(key_file)) as client:
        follower = Follower(lambda: follow_once(client, folder, projector, keep), every, stopped, say)
        serve_followed(service, follower, stopped, say)
    print(f"{service.answered} requests answered")


def send(
    ballots: Annotated[
        list[Path], typer.Argument(metavar="BALLOT|FOLDER...", help="ballots, or folders whose *.ballot are sent")
    ],
    to: Annotated[str, typer.Option("--to", metavar="URL", help="the server")],
    key_file: KeyFile = None,
) -> None:
    """Send ballots that were made offline to a server, one by one; the outcome of each is printed.

    Run the same command again after the server was away: a ballot that it has is not counted twice.

        mapvote send ballots/ --to https://maps.example.org --key-file key
    """
    from mapvote.core.types import MapvoteError
    from mapvote.live.depot import send_all

    files = []
    for path in ballots:
        within = [f for f in path.rglob("*") if f.suffix.lower() == ".ballot"] if path.is_dir() else [path]
        if not within:
            raise MapvoteError(f"{path}: holds no *.ballot")
        files += sorted(within)
    with client_of(to, key_in(key_file)) as client:
        done = send_all(client, files, lambda text: print(text, flush=True))
    print(f"{to}: {done.told()}")
    if done.unsent:
        raise typer.Exit(1)
