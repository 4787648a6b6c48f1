"""Arguments and options that several verbs share, so that they read the same everywhere, and the groups of verbs."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from mapvote.core.process_memory import seldom_collecting


class Panel(StrEnum):
    """Headings of ``mapvote --help``."""

    DRIVE = "Drive"
    MAP = "Map"
    SERVER = "Server"
    EVALUATE = "Simulate and evaluate"
    SETUP = "Set up"


Config = Annotated[Path | None, typer.Option(metavar="TOML", help="settings file; `mapvote config` lists all settings")]
Scenario = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="street570, as_published, clear, street, slanted, junction, terrace, half_gone, overhead, corner, or a "
        "TOML file",
    ),
]
Seed = Annotated[int, typer.Option(metavar="N", help="seed of layout, clutter, traffic and noise")]
StoreOrUrl = Annotated[
    str, typer.Argument(metavar="STORE|URL", help="a STORE (file, database URL or -), or its server's URL")
]
KeyFile = Annotated[
    Path | None, typer.Option(metavar="FILE", help="file with the key for the server; default: the key in $MAPVOTE_KEY")
]
Reason = Annotated[str, typer.Option(metavar="TEXT", help="a comment that the log keeps")]
Unchecked = Annotated[
    bool,
    typer.Option("--unchecked", help="write it even if a check of the drive finds an error, which becomes a warning"),
]
Rate = Annotated[
    float | None, typer.Option("--rate", metavar="HZ", help="revolutions per second, for a drive without times")
]
Projector = Annotated[
    str | None,
    typer.Option(metavar="FILE|TYPE", help="Autoware's map_projector_info.yaml, or MGRS:54SUE, LocalCartesian:LAT,LON"),
]
Topic = Annotated[
    str | None,
    typer.Option(metavar="TOPIC", help="PointCloud2 topic of a bag, several separated by commas; or scene of nuScenes"),
]
MotionCompensated = Annotated[
    bool | None,
    typer.Option(
        "--motion-compensated/--not-motion-compensated",
        help="points are de-skewed already / are not: without a field of times these follow from the azimuths",
    ),
]
TimeField = Annotated[
    str | None,
    typer.Option(metavar="NAME|none", help="the field with the times of points; default: recognised by its content"),
]
DRIVE_OPTIONS = {
    "scans": Annotated[
        str | None, typer.Option(metavar="SLICES", help="only these scans, as START:STOP:STEP, e.g. 0:12,24:36")
    ],
    "prior": Annotated[
        str | None,
        typer.Option(
            metavar="FILE|TOPIC|none", help="poses: a file (rows of 3 x 4, TUM, CSV, GNSS), a topic of the bag, or none"
        ),
    ],
    "rate_hz": Rate,
    "sensor": Annotated[
        str | None, typer.Option(metavar="NAME", help="LiDAR model; default: drive.toml, else measured in the scans")
    ],
    "mount": Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS", help="T_base_lidar as x,y,z,roll,pitch,yaw in metres and degrees, or 12 numbers"
        ),
    ],
    "topic": Topic,
    "columns": Annotated[
        str | None,
        typer.Option(
            metavar="NAMES", help="columns of .bin and .npy scans, e.g. x,y,z,intensity,ring; default: recognised"
        ),
    ],
    "dtype": Annotated[
        str | None, typer.Option(metavar="TYPE", help="type of the columns of .bin scans: float32 or float64")
    ],
    "motion_compensated": MotionCompensated,
    "time_field": TimeField,
    "time_unit": Annotated[
        str | None, typer.Option(metavar="UNIT", help="its unit: s, ms, us or ns; default: recognised by its content")
    ],
}
"""Options that describe a drive, by the argument names of ``formats.open_drive``."""


def with_drive_options(verb: Callable[..., None]) -> Callable[..., None]:
    """``verb`` with all DRIVE_OPTIONS on its command line; it receives them as the dict ``drive_options``."""

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
