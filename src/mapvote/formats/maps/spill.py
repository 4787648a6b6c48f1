"""Arrays on disk while a map larger than memory is made: in a file without a name, gone with the process that made it,
however that ends.
"""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import MapvoteError

_IN_MEMORY = 64 << 20
"""Bytes that are not worth a file."""

Columns = dict[str, NDArray[Any]]


class Spill:
    """Blocks of columns, written once, read back in any order."""

    def __init__(self, folder: Path | None = None) -> None:
        """``folder``: where there is room; else the system's place for temporary files."""
        self._folder = folder
        self._file = tempfile.SpooledTemporaryFile(max_size=_IN_MEMORY, dir=str(folder) if folder else None)  # noqa: SIM115
        self.close = weakref.finalize(self, self._file.close)
        """Let go of the file."""
        self._blocks: list[tuple[int, dict[str, tuple[np.dtype[Any], tuple[int, ...]]]]] = []
        self._end = 0

    def __len__(self) -> int:
        """How many blocks there are."""
        return len(self._blocks)

    def add(self, columns: Mapping[str, NDArray[Any]]) -> int:
        """Write a block; returns its number. MapvoteError if the disk is full."""
        self._blocks.append((self._end, {name: (c.dtype, c.shape) for name, c in columns.items()}))
        try:
            self._file.seek(self._end)
            for column in columns.values():
                self._end += self._file.write(np.ascontiguousarray(column).reshape(-1).view(np.uint8).data)
        except OSError as error:
            where = self._folder or tempfile.gettempdir()
            raise MapvoteError(f"{where}: no room for temporary files ({error.strerror or error})") from error
        return len(self._blocks) - 1

    def read(self, number: int) -> Columns:
        """The columns of a block."""
        start, kinds = self._blocks[number]
        self._file.seek(start)
        out = {}
        for name, (dtype, shape) in kinds.items():
            out[name] = np.empty(shape, dtype=dtype)
            self._file.readinto(out[name].reshape(-1).view(np.uint8).data)
        return out

    def joined(self, numbers: Sequence[int]) -> Columns:
        """The columns of several blocks of the same kinds, one after another."""
        parts = [self.read(number) for number in numbers]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
