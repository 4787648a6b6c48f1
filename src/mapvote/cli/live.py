"""The verbs of a vehicle on ROS 2's network: topics, play, drive."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapvote.cli.options import DRIVE, Config, KeyFile, key_in
from mapvote.cli.remote import client_of, map_at

if TYPE_CHECKING:
    from mapvote.codec.ballot import Ballot

Domain = Annotated[int | None, typer.Option(min=0, max=232, metavar="N", help="else ROS_DOMAIN_ID, else 0")]


def register(app: typer.Typer) -> None:
    """Add the verbs to ``app``."""
    for verb in (topics, play, drive):
        app.command(rich_help_panel=DRIVE)(verb)


def topics(
    seconds: Annotated[float, typer.Option(min=0.5, metavar="SECONDS", help="how long to listen")] = 5.0,
    domain: Domain = None,
) -> None:
    """List the ROS 2 topics that are sent on this network with types and rates, and what a vehicle lacks among them.

    mapvote topics
    """
    from mapvote.live.dds import Network
    from mapvote.live.topics import listen, missing_for_drive

    found = listen(Network(domain), seconds)
    for one in found:
        rate = "not read here" if one.rate_hz is None else f"{one.rate_hz:.1f} Hz"
        quality = "reliable" if one.heard.reliable else "best effort"
        frame = f" in {one.frame}" if one.frame else ""
        print(f"{one.heard.topic} [{one.heard.kind}] {rate}, {quality}{frame}")
    for sentence in missing_for_drive(found):
        print(f"missing: {sentence}")


def play(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help="a ROS 2 bag, sqlite3 or MCAP")],
    rate: Annotated[float, typer.Option(min=0.01, metavar="N", help="times as fast as recorded")] = 1.0,
    wait: Annotated[float, typer.Option(min=0.0, metavar="SECONDS", help="for a first reader, at most")] = 60.0,
    domain: Domain = None,
) -> None:
    """Send a recorded ROS 2 bag on DDS, its messages as they were recorded: a vehicle without a vehicle.

    mapvote play my_bag
    """
    from mapvote.live.dds import Network
    from mapvote.live.play import play as play_bag

    print(f"{bag}: {play_bag(bag, Network(domain), rate=rate, wait_s=wait)} messages sent")


def drive(
    where: Annotated[str, typer.Option("--map", metavar="MAP|URL", help="a map in any format, or a server's")],
    vehicle: Annotated[str, typer.Option(metavar="NAME", help="whose ballots")],
    sensor: Annotated[str, typer.Option(metavar="NAME", help="the LiDAR's model; mapvote info DRIVE measures it")],
    points: Annotated[str | None, typer.Option(metavar="TOPIC", help="of PointCloud2; else the only one")] = None,
    odometry: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="of Odometry in the map's frame; else the only one, if any")
    ] = None,
    mount: Annotated[
        str | None, typer.Option(metavar="NUMBERS", help="the LiDAR on what odometry tracks: x,y,z,roll,pitch,yaw")
    ] = None,
    send: Annotated[str | None, typer.Option(metavar="URL", help="the server that the ballots go to")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="the folder that the ballots go to")] = None,
    key_file: KeyFile = None,
    name: Annotated[str | None, typer.Option(metavar="NAME", help="of the drive; else the time it began")] = None,
    every_m: Annotated[float, typer.Option(min=1.0, metavar="METRES", help="of road a ballot, at most")] = 2000.0,
    idle: Annotated[float, typer.Option(metavar="SECONDS", help="end after so long without a cloud; 0: never")] = 0.0,
    domain: Domain = None,
    config: Config = None,
) -> None:
    """Vote while driving, from ROS 2 topics: a ballot leaves every 2 km, 10 minutes or stop of 2 minutes.

    mapvote drive --map URL --sensor hdl32e --vehicle car_1 --send URL
    """
    import time

    from mapvote.config import load_settings
    from mapvote.core.types import MapvoteError
    from mapvote.formats.drives.options import read_mount, read_sensor
    from mapvote.live.dds import Network
    from mapvote.live.drive import LiveDrive, choose_topics, messages
    from mapvote.vehicle import Cuts, Vehicle

    if out is None and send is None:
        raise MapvoteError("drive: say where the ballots go: --send URL, --out FOLDER, or both")
    model, key, network, stopped = read_sensor(sensor, "--sensor"), key_in(key_file), Network(domain), [False]
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.append(True))
    with map_at(where, key_file) as point_map:
        started = name or time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        voter = Vehicle(vehicle, model, point_map, load_settings(config), drive_id=started)
        live = LiveDrive(voter, Cuts(length_m=every_m), _sender(send, key, out), read_mount(mount, "--mount"))
        chosen = choose_topics(network, points, odometry, patience_s=idle or 1e9)
        print(f"listening to {chosen.points.topic}" + (f" and {chosen.odometry.topic}" if chosen.odometry else ""))
        last = time.monotonic()
        for what, value in messages(network, chosen, model, lambda: stopped[-1]):
            if what == "pose":
                live.on_pose(*value)
            elif what == "scan":
                live.on_scan(value)
                last = time.monotonic()
            else:
                if live.step(chosen.odometry is not None):
                    last = time.monotonic()
                if idle and time.monotonic() > last + idle:
                    break
        live.finish()
    print(f"{vehicle}: {live.closed + 1} ballots, {live.left_out} scans left out, {live.without_pose} without odometry")


def _sender(url: str | None, key: str | None, out: Path | None) -> Callable[[Callable[[], Ballot]], None]:
    """What writes and sends a ballot that was closed. One that says nothing is left out, and said."""
    from mapvote.codec.ballot import encode
    from mapvote.core.types import MapvoteError
    from mapvote.formats.atomic import whole_file

    def leave(written: Callable[[], Ballot]) -> None:
        try:
            ballot = written()
        except MapvoteError as error:
            print(f"no ballot: {error}", flush=True)
            return
        data, result = encode(ballot), ""
        if out is not None:
            with whole_file(out / f"{ballot.vehicle}~{ballot.drive}.ballot") as partial:
                partial.write_bytes(data)
        if url is not None:
            with client_of(url, key) as client:
                try:
                    result = client.send(data)
                except MapvoteError as error:
                    result = str(error)
        print(f"{ballot.drive}: {ballot.scans_localised} of {ballot.scans} scans voted {result}", flush=True)

    return leave
