"""The settings of vehicle, map and server. TOML in and out; an unknown key is an error.

Ratios, not scan counts: nothing here needs retuning for another scan rate or number of beams.
"""

from __future__ import annotations

import difflib
import hashlib
import ipaddress
import os
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from mapvote.core.record import method_version
from mapvote.core.rule import rule_named, rule_names
from mapvote.core.types import MapvoteError


def cache_folder() -> Path:
    """The folder of files that can be made or fetched again: $XDG_CACHE_HOME/mapvote, else ~/.cache/mapvote."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mapvote"


def _known_rule(method: str) -> str:
    if method not in rule_names():
        raise ValueError(f"no vote rule has this name; known are {', '.join(rule_names())}")
    return method


RuleName = Annotated[str, AfterValidator(_known_rule)]
"""The name of an installed vote rule (core/rule.py)."""


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class NdtSettings(Section):
    """When a scan's registration is sound (matching/odometry.py)."""

    matcher: str = Field(
        default="ndt",
        pattern="^[a-z][a-z0-9_]*$",
        description="how scans are matched with the map: ndt, vgicp (extra vgicp), or that of a plug-in",
    )
    min_inlier_share: float = Field(
        default=0.5, description="abstain if fewer of the returns are inliers; scans at a wrong pose have about 0.4"
    )
    max_sigma_m: float = Field(default=0.15, description="abstain if the standard deviation of the position is larger")


class MovingSettings(Section):
    """Removal of moving objects (perception/moving_objects.py; paper [9])."""

    lookahead_s: float = Field(
        default=1.0, ge=0, le=1.0, description="delay before a scan is decided, so that later scans show what moved"
    )


class MappingSettings(Section):
    """survey/build.py: NDT SLAM."""

    reach_m: float = Field(
        default=80.0, description="range limit of returns for the map and for the moving-object filter"
    )
    drop_strays: bool = Field(
        default=True,
        description="remove points that are not a surface of their own; false keeps them, as paper II does",
    )


class VotingSettings(Section):
    """The vote rule, and which of the paper's cases (paper III, V): docs/method.md."""

    method: RuleName = Field(default="surfaces", description="the vote rule: surfaces, paper, or that of a plug-in")
    weighted: bool = Field(default=True, description="several votes per scan by Eq. (1); false: one vote per scan")
    two_stage: bool = Field(default=True, description="the vehicle decides its cells; false: it sends its vote counts")
    skip_tall_cells: bool = Field(default=True, description="case 5: no vote where the map begins above the view")
    a: float = Field(default=2.0, description="Eq. (1): votes of an occupied cell with n_min points")
    b: float = Field(default=3.0, description="Eq. (1): upper bound of the votes of an occupied cell")
    k: float = Field(default=0.5, description="Eq. (1): how fast the votes grow with the points")
    window_m: float = Field(default=80.0, description="side of the local grid (paper III-A)")
    min_height_m: float = Field(
        default=0.6,
        description="surfaces: never call a cell changed-empty if its map points are lower than this above the ground",
    )


class PaperSettings(Section):
    """How the paper's open sentences are read. Surfaces have no part in it."""

    occluded: Literal["votes", "abstains"] = Field(
        default="abstains",
        description="what a scan does in a cell that it cannot see: abstain, or vote undetermined (votes)",
    )
    few_points: Literal["undetermined", "empty"] = Field(
        default="undetermined", description="state of a cell with 1 to n_min - 1 points in a scan"
    )
    movers: Literal["occlude", "removed"] = Field(
        default="occlude", description="whether points of moving objects still occlude the cells behind them"
    )
    line_of_sight: Literal["points", "cells", "farthest", "column"] = Field(
        default="points",
        description="what occludes the cells behind it: the nearest point above the ground (points), the nearest point "
        "in an occupied cell (cells), only the farthest return (farthest), or anything that stops every ray at the "
        "heights of the map's points (column)",
    )
    tall_rule: Literal["bottom", "height"] = Field(
        default="bottom",
        description="cells that case 5 skips: those whose lowest map point is above the field of view at that range "
        "(bottom), or those whose highest map point is above the scan's points (height)",
    )
    n_min: int = Field(
        default=5, ge=1, le=8, description="least number of points in an occupied cell, n_min of Eq. (1)"
    )
    window_m: float = Field(
        default=80.0, gt=1, description="side of the square in which a scan votes; at most voting.window_m"
    )


