"""Files in a folder, found by names in whatever case: ``10_0.PCD`` lies beside ``0_0.pcd``, and ``CALIB.TXT`` is
``calib.txt``."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from fnmatch import translate
from pathlib import Path, PureWindowsPath

from mapvote.core.types import MapvoteError


def plain_name(name: str, said_by: Path) -> str:
    """``name``, which ``said_by`` gives to a file or folder. MapvoteError if it leads elsewhere ("..", "a/b", "C:x"):
    content never opens a file that the user did not hand over."""
    if not re.fullmatch(r"[^/\\\x00-\x1f\x7f]{1,255}", name) or name in (".", "..") or PureWindowsPath(name).drive:
        raise MapvoteError(f"{said_by}: {name[:80]!r} is not a plain file name; name a file beside this one")
    return name


def below(folder: Path, name: str, said_by: Path) -> Path:
    """The place below ``folder`` that ``said_by`` names ("lidar/0.pcd"); MapvoteError as :func:`plain_name`."""
    return folder.joinpath(*(plain_name(part, said_by) for part in name.split("/")))


def entry(folder: Path, name: str) -> Path:
    """The file at ``folder``/``name`` ("times.txt", "gps/ins.csv"), the exact name before one in another case; that
    path itself if there is none."""
    place = folder / name
    if place.exists():
        return place
    for part in name.split("/"):
        try:
            alike = sorted(listed for listed in os.listdir(folder) if listed.lower() == part.lower())
        except OSError:
            return place
        if not alike:
            return place
        folder = folder / alike[0]
    return folder


def file_if_any(folder: Path, name: str) -> Path | None:
    """The file that :func:`entry` finds; None if there is none. MapvoteError if a folder, or a link to nothing, has the
    name."""
    place = entry(folder, name)
    if place.is_file():
        return place
    if place.exists() or place.is_symlink():
        kind = "a link to nothing" if place.is_symlink() else "no file"
        raise MapvoteError(f"{place}: is {kind}; a file is read from there: put it there, or rename what is there")
    return None


def is_recording(folder: Path) -> bool:
    """Whether stamps, poses or a description of a drive lie in ``folder``: its clouds are scans, not tiles of a map."""
    return any(entry(folder, name).exists() for name in ("times.txt", "prior.txt", "drive.toml"))


def files_like(folder: Path, pattern: str) -> list[Path]:
    """The files that match ``pattern`` ("*.pcd", "lidar/*.bin") below ``folder``, by name; hidden files are none. A
    link to nothing is one, which its reader reports."""
    room, _, last = pattern.rpartition("/")
    place = entry(folder, room) if room else folder
    matches = re.compile(translate(last), re.IGNORECASE).match
    try:
        with os.scandir(place) as entries:
            seen = [e for e in entries if matches(e.name) and not e.name.startswith(".")]
            names = [e.name for e in seen if e.is_file() or (e.is_symlink() and not os.path.exists(e.path))]
    except OSError:
        return []
    return [place / name for name in sorted(names)]


def clouds_beside(folder: Path, taken: Sequence[Path], suffixes: str = "pcd|las|laz|ply|e57|xyz|pts") -> list[str]:
    """Names in ``folder`` that point clouds have, compressed ones and folders too, without the files ``taken``."""
    cloud = re.compile(rf"[^.].*\.({suffixes})(\.(gz|bz2|xz|zst|zip|7z))?", re.IGNORECASE)
    names = {file.name for file in taken}
    return sorted(name for name in os.listdir(folder) if cloud.fullmatch(name) and name not in names)


def require_all_tiles(folder: Path, tiles: Sequence[Path]) -> None:
    """MapvoteError if point clouds lie beside the ``tiles`` that are read: a part of the map would be missing."""
    others = clouds_beside(folder, tiles)
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise MapvoteError(
            f"{folder}: {others[0]}{more} would not be read beside {tiles[0].name}, and a part of the map would be "
            "missing. Unpack it, bring all tiles into one format (mapvote export TILE NEW), or move it elsewhere"
        )
