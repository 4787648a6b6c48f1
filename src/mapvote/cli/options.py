"""Options that several verbs share, so that they read the same everywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Scans = Annotated[str | None, typer.Option(help="Which scans: START:STOP:STEP slices, comma-separated: 0:12,24:36")]
Prior = Annotated[str | None, typer.Option(help="File of 3 x 4 rows T_map_lidar (a pose topic of a bag), or none")]
Rate = Annotated[float | None, typer.Option(help="Revolutions per second, where the drive has no times")]
SensorName = Annotated[
    str | None, typer.Option("--sensor", help="hdl32e, hdl64e, vlp16; else drive.toml, else a guess")
]
Vehicle = Annotated[str | None, typer.Option(help="Name of the vehicle; else drive.toml, else the drive's name")]
Mount = Annotated[str | None, typer.Option(help="T_base_lidar: x,y,z,roll,pitch,yaw (m, deg) or 12 numbers")]
Topic = Annotated[str | None, typer.Option(help="The PointCloud2 topic of a bag that has several")]
Config = Annotated[Path | None, typer.Option(help="TOML file of settings; mapvote config prints them all")]
