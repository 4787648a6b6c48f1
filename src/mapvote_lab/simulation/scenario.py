"""Scenarios are data: scenarios/*.toml or a file of the user's own. An unknown key is an error."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mapvote.config import wanted_of
from mapvote.core.sensors import NAMED
from mapvote.core.types import MapvoteError


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class PlannedChange(_Table):
    """Buildings built or demolished between the survey and the vehicles, side by side."""

    kind: Literal["built", "demolished"]
    side: Literal["north", "south"]
    from_m: float
    to_m: float
    count: int = Field(default=1, ge=1)


class TrafficDensity(_Table):
    """Mean distances between moving bodies on a lane, a kerb side, a sidewalk, metres; 0 = none of them."""

    car_spacing_m: float = Field(default=30.0, ge=0)
    two_wheeler_spacing_m: float = Field(default=35.0, ge=0)
    pedestrian_spacing_m: float = Field(default=14.0, ge=0)


class Clutter(_Table):
    """How cluttered the street is: mean distances along each side, metres; 0 = none of them."""

    tree_spacing_m: float = Field(default=14.0, ge=0)
    pole_spacing_m: float = Field(default=28.0, ge=0)
    sign_spacing_m: float = Field(default=35.0, ge=0)
    furniture_spacing_m: float = Field(default=22.0, ge=0)
    parked_share: float = Field(default=0.35, ge=0, le=1, description="share of kerbside slots with a car that stays")
    visitor_share: float = Field(default=0.05, ge=0, le=1, description="share with a car that differs by pass")
    rail_share: float = Field(default=0.3, ge=0, le=1, description="share of the kerb behind a guard rail")
    gantry_m: tuple[float, ...] = ()


class Flaws(_Table):
    """False returns of the LiDAR (simulation/flaws.py). All shares 0: none."""

    reflection_share: float = Field(
        default=0.001,
        ge=0,
        le=0.1,
        description="share of a scan's points that came over a mirror: wet road, glass, cars",
    )
    mixed_share: float = Field(
        default=0.5, ge=0, le=1, description="share of the rays at an edge that report a mixture"
    )
    wet_share: float = Field(default=0.05, ge=0, le=1, description="share of the road that is wet, in patches of 2 m")
    glass_share: float = Field(default=0.15, ge=0, le=1, description="share of the facades that is glass, in panes")
    dark_share: float = Field(default=0.15, ge=0, le=1, description="share of the vehicles with dark paint")
    rain: float = Field(default=0.0, ge=0, le=1, description="share of the rays that meet a drop near the sensor")
    exhaust: float = Field(default=0.0, ge=0, le=1, description="share of the moving bodies with a plume behind them")
    range_sigma_m: float | None = Field(default=None, ge=0, description="range noise; None: that of the sensor's model")


class Overhead(_Table):
    """Objects over the street (simulation/overhead.py), metres along it; none by default."""

    wire_m: tuple[float, ...] = Field(default=(), description="three wires across, from facade to facade")
    bridge_m: tuple[float, ...] = Field(default=(), description="a foot-bridge across, its piers out of sight")
    board_m: tuple[float, ...] = Field(default=(), description="a board before the facades, on both sides")
    over_demolished: bool = Field(
        default=False,
        description="over each house that goes: a crown, a wire, a viaduct, their support out of sight",
    )


class Scenario(_Table):
    """A street, what changes on it, who drives there and what they carry."""

    name: str
    length_m: float = Field(gt=20)
    width_m: float = Field(gt=40, description="the scored window, the road in its middle")
    speed_kmh: float = Field(default=40.0, gt=0)
    surveys: tuple[str, ...] = ("east inner", "west inner")
    vehicles: int = Field(default=3, ge=1, le=10)
    vehicle_lanes: tuple[str, ...] = ("east outer", "east inner", "west inner")
    sensor: str = "hdl32e"
    rate_hz: float = Field(
        default=10.0, gt=0, description="scans recorded per second; the sensor turns no slower than its model"
    )
    mount_height_m: float = 1.9
    motion_distortion: bool = True
    heading_deg: float = Field(
        default=0.0, ge=-180, le=180, description="of the road, from the map's x axis; 0: walls run along its cells"
    )
    max_grade: float = Field(default=0.03, ge=0, le=0.12)
    crown: float = Field(default=0.02, ge=0)
    crossing_m: float | None = Field(default=None, description="where a second street crosses, metres from the west")
    house_m: float | None = Field(
        default=None, gt=7, description="every house of the front row is the same one, this wide, wall to wall"
    )
    blocks: bool = Field(
        default=False,
        description="the front row are plain blocks with flat roofs, near the sidewalk; no second row",
    )
    temporary_cars: int = Field(default=0, ge=0, description="extra cars parked during one vehicle's pass only")
    traffic: TrafficDensity = TrafficDensity()
    clutter: Clutter = Clutter()
    flaws: Flaws = Flaws()
    overhead: Overhead = Overhead()
    changes: tuple[PlannedChange, ...] = ()


def scenario_names() -> list[str]:
    """Scenarios that come with mapvote."""
    return sorted(p.name.removesuffix(".toml") for p in resources.files(__package__).joinpath("scenarios").iterdir())


def load_scenario(scenario: str | Path, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """A scenario by name or TOML file; ``overrides`` replace fields, key by key in its
    tables. MapvoteError names a key that does not exist."""
    path = Path(scenario)
    if path.suffix == ".toml":
        if not path.is_file():
            raise MapvoteError(f"{path}: no such scenario file")
        text = path.read_text()
    elif str(scenario) in scenario_names():
        text = resources.files(__package__).joinpath("scenarios", f"{scenario}.toml").read_text()
    else:
        raise MapvoteError(
            f"no scenario '{scenario}': choose one of {', '.join(scenario_names())} or give a .toml file"
        )
    try:
        table = tomllib.loads(text)
        for key, value in (overrides or {}).items():
            table[key] = {**table.get(key, {}), **value} if isinstance(value, Mapping) else value
        scenario_read = Scenario.model_validate(table)
    except tomllib.TOMLDecodeError as error:
        raise MapvoteError(f"scenario {scenario}: not TOML ({error})") from error
    except ValidationError as error:
        first = error.errors()[0]
        raise MapvoteError(
            f"scenario {scenario}: {'.'.join(str(part) for part in first['loc'])}: {wanted_of(first)} "
            f"(known keys: {', '.join(Scenario.model_fields)})"
        ) from error
    if scenario_read.sensor not in NAMED:
        raise MapvoteError(
            f"scenario {scenario}: sensor '{scenario_read.sensor}' unknown; choose one of {', '.join(NAMED)}"
        )
    for lane in (*scenario_read.surveys, *scenario_read.vehicle_lanes):
        if lane not in LANES:
            raise MapvoteError(f"scenario {scenario}: lane '{lane}' unknown; choose one of {', '.join(LANES)}")
    return scenario_read


LANES: dict[str, tuple[int, float]] = {
    "east outer": (1, 5.25),
    "east inner": (1, 1.75),
    "west inner": (-1, -1.75),
    "west outer": (-1, -5.25),
}
"""Direction of travel along x and offset of the lane's middle from the road's axis, metres (traffic keeps left)."""
