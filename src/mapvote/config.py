"""Every setting of every module on one page. TOML in and out; an unknown key is an error.

Ratios, not scan counts: nothing here needs retuning for another scan rate or number of beams.
"""

from __future__ import annotations

import difflib
import hashlib
import os
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mapvote.core.types import MapvoteError


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class NdtLevel(Section):
    """One step of the coarse-to-fine search."""

    voxel_m: float = Field(gt=0, description="side of the NDT voxels")
    floor_m: float = Field(gt=0, description="standard deviation added to every voxel's distribution, isotropic")
    points_m: float = Field(gt=0, description="the scan is thinned to one point per voxel of this side")
    iterations: int = Field(gt=0, description="most Gauss-Newton steps at this level")


class NdtSettings(Section):
    """perception/ndt.py and perception/tracking.py (METHOD 5)."""

    levels: tuple[NdtLevel, ...] = (
        NdtLevel(voxel_m=3.0, floor_m=0.5, points_m=1.0, iterations=15),
        NdtLevel(voxel_m=2.0, floor_m=0.25, points_m=1.0, iterations=15),
        NdtLevel(voxel_m=1.0, floor_m=0.1, points_m=0.5, iterations=15),
    )
    half_window_m: float = Field(default=96.0, description="half the side of the NDT map kept around the vehicle")
    below_m: float = Field(default=24.0, description="how far that window reaches below the vehicle")
    above_m: float = Field(default=40.0, description="and above it")
    recentre_m: float = Field(default=24.0, description="the window moves when the vehicle is this far off its middle")
    min_points: int = Field(default=3, description="a voxel with fewer points has no distribution")
    covariance_scale: float = Field(default=5.0, description="what neighbouring residuals have in common, calibrated")


class MovingSettings(Section):
    """perception/moving.py ([9])."""


class MappingSettings(Section):
    """mapping.py: NDT SLAM."""


Occlusion = Literal["first_hit", "farthest_return", "column"]


class VotingSettings(Section):
    """The paper's rule, and which of its cases (paper III, V). ``method = "columns"`` is METHOD 4."""

    method: Literal["paper", "columns"] = "paper"
    weighted: bool = Field(default=True, description="multiple votes per scan by Eq. (1); false: one vote per scan")
    two_stage: bool = Field(default=True, description="the vehicle decides its cells; false: it sends its tally")
    skip_tall_cells: bool = Field(default=True, description="case 5: no vote where the map begins above the view")
    tall_rule: Literal["bottom", "height"] = Field(
        default="bottom",
        description='what case 5 skips: "bottom", cells where the map begins above the view at that range; '
        '"height", the literal reading: cells where the map reaches higher than the scan\'s points',
    )
    occlusion: Occlusion = Field(default="first_hit", description="what counts as seen to be empty (METHOD 2)")
    a: float = 2.0
    b: float = 3.0
    k: float = 0.5
    n_min: int = 5
    window_m: float = Field(default=80.0, description="side of the local grid (paper III-A)")


class FuseSettings(Section):
    """fleet/fuse.py: which votes count, how many are enough (DESIGN 4)."""

    min_votes: int = 2
    latest_vehicles: int = 9
    max_age_days: float = 30.0


class Settings(Section):
    """All of them. ``mapvote config`` prints this page."""

    ndt: NdtSettings = NdtSettings()
    moving: MovingSettings = MovingSettings()
    mapping: MappingSettings = MappingSettings()
    voting: VotingSettings = VotingSettings()
    fuse: FuseSettings = FuseSettings()

    def digest(self) -> str:
        """SHA-256 of the canonical JSON: ballots of one round must agree on it."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


CASES: dict[str, dict[str, bool]] = {
    "1": {"weighted": True, "two_stage": True, "skip_tall_cells": False},
    "2": {"weighted": False, "two_stage": True, "skip_tall_cells": False},
    "3": {"weighted": True, "two_stage": False, "skip_tall_cells": False},
    "4": {"weighted": False, "two_stage": False, "skip_tall_cells": False},
    "5": {"weighted": True, "two_stage": True, "skip_tall_cells": True},
}
"""The paper's five cases as settings of the one rule (paper V)."""


ENV_PREFIX = "MAPVOTE_"


def did_you_mean(key: str, known: Iterable[str]) -> str:
    """ "; did you mean 'x'?" for the known name nearest to ``key``, or "" if none is near."""
    near = difflib.get_close_matches(key, list(known), n=1, cutoff=0.5)
    return f"; did you mean {near[0]!r}?" if near else ""


def load_settings(path: Path | str | None = None, env: Mapping[str, str] | None = None) -> Settings:
    """The defaults, changed by the TOML file at ``path``, changed by the environment (``MAPVOTE_VOTING__N_MIN=4``).

    Raises MapvoteError naming the file or variable, the key, and the nearest key that exists.
    """
    return load_with_sources(path, env)[0]


def load_with_sources(
    path: Path | str | None = None, env: Mapping[str, str] | None = None
) -> tuple[Settings, dict[str, str]]:
    """As :func:`load_settings`, and by "section.key" where each value that is not a default came from."""
    values: dict[str, dict[str, Any]] = {}
    sources: dict[str, str] = {}
    for section, key, value, source in (*_from_file(path), *_from_env(os.environ if env is None else env)):
        if section not in Settings.model_fields:
            raise MapvoteError(f"{source}: unknown section {section!r}{did_you_mean(section, Settings.model_fields)}")
        known = type(getattr(Settings(), section)).model_fields
        if key not in known:
            raise MapvoteError(f"{source}: unknown setting {section}.{key}{did_you_mean(key, known)}")
        values.setdefault(section, {})[key] = value
        sources[f"{section}.{key}"] = source
    try:
        return Settings.model_validate(values), sources
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"][:2])
        raise MapvoteError(f"{sources[name]}: {name} = {first['input']!r}: {first['msg']}") from error


def _from_file(path: Path | str | None) -> Iterable[tuple[str, str, Any, str]]:
    if path is None:
        return
    try:
        tables = tomllib.loads(Path(path).read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise MapvoteError(f"{path}: settings cannot be read ({error})") from error
    for section, table in tables.items():
        if not isinstance(table, dict):
            raise MapvoteError(f"{path}: {section} = {table!r} stands outside a section; put it under its [section]")
        for key, value in table.items():
            yield section, key, value, str(path)


def _from_env(env: Mapping[str, str]) -> Iterable[tuple[str, str, Any, str]]:
    """Variables MAPVOTE_SECTION__KEY; pydantic turns their text into numbers."""
    for name in sorted(env):
        section, found, key = name.removeprefix(ENV_PREFIX).lower().partition("__")
        if name.startswith(ENV_PREFIX) and found:
            yield section, key, env[name], name
