"""DDS between processes of this machine alone: no multicast, and a domain for each test."""

from __future__ import annotations

import os
import zlib

LOOPBACK = (
    '<Domain id="any"><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery></Domain>'
)


def domain_of(test: str) -> int:
    """A domain that no other test, and no other run on this machine, speaks in. ROS 2 allows 0 to 101 everywhere."""
    return 1 + zlib.crc32(f"{test} {os.getpid()}".encode()) % 100