class FuseSettings(Section):
    """fusion/fuse.py: which votes count, how many are enough. A version records the ones it was made by."""

    min_votes: int = Field(
        default=2, ge=1, le=10_000, description="vehicles that a change needs; k + 1 resists k liars"
    )
    one_vehicle: Literal["once", "days"] = Field(
        default="once",
        description="once: a vehicle has one vote; days: its drives of each day (UTC) are a voter of their own, for a "
        "fleet of one vehicle. A fault of that vehicle then counts as often as it drives",
    )
    max_contradiction: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="ignore a vehicle on a tile if it contradicts the others in more than this share of their cells. 1 "
        "disables this",
    )
    max_denial: float = Field(
        default=0.9,
        gt=0,
        le=1,
        description="ignore a vehicle on a tile if it contradicts more than this share of the decided changes. 1 "
        "disables this",
    )
    min_difference: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description="count two drives as one vehicle if their masks differ by less than this share of the difference "
        "that a path 0.9 m to the side makes. 0 disables this",
    )
    latest_vehicles: int = Field(
        default=9, ge=1, le=10_000, description="count only this many vehicles on a tile, the latest ones"
    )
    max_age_days: float = Field(
        default=30.0,
        gt=0,
        le=36_500,
        description="ignore drives that are this much older than the newest one on the tile",
    )
    min_age_s: float = Field(
        default=0.0, ge=0, le=1e9, description="a ballot counts only after this time; until then it can be withdrawn"
    )
    stay_days: float = Field(
        default=30.0,
        gt=0,
        le=36_500,
        description="a new object enters the map if its expected stay is at least this long",
    )
    prior_stay_days: float = Field(
        default=30.0,
        ge=0,
        le=1e6,
        description="expected stay of a new object where no earlier object has come and gone. If it is less than "
        "stay_days, the object must first be seen for the difference",
    )
    false_deletions: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="keep the points of a cell if the probability that its deletion is wrong exceeds this. 1 disables "
        "this",
    )
    max_deleted_share: float = Field(
        default=0.5, ge=0, le=1, description="hold a version that deletes more than this share of the points of a tile"
    )
    max_change_m2: float = Field(
        default=500.0,
        ge=0,
        le=1e9,
        description="hold a version with a connected change larger than this",
    )
    newcomer_days: float = Field(
        default=7.0,
        ge=0,
        le=36_500,
        description="tell of changes that lack the quorum without vehicles whose first ballot came within so many "
        "days, once others voted before. 0 disables this",
    )
    hold_newcomers: bool = Field(default=False, description="hold a version that rests on such vehicles")
    hold_overturned: bool = Field(
        default=False,
        description="hold a version with a change that no more vehicles vote for than said otherwise before",
    )
    max_freed_share: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="hold a version that adds free space to more than this share of a tile that had free space already",
    )


class GateSettings(Section):
    """mapvote_server/gate.py: when a new version may be published, judged by a reference drive."""

    tolerance_found: float = Field(default=0.02, ge=0, description="allowed loss of the share of scans localised")
    tolerance_inlier_share: float = Field(default=0.01, ge=0, description="allowed loss of inlier share")
    tolerance_score: float = Field(default=0.01, ge=0, description="allowed loss of the NDT score")
    tolerance_scatter_m: float = Field(default=0.02, ge=0, description="allowed growth of the poses' scatter")


