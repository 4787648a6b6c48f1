"""The list of verbs, in the order a newcomer meets them."""

from __future__ import annotations

import typer

from mapvote.cli import files, science, server, update, vehicle, watch


def register(app: typer.Typer) -> None:
    """Add every verb to ``app``. Modules import nothing heavy at their top."""
    science.register(app)
    vehicle.register(app)
    files.register(app)
    update.register(app)
    server.register(app)
    watch.register(app)
