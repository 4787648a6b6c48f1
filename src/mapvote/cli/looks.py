"""The doctor's cheap checks of a verb's inputs: an error stops it, warnings go to stderr."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from mapvote.cli.terminal import progress

if TYPE_CHECKING:
    from mapvote.core.point_map import PointMap
    from mapvote.core.types import Drive
    from mapvote.doctor.finding import Finding
    from mapvote.doctor.scans import LookedAt
    from mapvote.formats.maps.tiling import Look


@contextmanager
def usable_drives(drives: Sequence[Drive]) -> Iterator[list[Drive]]:
    """The drives, checked while they are read; nothing may be written before this ends.

    MapvoteError for one that cannot be used so: at once if some of its scans show it, else at the end. Whatever else
    stops the work, what is wrong with a drive is told rather than what came of it.
    """
    from mapvote.core.types import MapvoteError
    from mapvote.doctor.scans import LookedAt

    watching = []
    for drive in drives:
        with progress(f"looking at {drive.path}") as tell:
            watching.append(LookedAt(drive, tell))
    try:
        yield [one.drive for one in watching]
    except MapvoteError:
        _warnings_of(watching)
        raise
    for path, found in _warnings_of(watching):
        _warn(path, found)


def _warnings_of(watching: list[LookedAt]) -> list[tuple[str, list[Finding]]]:
    found = []
    for one in watching:
        with progress(f"looking at {one.drive.path}") as tell:
            found.append((str(one.drive.path), one.warnings(tell)))
    return found


def sound_map(path: Path | str) -> PointMap:
    """A map in any file format; MapvoteError for one that cannot be used so."""
    from mapvote.formats import read_map

    return read_map(path, look_at_points(str(path)))


def look_at_points(path: str) -> Look:
    """The check of a map's points before the ground is computed: MapvoteError if they cannot be used."""
    from mapvote.doctor.finding import usable
    from mapvote.doctor.maps import check_cloud

    return lambda pieces: _warn(path, usable(path, check_cloud(pieces)))


def _warn(path: str, found: list[Finding]) -> None:
    for finding in found:
        print(f"warning: {path}: {finding.what}", file=sys.stderr)
