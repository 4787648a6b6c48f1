"""Packages that only some formats and verbs need: imported when needed, one clear line if missing."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
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


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """What to install for a module that was not found, by mapvote's own metadata; None if no extra has it."""
    module = (error.name or "").partition(".")[0]
    try:
        requirements = metadata.requires("mapvote") or []
    except metadata.PackageNotFoundError:
        return None
    for requirement in requirements:
        package, extra = re.match(r"[\w.-]+", requirement), re.search(r"extra == ['\"](\w+)['\"]", requirement)
        if package is None or extra is None or extra[1] in ("all", "dev"):  # which hold what the others hold
            continue
        if re.sub(r"[-.]+", "_", package[0]).lower() == module.lower():
            return f"this needs the package {module}; install it with: pip install 'mapvote[{extra[1]}]'"
    return None


def read_text(file: Path) -> str:
    """The whole text of a file; MapvoteError if it cannot be read or is not text."""
    try:
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise MapvoteError(f"{file}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise MapvoteError(f"{file}: not a text file ({error.reason} at byte {error.start}); copy it again") from error


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Whatever goes wrong within is one MapvoteError that names the file: libraries let through what numpy, struct and
    their own parsers raise. ``kind``: what the file is not a whole one of."""
    try:
        yield
    except MapvoteError:
        raise
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:
        raise MapvoteError(f"{path}: not a whole {kind} ({first_line(error)}); copy or export it again") from error


def first_line(error: BaseException) -> str:
    """The message of another library's error, in one line."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
