"""Small text files."""

from __future__ import annotations

from pathlib import Path

from mapvote.core.types import MapvoteError


def read_text(file: Path) -> str:
    """The whole text of a file; MapvoteError if it cannot be read or is not text."""
    try:
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise MapvoteError(f"{file}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise MapvoteError(f"{file}: not a text file ({error.reason} at byte {error.start}); copy it again") from error