class ServerSettings(Section):
    """mapvote_server/api: what the server lets in."""

    max_body_bytes: int = Field(
        default=16_000_000, description="largest request body; up to eight of this size are in memory"
    )
    connections: int = Field(
        default=2000, ge=8, description="open connections; a new one replaces the one that was silent longest"
    )
    header_timeout_s: float = Field(default=10.0, gt=0, description="time limit for the headers of a request")
    body_timeout_s: float = Field(default=120.0, gt=0, description="time limit for the body of a request")
    answer_timeout_s: float = Field(default=60.0, gt=0, description="time limit for a client to read its answer")
    ballots_per_minute: float = Field(
        default=600.0,
        gt=0,
        description="ballots of one vehicle per minute on average; a tenth of them may come at once",
    )
    drives_a_day: int = Field(default=300, ge=1, description="drives that one vehicle may send in a day")
    tiles_a_drive: int = Field(default=1000, ge=1, description="tiles (76.8 m by 76.8 m) that one ballot may vote on")
    stored_bytes: int = Field(
        default=2_000_000_000, ge=1, description="bytes that the ballots of one vehicle may take in the store"
    )
    question_s: float = Field(default=30.0, gt=0, description="time limit for the answer to one question")
    work_s_per_minute: float = Field(
        default=30.0, gt=0, description="CPU seconds that the requests of one key may use per minute on average"
    )
    rows_per_minute: float = Field(
        default=1_000_000.0, gt=0, description="rows that one key may read per minute on average"
    )
    streams_per_key: int = Field(default=4, ge=1, description="streams of events that one key may listen to at once")
    hosts: tuple[str, ...] = Field(
        default=(), description="host names of this server, besides localhost and numeric addresses"
    )
    proxies: tuple[str, ...] = Field(
        default=("127.0.0.1", "::1"),
        description="addresses or networks of reverse proxies. Forwarded and X-Forwarded-For count from these alone",
    )
    gate_drives: str = Field(default="", description="folder of the drives that a policy may name as its gate.drive")
    webhook_url: str = Field(
        default="", pattern="^(https?://.*)?$", description="URL that events are posted to. Empty disables this"
    )
    webhook_secret: str = Field(
        default="",
        pattern="^(whsec_[A-Za-z0-9+/]{32,88}={0,2})?$",
        description="signs the posts (Standard Webhooks): whsec_ and 24 to 64 random bytes in base64",
    )

    @model_validator(mode="after")
    def _signed(self) -> ServerSettings:
        if self.webhook_url and not self.webhook_secret:
            raise ValueError("webhook_url needs a webhook_secret: whsec_ and the output of `openssl rand -base64 32`")
        return self

    @field_validator("proxies", mode="after")
    @classmethod
    def _networks(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            ipaddress.ip_network(name, strict=False)
        return value

    @field_validator("hosts", "proxies", mode="before")
    @classmethod
    def _from_one_line(cls, value: object) -> object:
        """An environment variable names them with commas."""
        return [name.strip() for name in value.split(",") if name.strip()] if isinstance(value, str) else value


class Settings(Section):
    """All of them. ``mapvote config`` prints this page."""

    ndt: NdtSettings = NdtSettings()
    moving: MovingSettings = MovingSettings()
    mapping: MappingSettings = MappingSettings()
    voting: VotingSettings = VotingSettings()
    paper: PaperSettings = PaperSettings()
    fuse: FuseSettings = FuseSettings()
    server: ServerSettings = ServerSettings()
    gate: GateSettings = GateSettings()

    def digest(self) -> str:
        """SHA-256 of what a vehicle votes by: ballots of one round must agree on it, whatever a server's limits are.

        Settings, the numbers that vehicles vote by (core/record.py) and the rule's own version: two programs that would
        vote otherwise on the same drive never share a round.
        """
        settings = self.model_dump_json(include={"ndt", "moving", "voting", "paper"})
        version = f"{method_version()} {rule_named(self.voting.method).version}"
        return hashlib.sha256(f"{version} {settings}".encode()).hexdigest()


CASES: dict[str, dict[str, bool]] = {
    "1": {"weighted": True, "two_stage": True, "skip_tall_cells": False},
    "2": {"weighted": False, "two_stage": True, "skip_tall_cells": False},
    "3": {"weighted": True, "two_stage": False, "skip_tall_cells": False},
    "4": {"weighted": False, "two_stage": False, "skip_tall_cells": False},
    "5": {"weighted": True, "two_stage": True, "skip_tall_cells": True},
}
"""The paper's five cases as settings of the one rule (paper V)."""


def did_you_mean(key: str, names: Iterable[str]) -> str:
    """ "; did you mean 'x'?" for the known name nearest to ``key``, or "" if none is near."""
    near = difflib.get_close_matches(key, list(names), n=1, cutoff=0.5)
    return f"; did you mean {near[0]!r}?" if near else ""


def load_settings(path: Path | str | None = None, env: Mapping[str, str] | None = None) -> Settings:
    """The defaults, changed by the TOML file at ``path``, changed by the environment (``MAPVOTE_PAPER__N_MIN=4``).

    Raises MapvoteError naming the file or variable, the key, and the nearest key that exists.
    """
    return load_with_sources(path, env)[0]


def load_with_sources(
    path: Path | str | None = None, env: Mapping[str, str] | None = None
) -> tuple[Settings, dict[str, str]]:
    """(the settings of :func:`load_settings`, the source of each value that is not a default by "section.key")."""
    values: dict[str, dict[str, Any]] = {}
    sources: dict[str, str] = {}
    for section, key, value, source in (*_from_file(path), *_from_env(os.environ if env is None else env)):
        if section not in Settings.model_fields:
            raise MapvoteError(f"{source}: unknown section {section!r}{did_you_mean(section, Settings.model_fields)}")
        fields = type(getattr(Settings(), section)).model_fields
        if key not in fields:
            raise MapvoteError(f"{source}: unknown setting {section}.{key}{did_you_mean(key, fields)}")
        values.setdefault(section, {})[key] = value
        sources[f"{section}.{key}"] = source
    try:
        return Settings.model_validate(values), sources
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"][:2])
        raise MapvoteError(f"{sources[name]}: {name} = {first['input']!r}: {wanted_of(first)}") from error


_KINDS = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "string": "a text",
    "list": "a list",
    "tuple": "a list",
    "dict": "a table",
}
"""Types by the first word of pydantic's names of errors."""


def wanted_of(error: Mapping[str, Any]) -> str:
    """An error of pydantic as a sentence that says what to give."""
    kind, _, fault = error["type"].partition("_")
    if kind in _KINDS and fault in ("parsing", "type", "from_float"):
        return f"give {_KINDS[kind]}"
    message = str(error["msg"]).removeprefix("Value error, ")
    return message.replace("Input should be", "give a value that is", 1)


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
    prefix = "MAPVOTE_"
    for name in sorted(env):
        section, separator, key = name.removeprefix(prefix).lower().partition("__")
        if name.startswith(prefix) and separator:
            yield section, key, env[name], name


def choose_case(settings: Settings, case: str) -> Settings:
    """``settings`` with the vote of one of the paper's cases, "1" to "5", or of the rule of that name.

    MapvoteError for another.
    """
    if case in CASES:
        chosen: dict[str, object] = {"method": "paper", **CASES[case]}
    elif case in rule_names():
        chosen = {"method": case}
    else:
        raise MapvoteError(f"no case {case!r}; choose one of {', '.join([*rule_names(), *CASES])}")
    return settings.model_copy(update={"voting": settings.voting.model_copy(update=chosen)})
