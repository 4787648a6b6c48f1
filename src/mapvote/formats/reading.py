"""Reading other people's files: whatever goes wrong is one error that names the file."""

from __future__ import annotations

import codecs
import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from mapvote.core.record import record
from mapvote.core.types import MapvoteError


@record()
@dataclass(frozen=True, slots=True)
class FileLimits:
    """Largest sizes that files may claim or have: beyond them a file is damaged or hostile."""

    whole_bytes: int = 4_000_000_000
    """Size of the largest file that is read whole, bytes."""
    las_points_per_byte: int = 16
    """Points per byte of a LAS or LAZ file: real LAZ files need a byte or more for a point."""
    e57_points_per_byte: int = 16
    """Points per byte of an E57 file."""
    lzf_expansion: int = 300
    """Bytes from one byte of LZF, at most; LZF itself writes up to 264 bytes for each 3."""
    pcd_line_bytes: int = 1 << 20
    """Bytes of one line of a PCD header: binary data without a line break are not read whole."""
    pcd_elements: int = 1 << 20
    """COUNT of a PCD field: bytes of a point stay within the range of numpy's types."""
    ply_header_bytes: int = 100_000
    """Bytes of a PLY header."""
    path_bytes: int = 240_000_000
    """Bytes of the driven paths of a map folder: ten million scans, eleven days at 10 Hz."""
    coordinate_m: float = 1e11
    """Largest coordinate: no system on Earth exceeds it, not even in millimetres."""


FILE_LIMITS = FileLimits()


def read_whole(file: Path, most: int = FILE_LIMITS.whole_bytes) -> bytes:
    """The content of a regular file. OSError if it cannot be read, has more than ``most`` bytes, or is a pipe, a device
    or a socket: reading one of these waits or goes on for ever."""
    if _regular(file).st_size > most:
        raise OSError(errno.EFBIG, f"larger than {most:,} bytes", str(file))
    return file.read_bytes()


def first_bytes(file: Path, size: int) -> bytes:
    """The first bytes of a regular file; OSError as :func:`read_whole`."""
    _regular(file)
    with file.open("rb") as stream:
        return stream.read(size)


def _regular(file: Path) -> os.stat_result:
    state = file.stat()
    if not stat.S_ISREG(state.st_mode):
        raise OSError(errno.EINVAL, "no regular file", str(file))
    return state


def read_yaml(file: Path) -> Any:
    """The content of a YAML file; MapvoteError if it cannot be read or is none."""
    return parse_yaml(read_text(file), str(file))


def parse_yaml(text: str, source: str) -> Any:
    """The content of a YAML text; MapvoteError, which names its ``source``, if it is none."""
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, OverflowError, TypeError, AttributeError, RecursionError) as error:
        raise MapvoteError(f"{source}: cannot be read ({first_line(error)})") from error


def read_text(file: Path) -> str:
    """The whole text of a file, UTF-8, or UTF-16 with a byte order mark; MapvoteError if it cannot be read or is not
    text."""
    try:
        data = read_whole(file)
        wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        text = data.decode("utf-16" if wide else "utf-8-sig")
        return text.replace("\r\n", "\n").replace("\r", "\n")
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
