"""Arguments and options that several verbs share, so that they read the same everywhere, and the groups of verbs."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from mapvote.core.process_memory import seldom_collecting

DRIVE, MAP, SERVER, EVALUATE, SETUP = "Drive", "Map", "Server", "Simulate and evaluate", "Set up"
"""Headings of ``mapvote --help``."""

Config = Annotated[Path | None, typer.Option(metavar="TOML", help="settings; `mapvote config` prints them all")]
DrivePath = Annotated[Path, typer.Argument(metavar="DRIVE", help="a recorded drive, in any format")]
MapPath = Annotated[Path, typer.Argument(metavar="MAP", help="a map, in any format")]
Scenario = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="street570, as_published, clear, street, slanted, junction, terrace, half_gone, corner, or a TOML file",
    ),
]
Seed = Annotated[int, typer.Option(metavar="N", help="decides layout, clutter, traffic and noise")]
StoreName = Annotated[
    str,
    typer.Argument(metavar="STORE", help="an SQLite file, a postgresql+psycopg:// URL, or - for $MAPVOTE_STORE"),
]
StoreOrUrl = Annotated[
    str, typer.Argument(metavar="STORE|URL", help="a STORE, or the address of the server that keeps it")
]
KeyFile = Annotated[
    Path | None, typer.Option(metavar="FILE", help="holds the key for that server; else $MAPVOTE_KEY is the key")
]
Reason = Annotated[str, typer.Option(metavar="TEXT", help="kept with the version")]
MinVotes = Annotated[
    int | None, typer.Option(min=1, metavar="N", help="vehicles that a change needs; default: the settings'")
]

FalseDeletions = Annotated[
    float | None,
    typer.Option(
        metavar="P",
        help="keep a cell's points while emptying it deletes what stands with a higher probability, such as 0.01",
    ),
]

Rate = Annotated[
    float | None, typer.Option("--rate", metavar="HZ", help="revolutions per second, where the drive has no times")
]
Projector = Annotated[
    str | None,
    typer.Option(metavar="FILE|TYPE", help="Autoware's map_projector_info.yaml, or MGRS:54SUE, LocalCartesian:LAT,LON"),
]
Topic = Annotated[
    str | None,
    typer.Option(
        metavar="TOPIC", help="which PointCloud2 topic of a bag (of one vehicle's several, with commas), or scene"
    ),
]
DRIVE_OPTIONS = {
    "scans": Annotated[
        str | None, typer.Option(metavar="SLICES", help="which scans: START:STOP:STEP, comma-separated: 0:12,24:36")
    ],
    "prior": Annotated[
        str | None,
        typer.Option(metavar="FILE|TOPIC|none", help="poses: rows of 3 x 4, TUM, CSV, GNSS; or a topic of a bag"),
    ],
    "rate_hz": Rate,
    "sensor": Annotated[
        str | None, typer.Option(metavar="NAME", help="a LiDAR model; else drive.toml, else measured in the scans")
    ],
    "mount": Annotated[
        str | None,
        typer.Option(metavar="NUMBERS", help="T_base_lidar: x,y,z,roll,pitch,yaw in metres and degrees, or 12 numbers"),
    ],
    "topic": Topic,
    "columns": Annotated[
        str | None, typer.Option(metavar="NAMES", help="of .bin and .npy scans: x,y,z,intensity,ring; else recognised")
    ],
    "dtype": Annotated[str | None, typer.Option(metavar="TYPE", help="of the columns of .bin scans: float32, float64")],
}
"""What the command line may say about a drive, by the names of ``formats.open_drive``."""


def with_drive_options(verb: Callable[..., None]) -> Callable[..., None]:
    """``verb`` with every one of DRIVE_OPTIONS on its command line, handed over together as its ``drive_options``."""

    @wraps(verb)
    def command(**arguments: Any) -> None:
        drive_options = {name: arguments.pop(name) for name in DRIVE_OPTIONS}
        with seldom_collecting():
            verb(**arguments, drive_options=drive_options)

    hints = get_type_hints(verb, include_extras=True)
    own = inspect.signature(verb).parameters.values()
    said = [p.replace(annotation=hints[p.name]) for p in own if p.name != "drive_options"]
    keyword = inspect.Parameter.KEYWORD_ONLY
    shared = [inspect.Parameter(name, keyword, default=None, annotation=kind) for name, kind in DRIVE_OPTIONS.items()]
    parameters = [p.replace(kind=keyword) for p in said] + shared
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    del command.__wrapped__
    return command
