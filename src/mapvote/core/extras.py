"""Packages that only some formats and verbs need: imported when needed, one clear line if missing."""

from __future__ import annotations

import importlib
import re
from importlib import metadata
from pathlib import Path
from types import ModuleType

from mapvote.core.types import MapvoteError


def require(module: str, extra: str, needed_by: str) -> ModuleType:
    """The module, imported; MapvoteError naming the extra to install if it is not there."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MapvoteError(
            f"{needed_by}: needs the package {module.partition('.')[0]}; "
            f"install it with: pip install 'mapvote[{extra}]'"
        ) from error


ENDINGS = {
    ".las": ("laspy", "las"),
    ".laz": ("laspy", "las"),
    ".ply": ("plyfile", "ply"),
    ".e57": ("pye57", "e57"),
    ".gpkg": ("pyogrio", "geo"),
    ".png": ("matplotlib", "plots"),
    ".svg": ("matplotlib", "plots"),
    ".pdf": ("matplotlib", "plots"),
}
"""The package and the extra that a file of this ending needs."""


def require_for(file: Path, needed_by: str) -> None:
    """MapvoteError naming the extra if a file of this ending needs a package that is missing: before the work."""
    if file.suffix.lower() in ENDINGS:
        require(*ENDINGS[file.suffix.lower()], needed_by)


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """The command that installs a missing module, by mapvote's own metadata; None if no extra has it."""
    module = (error.name or "").partition(".")[0]
    try:
        requirements = metadata.requires("mapvote") or []
    except metadata.PackageNotFoundError:
        return None
    for requirement in requirements:
        package = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"](\w+)['\"]", requirement)
        if package is None or extra is None or extra[1] in ("all", "dev"):  # which hold the packages of the others
            continue
        if re.sub(r"[-.]+", "_", package[0]).lower() == module.lower():
            return f"this needs the package {module}; install it with: pip install 'mapvote[{extra[1]}]'"
    return None
