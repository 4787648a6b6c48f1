"""The policy of a store: what a round is cast by, which votes are enough, when a version is held. One row a change.

Everybody who publishes obeys the newest row, and every version records the policy that made it, so that any past round
can be fused again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import sqlalchemy as sa
from pydantic import Field, ValidationError, field_validator

from mapvote.config import FuseSettings, GateSettings, RuleName, Section, Settings, did_you_mean, wanted_of
from mapvote.core.types import MapvoteError
from mapvote.formats.listing import below
from mapvote_server.store import schema
from mapvote_server.store.queries import log_event


class RoundPolicy(Section):
    """Method and settings of a round's ballots. Other ballots are refused, and standing ones do not count."""

    method: RuleName = Field(default="surfaces", description="the vote rule: surfaces, paper, or that of a plug-in")
    stage: Literal["one-stage", "two-stage"] = "two-stage"
    settings_hash: str = Field(
        default="",
        pattern="^([0-9a-f]{8,64})?$",
        description="only ballots cast by these settings (`mapvote config` shows the digest of yours); empty: by any",
    )

    @property
    def cast_by(self) -> str:
        """Method and stage, as ballots are recorded with them."""
        return f"{self.method}, {self.stage}"


class GatePolicy(GateSettings):
    """The reference drive by which a new version is judged."""

    drive: str = Field(
        default="",
        max_length=1000,
        description="reference drive, below the folder of gate drives of the machine that publishes; empty: no gate",
    )

    @field_validator("drive")
    @classmethod
    def _below_the_folder(cls, name: str) -> str:
        try:
            return name and below(Path(), name, Path("gate.drive")).as_posix()
        except MapvoteError:
            raise ValueError("give a name below the folder of gate drives (serve --gate-drives DIR)") from None


class KeepPolicy(Section):
    """The data that ``gc`` deletes (:mod:`mapvote_server.store.retention`)."""

    versions: int = Field(
        default=0, ge=0, le=1_000_000, description="older ones than the last so many may go; 0: none ever"
    )
    automatic: bool = Field(default=False, description="after every version, not only by `mapvote gc`")


class Policy(Section):
    """All that decides what becomes of the ballots."""

    round: RoundPolicy = RoundPolicy()
    fuse: FuseSettings = FuseSettings()
    gate: GatePolicy = GatePolicy()
    keep: KeepPolicy = KeepPolicy()

    @classmethod
    def of(cls, settings: Settings) -> Policy:
        """The first policy of a store made by these settings: its fleet votes as they say."""
        voting = settings.voting
        stage: Literal["one-stage", "two-stage"] = "two-stage" if voting.two_stage else "one-stage"
        round_policy = RoundPolicy(method=voting.method, stage=stage, settings_hash=settings.digest())
        return cls(round=round_policy, fuse=settings.fuse, gate=GatePolicy.model_validate(settings.gate.model_dump()))


@dataclass(frozen=True, slots=True)
class PolicyChange:
    """One row: what held from an event on, and who said so."""

    seq: int
    at_ns: int
    by: str
    reason: str
    policy: Policy


def policy_in(connection: sa.Connection) -> Policy:
    """The newest policy."""
    p = schema.policies
    newest = sa.select(p.c.policy).order_by(p.c.seq.desc()).limit(1)
    return Policy.model_validate(connection.execute(newest).scalar_one())


HIDDEN = "hidden"


def without_drive(policy: Mapping[str, Any]) -> dict[str, Any]:
    """A policy as readers see it, who learn that there is a gate and not by which drive it judges."""
    gate = policy.get("gate", {})
    return {**policy, "gate": {**gate, "drive": HIDDEN}} if gate.get("drive") else dict(policy)


def write_policy(connection: sa.Connection, policy: Policy, now_ns: int, by: str, reason: str) -> int:
    """Let another policy hold from now on; the number of the event."""
    seq = log_event(connection, now_ns, "policy", by, reason)
    connection.execute(schema.policies.insert().values(seq=seq, policy=policy.model_dump(mode="json")))
    return seq


def names_in(policy: Policy) -> list[str]:
    """Every value of a policy, as "section.key"."""
    return [f"{section}.{key}" for section, keys in policy.model_dump().items() for key in keys]


def changed(policy: Policy, values: Mapping[str, Any]) -> Policy:
    """The policy with some values changed, by "section.key"; texts are read as numbers where these are meant.

    MapvoteError naming the key, and the nearest one that exists.
    """
    sections = policy.model_dump()
    settings = names_in(policy)
    for name, value in values.items():
        if name not in settings:
            raise MapvoteError(f"policy: there is no {name!r}{did_you_mean(name, settings)}")
        section, _, key = name.partition(".")
        sections[section][key] = value
    try:
        return Policy.model_validate(sections)
    except ValidationError as error:
        first = error.errors()[0]
        setting = ".".join(str(part) for part in first["loc"][:2])
        raise MapvoteError(f"policy: {setting} = {first['input']!r}: {wanted_of(first)}") from error
