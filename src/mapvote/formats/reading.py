"""Reading other people's files: whatever goes wrong is one error that names the file."""

from __future__ import annotations

import codecs
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mapvote.core.types import MapvoteError


def read_text(file: Path) -> str:
    """The whole text of a file, UTF-8, or UTF-16 with a byte order mark; MapvoteError if it cannot be read or is not
    text."""
    try:
        data = file.read_bytes()
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
