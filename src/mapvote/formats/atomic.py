"""Outputs appear whole or not at all: written beside their place under a hidden name, then renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mapvote.core.types import MapvoteError


def _hidden(path: Path, role: str) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.{role}")


def _sync(path: Path) -> None:
    """Sync ``path`` to disk before its name appears."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def whole_file(path: Path | str, *, private: bool = False) -> Iterator[Path]:
    """Gives a hidden path to write to; on leaving without an error it becomes ``path`` and replaces the file there.

    ``private``: only its owner can read and write it, from the first byte.
    """
    path = Path(path)
    partial = _hidden(path, "partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if private:
            partial.unlink(missing_ok=True)
            os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        yield partial
        _sync(partial)
        os.replace(partial, path)
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be written ({error.strerror or error}); nothing was changed") from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def write_whole(path: Path | str, content: bytes | str, *, private: bool = False) -> None:
    """A file of this content, text in UTF-8; see :func:`whole_file`."""
    with whole_file(path, private=private) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def whole_folder(path: Path | str, *, sign: str) -> Iterator[Path]:
    """Gives a hidden empty folder to fill; on leaving without an error it becomes ``path``.

    A folder that is there already is replaced only if it is empty or holds a file named ``sign`` (so that a
    mistyped path destroys nothing): MapvoteError otherwise.
    """
    path = Path(path)
    if path.exists() and not (path.is_dir() and ((path / sign).is_file() or not any(path.iterdir()))):
        raise MapvoteError(f"{path}: exists and has no {sign}, so it is not replaced; remove it or choose another path")
    partial = _hidden(path, "partial")
    old = _hidden(path, "old")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        yield partial
        for entry in sorted(partial.rglob("*")):
            _sync(entry)
        if path.exists():
            os.replace(path, old)
        os.replace(partial, path)
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be written ({error.strerror or error}); nothing was changed") from error
    finally:
        if old.exists() and not path.exists():  # an error or Ctrl-C between the two renames
            os.replace(old, path)
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def folder_beside(path: Path) -> Path | None:
    """Where temporary files for an output at ``path`` may lie, on the same disk; None if there is nothing yet."""
    return next((folder for folder in path.absolute().parents if folder.is_dir()), None)
