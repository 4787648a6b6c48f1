"""The doctor's cheap looks, before a verb works on a drive or a map: an error stops it, warnings are said aloud."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from mapvote.cli.terminal import progress

if TYPE_CHECKING:
    from mapvote.core.point_map import PointMap
    from mapvote.core.types import Drive


def look_at(drive: Drive) -> None:
    """MapvoteError for a drive that cannot be used so. Every scan is read once."""
    from mapvote.doctor import must_be_usable

    with progress(f"looking at {drive.path}") as tell:
        warnings = must_be_usable(drive, lambda stage, done, total: tell(done, total))
    for finding in warnings:
        print(f"warning: {drive.path}: {finding.what}", file=sys.stderr)


def sound_map(path: Path | str) -> PointMap:
    """A map in any file format; MapvoteError for one that cannot be used so."""
    from mapvote.formats import read_map

    point_map = read_map(path)
    look_at_map(str(path), point_map)
    return point_map


def look_at_map(path: str, point_map: PointMap) -> None:
    """MapvoteError for a map whose points cannot be used so."""
    from mapvote.doctor import check_cloud, tile_by_tile, usable

    for finding in usable(path, check_cloud(tile_by_tile(point_map))):
        print(f"warning: {path}: {finding.what}", file=sys.stderr)
