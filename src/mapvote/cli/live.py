"""The verbs of a vehicle on ROS 2's network: topics."""

from __future__ import annotations

from typing import Annotated

import typer

from mapvote.cli.options import DRIVE


def register(app: typer.Typer) -> None:
    """Add the verbs to ``app``."""
    app.command(rich_help_panel=DRIVE)(topics)


def topics(
    seconds: Annotated[float, typer.Option(min=0.5, metavar="SECONDS", help="how long to listen")] = 5.0,
    domain: Annotated[int | None, typer.Option(min=0, max=232, metavar="N", help="else ROS_DOMAIN_ID, else 0")] = None,
) -> None:
    """List the ROS 2 topics that are sent on this network with types and rates, and what a vehicle lacks among them.

    mapvote topics
    """
    from mapvote.live.dds import Network
    from mapvote.live.topics import listen, missing_for_drive

    found = listen(Network(domain), seconds)
    for one in found:
        rate = "not read here" if one.rate_hz is None else f"{one.rate_hz:.1f} Hz"
        quality = "reliable" if one.heard.reliable else "best effort"
        frame = f" in {one.frame}" if one.frame else ""
        print(f"{one.heard.topic} [{one.heard.kind}] {rate}, {quality}{frame}")
    for sentence in missing_for_drive(found):
        print(f"missing: {sentence}")
