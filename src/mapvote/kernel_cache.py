"""Where compiled kernels stay if numba itself finds no place: an installation that may not be written to, and no home.

numba keeps them beside the program, else in the user's cache, and else refuses to import them at all. A container with
a read-only image and a user without a home has neither.
"""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path

_VARIABLE = "NUMBA_CACHE_DIR"


def choose_kernel_cache() -> None:
    """Name a folder of this user's in the temporary one, where nothing else can be written to."""
    users = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    if os.environ.get(_VARIABLE) or _may_write(Path(__file__).parent) or _may_write(users):
        return
    os.environ[_VARIABLE] = folder = _private_folder()
    if "numba" in sys.modules:  # which has read its variables already
        sys.modules["numba"].config.CACHE_DIR = folder


def _may_write(folder: Path) -> bool:
    """Whether this folder, or the nearest above it that exists, can be written to."""
    existing = next((f for f in (folder, *folder.parents) if f.is_dir()), None)
    return existing is not None and os.access(existing, os.W_OK | os.X_OK)


def _private_folder() -> str:
    """The same one at each start; one for this process alone if others may have put kernels there, for they are run."""
    import tempfile  # takes a while, and hardly anybody needs it

    within = Path(tempfile.gettempdir())
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = within / f"mapvote-kernels-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if stat.S_ISDIR(found.st_mode) and found.st_uid == user and not found.st_mode & 0o022:
        return str(folder)
    return tempfile.mkdtemp(prefix="mapvote-kernels-", dir=within)
