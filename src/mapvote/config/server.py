"""What a server's operator sets: which votes count, when a version is held, what is let in."""

from __future__ import annotations

from pydantic import Field, field_validator, model_validator

from mapvote.config.section import Section


class FuseSettings(Section):
    """fusion/fuse.py: which votes count, how many are enough. A version records the ones it was made by."""

    min_votes: int = Field(
        default=2, ge=1, le=10_000, description="vehicles that a change needs; k + 1 resists k liars"
    )
    max_contradiction: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="ignore a vehicle on a tile if it contradicts the others in more than this "
        "share of their cells. 1 disables this",
    )
    max_denial: float = Field(
        default=0.9,
        gt=0,
        le=1,
        description="ignore a vehicle on a tile if it contradicts more than this share of the "
        "decided changes. 1 disables this",
    )
    min_difference: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description="count two drives as one vehicle if their masks differ by less than this "
        "share of the difference that a path "
        "0.9 m to the side makes. 0 disables this",
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
        description="expected stay of a new object where no earlier object has come and gone. "
        "If it is less than stay_days, "
        "the object must first be seen for the difference",
    )
    false_deletions: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="keep the points of a cell if the probability that its deletion is wrong "
        "exceeds this. 1 disables this",
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
    max_freed_share: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="hold a version that adds free space to more than this share of a tile that had free space already",
    )


class GateSettings(Section):
    """server/views/localisation_gate.py: when a new version may be published, judged by a reference drive."""

    tolerance_found: float = Field(default=0.02, ge=0, description="allowed loss of the share of scans localised")
    tolerance_inlier_share: float = Field(default=0.01, ge=0, description="allowed loss of inlier share")
    tolerance_score: float = Field(default=0.01, ge=0, description="allowed loss of the NDT score")
    tolerance_scatter_m: float = Field(default=0.02, ge=0, description="allowed growth of the poses' scatter")


class ServerSettings(Section):
    """server/http/app.py: what the server lets in."""

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
    hosts: tuple[str, ...] = Field(
        default=(), description="host names of this server, besides localhost and numeric addresses"
    )

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

    @field_validator("hosts", mode="before")
    @classmethod
    def _from_one_line(cls, value: object) -> object:
        """An environment variable names them with commas."""
        return [name.strip() for name in value.split(",") if name.strip()] if isinstance(value, str) else value
