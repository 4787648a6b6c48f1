"""Packages that only some formats need: asked for when they are needed, missed in one clear line."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

from mapvote.core.types import MapvoteError


def require(module: str, extra: str, where: str) -> ModuleType:
    """The module, imported; MapvoteError naming the extra to install if it is not there."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MapvoteError(
            f"{where}: needs the package {module.partition('.')[0]}; install it with: pip install 'mapvote[{extra}]'"
        ) from error


def read_text(file: Path) -> str:
    """The whole text of a file; MapvoteError if it cannot be read or is not text."""
    try:
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise MapvoteError(f"{file}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise MapvoteError(f"{file}: not a text file ({error.reason} at byte {error.start}); copy it again") from error
