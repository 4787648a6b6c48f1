"""Environment variables of ROS 2, with the meaning that rcl and rmw_cyclonedds give them (master of 2026-08).

ROS_DOMAIN_ID, ROS_LOCALHOST_ONLY, ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_STATIC_PEERS are read. A value that ROS 2 would
refuse, or would ignore without a word, is an error that names the variable. So is a missing file in CYCLONEDDS_URI.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mapvote.core.record import record
from mapvote.core.types import MapvoteError

log = logging.getLogger("mapvote.live")


@record()
@dataclass(frozen=True, slots=True)
class DdsLimits:
    """Limits of DDS domains."""

    domain: int = 232
    """Highest DDS domain whose ports exist."""
    participants: int = 32
    """Participants of one machine that discover each other, as rmw_cyclonedds has it."""


DDS_LIMITS = DdsLimits()


@dataclass(frozen=True, slots=True)
class RosEnvironment:
    """The network of ROS 2 that the environment names."""

    domain: int
    """DDS domain, 0 to 232."""
    configuration: str
    """Configuration of Cyclone DDS for the range of discovery; "" if ROS 2 leaves it alone."""


def ros_environment(domain: int | None = None, variables: Mapping[str, str] | None = None) -> RosEnvironment:
    """The network that ``variables`` (default: those of this process) name. ``domain`` takes the place of
    ROS_DOMAIN_ID. MapvoteError names a variable that is wrong."""
    variables = os.environ if variables is None else variables
    _check_cyclone_uri(variables.get("CYCLONEDDS_URI", ""))
    implementation = variables.get("RMW_IMPLEMENTATION", "")
    if variables.get("ROS_DISCOVERY_SERVER"):
        log.warning(
            "ROS_DISCOVERY_SERVER=%s: a discovery server of Fast DDS is not asked here; topics of nodes that announce "
            "themselves only there are not seen",
            variables["ROS_DISCOVERY_SERVER"],
        )
    if "zenoh" in implementation:
        log.warning("RMW_IMPLEMENTATION=%s: Zenoh is not read; its bridge to DDS makes its topics seen", implementation)
    joined = _domain(variables.get("ROS_DOMAIN_ID", "")) if domain is None else domain
    return RosEnvironment(joined, _discovery(variables))


def _domain(text: str) -> int:
    """The number in ROS_DOMAIN_ID; 0 if it is empty."""
    if not text.strip():
        return 0
    domain = int(text) if text.strip().isascii() and text.strip().isdigit() else -1
    if not 0 <= domain <= DDS_LIMITS.domain:
        raise MapvoteError(
            f"ROS_DOMAIN_ID={text}: not a DDS domain; give a whole number from 0 to {DDS_LIMITS.domain} (0 to 101 "
            "works on every system), or unset it"
        )
    return domain


def _check_cyclone_uri(text: str) -> None:
    """MapvoteError if CYCLONEDDS_URI names a file that is not there. Configuration that stands in it is left alone."""
    if "<" in text:
        return
    for uri in filter(None, map(str.strip, text.split(","))):
        name = uri.removeprefix("file://")
        if not Path(name).is_file():
            raise MapvoteError(f"CYCLONEDDS_URI={text}: there is no file {name}; mend or unset it")


def _discovery(variables: Mapping[str, str]) -> str:
    """Configuration of Cyclone DDS for the range of discovery and the static peers."""
    only = variables.get("ROS_LOCALHOST_ONLY", "").strip()
    if only not in ("", "0", "1"):
        raise MapvoteError(f"ROS_LOCALHOST_ONLY={only}: give 1 (this machine alone) or 0; ROS 2 ignores other values")
    reach = variables.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").strip() or "SUBNET"
    if reach not in ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT"):
        mend = "give SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT"
        raise MapvoteError(f"ROS_AUTOMATIC_DISCOVERY_RANGE={reach}: {mend}")
    peers = _peers(variables.get("ROS_STATIC_PEERS", ""))
    if only == "1":  # the older variable wins, and with it there are no static peers
        reach = "LOCALHOST"
        peers = []
    if reach == "SYSTEM_DEFAULT":
        return ""
    multicast = "" if reach == "SUBNET" else "<General><AllowMulticast>false</AllowMulticast></General>"
    if reach == "OFF":
        tag = f"<ParticipantIndex>none</ParticipantIndex><Tag>ros_discovery_off_{os.getpid()}</Tag>"
        return f'<Domain id="any">{multicast}<Discovery>{tag}</Discovery></Domain>'
    if reach == "LOCALHOST":
        peers = ["localhost", *peers]
    named = "".join(f'<Peer address="{peer}"/>' for peer in peers)
    index = f"<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>{DDS_LIMITS.participants}"
    discovery = f"{index}</MaxAutoParticipantIndex>" + (f"<Peers>{named}</Peers>" if named else "")
    return f'<Domain id="any">{multicast}<Discovery>{discovery}</Discovery></Domain>'


def _peers(text: str) -> list[str]:
    """The addresses in ROS_STATIC_PEERS."""
    peers = [peer.strip() for peer in text.split(";") if peer.strip()]
    for peer in peers:
        if not re.fullmatch(r"[0-9A-Za-z.:\[\]%_-]+", peer):  # a host or an address, with or without a port
            raise MapvoteError(
                f"ROS_STATIC_PEERS={text}: {peer!r} is no host name or address; separate several with semicolons"
            )
    return peers
