"""What a server's operator sets: which votes count, when a version is held, what is let in."""

from __future__ import annotations

from pydantic import Field, field_validator, model_validator

from mapvote.config.section import Section


class FuseSettings(Section):
    """fusion/fuse.py: which votes count, how many are enough. A version records the ones it was made by."""

    min_votes: int = Field(
        default=2, ge=1, le=10_000, description="vehicles that a change needs: k + 1 against k liars"
    )
    max_contradiction: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="who opposes the others in more of a tile is not heard there; 1: everyone is",
    )
    max_denial: float = Field(
        default=0.9,
        gt=0,
        le=1,
        description="nor is who denies a larger share of the changes decided on the tile; 1: everyone is",
    )
    min_difference: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description="two vehicles' drives whose masks differ by a smaller share of what .9 m makes are one; 0: never",
    )
    latest_vehicles: int = Field(
        default=9, ge=1, le=10_000, description="only the last so many vehicles on a tile count"
    )
    max_age_days: float = Field(
        default=30.0, gt=0, le=36_500, description="and drives so much older than its newest do not"
    )
    min_age_s: float = Field(
        default=0.0, ge=0, le=1e9, description="a ballot waits so long before it counts (time to un-vote)"
    )
    stay_days: float = Field(
        default=30.0, gt=0, le=36_500, description="a new thing enters the map once it can be expected to stay so long"
    )
    prior_stay_days: float = Field(
        default=30.0,
        ge=0,
        le=1e6,
        description="how long what is new is expected to stay where nothing is known to come and go; less than "
        "stay_days: it must be seen for the difference first",
    )
    false_deletions: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="a cell waits that is emptied with a larger probability of deleting what stands; 1: none does",
    )
    max_deleted_share: float = Field(
        default=0.5, ge=0, le=1, description="hold a version that deletes more of the points of any tile"
    )
    max_change_m2: float = Field(
        default=500.0,
        ge=0,
        le=1e9,
        description="hold a version in which one connected thing is larger that comes or goes",
    )
    max_freed_share: float = Field(
        default=0.5, ge=0, le=1, description="hold one that learns free space in more of a tile that knew of some"
    )


class GateSettings(Section):
    """server/views/localisation_gate.py: when a new version may be published, judged by a reference drive."""

    tolerance_found: float = Field(default=0.02, ge=0, description="allowed loss of the share of scans localised")
    tolerance_inlier_share: float = Field(default=0.01, ge=0, description="allowed loss of inlier share")
    tolerance_score: float = Field(default=0.01, ge=0, description="allowed loss of the NDT score")
    tolerance_scatter_m: float = Field(default=0.02, ge=0, description="allowed growth of the poses' scatter")


class ServerSettings(Section):
    """server/http/app.py: what the server lets in."""

    max_body_bytes: int = Field(default=16_000_000, description="largest request body; eight such wait in memory")
    connections: int = Field(default=2000, ge=8, description="at once; the longest silent makes room for a new one")
    header_timeout_s: float = Field(default=10.0, gt=0, description="for the headers of a request")
    body_timeout_s: float = Field(default=120.0, gt=0, description="for its body")
    answer_timeout_s: float = Field(default=60.0, gt=0, description="for a client that does not take its answer")
    ballots_per_minute: float = Field(
        default=600.0, gt=0, description="of one vehicle, on average; a tenth of them at once"
    )
    drives_a_day: int = Field(default=300, ge=1, description="that one vehicle may send")
    tiles_a_drive: int = Field(default=1000, ge=1, description="that one ballot may vote on, of 76.8 m by 76.8 m")
    stored_bytes: int = Field(default=2_000_000_000, ge=1, description="that one vehicle's ballots may take")
    hosts: tuple[str, ...] = Field(
        default=(), description="names that this server goes by, besides localhost and addresses in digits"
    )

    webhook_url: str = Field(
        default="", pattern="^(https?://.*)?$", description="where events are posted to; empty: nowhere"
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
