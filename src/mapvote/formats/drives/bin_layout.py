"""Scans as bare numbers: which columns, of which type. KITTI has four float32, nuScenes five, others others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import MapvoteError
from mapvote.formats.clean import log

KITTI = ("x", "y", "z", "intensity")
NUSCENES = (*KITTI, "ring")


@dataclass(frozen=True, slots=True)
class BinLayout:
    """Columns of one type, row by row."""

    columns: tuple[str, ...] = KITTI
    dtype: str = "<f4"

    @property
    def record(self) -> np.dtype[np.void]:
        return np.dtype([(name, self.dtype) for name in self.columns])

    def read(self, file: Path) -> NDArray[np.void]:
        """A .bin file as it stands, (n,); MapvoteError if it is cut off or missing."""
        data = read_bytes(file)
        size = self.record.itemsize
        if len(data) % size:
            columns = ", ".join(self.columns)
            raise MapvoteError(
                f"{file}: {len(data)} bytes are not a multiple of {size} ({np.dtype(self.dtype).name} {columns}): "
                f"the scan is cut off or has other columns; copy it again, leave it out with --scans, or name --columns"
            )
        return np.frombuffer(data, dtype=self.record)


def read_bytes(file: Path) -> bytes:
    """The bytes of a scan; MapvoteError if it is gone."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise MapvoteError(f"{file}: {error.strerror}; the drive changed while it was read") from error


def layout_of(files: Sequence[Path], columns: str | None = None, dtype: str | None = None) -> BinLayout:
    """What the user says, else four columns (KITTI), or five if the sizes and the fifth column say so (nuScenes)."""
    if columns is not None or dtype is not None:
        return _said(columns or ",".join(KITTI), dtype or "float32")
    for file in files[:3]:
        data = read_bytes(file)
        if len(data) % 20 == 0 and _has_rings(data):
            log.warning("%s: five columns, the fifth a ring: read as nuScenes' x, y, z, intensity, ring", file)
            return BinLayout(NUSCENES)
    return BinLayout()


def _has_rings(data: bytes) -> bool:
    """Whether the fifth of five float32 columns holds small whole numbers, more than one of them."""
    ring = np.frombuffer(data, dtype="<f4").reshape(-1, 5)[:, 4]
    with np.errstate(invalid="ignore"):
        whole = (ring >= 0) & (ring < 256) & (ring == np.floor(ring))
    return len(ring) > 1 and bool(whole.all()) and len(np.unique(ring)) > 1 and not _looks_like_four(data)


def _looks_like_four(data: bytes) -> bool:
    """Whether as four columns the last one looks like intensities: all within [0, 1]."""
    if len(data) % 16:
        return False
    last = np.frombuffer(data, dtype="<f4").reshape(-1, 4)[:, 3]
    return bool(((last >= 0) & (last <= 1)).all())


def _said(columns: str, dtype: str) -> BinLayout:
    names = tuple(name.strip() for name in columns.split(","))
    try:
        kind = np.dtype(dtype).newbyteorder("<") if np.dtype(dtype).byteorder != ">" else np.dtype(dtype)
    except TypeError as error:
        raise MapvoteError(f"--dtype {dtype!r}: no number type; for example float32, float64, int16") from error
    if len(set(names)) != len(names) or "" in names or not {"x", "y", "z"} <= set(names) or kind.kind not in "iuf":
        raise MapvoteError(
            f"--columns {columns!r}: name every column once, x, y and z among them; --dtype a number type"
        )
    return BinLayout(names, kind.str)
