"""Packages that only some formats need: asked for when they are needed, missed in one clear line."""

from __future__ import annotations

import importlib
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
