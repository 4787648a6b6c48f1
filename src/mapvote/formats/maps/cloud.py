"""A file of points as it stands, whole or in pieces, and the way from there to a map: what all cloud formats share."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.brightness import Brightness
from mapvote.core.point_map import MAP_SIZES
from mapvote.core.record import record
from mapvote.core.types import F64, Bool, MapvoteError
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.maps.field_names import COLOURS, kept_fields, known_fields, other_fields


@record()
@dataclass(frozen=True, slots=True)
class ReadSizes:
    """How much of a map file is held in memory at a time."""

    block: int = 500_000
    """Points read from a PCD, PLY or E57 file at a time."""
    piece: int = 1_000_000
    """Points by which degrees are told from metres, and points in a block of a temporary file."""
    in_memory_bytes: int = 64 << 20
    """Bytes up to which a temporary file stays in memory."""
    kept_points: int = MAP_SIZES.kept_points
    """Points of the largest map that is held in memory whole."""


READ_SIZES = ReadSizes()
log = logging.getLogger("mapvote.formats")
SCALED = {"intensity": "intensity"} | dict.fromkeys(COLOURS, "colour")
"""Fields that count from nothing to a full scale, and what shares it."""


@dataclass(frozen=True, slots=True)
class Cloud:
    """``points`` (n, 3), float32 or float64 as the file holds them, in the units of ``frame``."""

    points: NDArray[np.floating]
    dropped: tuple[str, ...] = ()
    """Fields of the file that a mapvote map does not keep, e.g. intensity."""
    frame: MapFrame = field(default_factory=MapFrame)
    """The file's statement of its coordinates: they may be in feet or degrees still."""
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Columns (n,) of :func:`kept_fields`, with the values and in the type that the file has."""
    gps_times: str = ""
    """Epoch of ``gps_time``: "week" or "adjusted standard"; empty if the file does not say."""

    def where(self, chosen: Bool) -> Cloud:
        """Those of its points that are ``chosen`` (n,), with their fields."""
        fields = {name: column[chosen] for name, column in self.fields.items()}
        return replace(self, points=self.points[chosen], fields=fields)


@dataclass(frozen=True, slots=True)
class CloudPieces:
    """The pieces of one cloud, in one frame; can be iterated repeatedly."""

    pieces: Callable[[], Iterator[Cloud]]
    frame: MapFrame
    n: int
    """Points of all pieces together."""
    corners: F64
    """(2, 3) lowest and highest coordinates; 0 where there are no points."""
    kinds: Mapping[str, np.dtype[Any]]
    """Fields of any piece; where one lacks it its points have 0."""
    brightness: Mapping[str, Brightness]
    """Values of intensity, and of the three colours together."""
    gps_times: str
    """Epoch that the pieces state; where none does, the one that the size of the times tells."""

    @classmethod
    def of(cls, cloud: Cloud | CloudPieces) -> CloudPieces:
        """One piece of points that are in memory already."""
        return cloud if isinstance(cloud, CloudPieces) else cls.gathered(lambda: iter([cloud]), cloud.frame)

    @classmethod
    def gathered(cls, pieces: Callable[[], Iterator[Cloud]], frame: MapFrame) -> CloudPieces:
        """Goes through all pieces once."""
        n = 0
        low = np.full(3, np.inf)
        high = np.full(3, -np.inf)
        kinds: dict[str, np.dtype[Any]] = {}
        brightness: dict[str, Brightness] = {}
        gps_times = ""
        latest_s = 0.0
        for piece in pieces():
            n += len(piece.points)
            low = np.minimum(low, piece.points.min(axis=0, initial=np.inf))
            high = np.maximum(high, piece.points.max(axis=0, initial=-np.inf))
            kinds |= {name: column.dtype for name, column in piece.fields.items()}
            for name, column in piece.fields.items():
                if name in SCALED:
                    brightness.setdefault(SCALED[name], Brightness()).add(column)
            gps_times = gps_times or piece.gps_times
            latest_s = max(latest_s, float(np.nanmax(piece.fields.get("gps_time", np.zeros(1)), initial=0.0)))
        corners = np.array([low, high]) if n else np.zeros((2, 3))
        times = gps_times or ("adjusted standard" if latest_s > 604_800.0 else "week")
        return cls(pieces, frame, n, corners, kinds, brightness, times)

    def __iter__(self) -> Iterator[Cloud]:
        """The pieces, each with all fields."""
        for piece in self.pieces():
            fields = {
                name: piece.fields.get(name, np.zeros(len(piece.points), kind)).astype(kind, copy=False)
                for name, kind in self.kinds.items()
            }
            yield replace(piece, fields=fields)


def joined(pieces: Iterable[Cloud]) -> Cloud:
    """Pieces of one file as one cloud."""
    pieces = list(pieces)
    if len(pieces) == 1:
        return pieces[0]
    names = [name for name in kept_fields() if all(name in piece.fields for piece in pieces)]
    return replace(
        pieces[0],
        points=np.concatenate([piece.points for piece in pieces]),
        fields={name: np.concatenate([piece.fields[name] for piece in pieces]) for name in names},
        dropped=tuple(sorted({name for piece in pieces for name in piece.dropped})),
    )


def cloud_of_table(source: str, table: NDArray[np.void]) -> Cloud:
    """The points of a structured array with x, y, z, and of its fields what a map keeps: numbers under LAS's names,
    PCL's packed rgb taken apart. MapvoteError as :func:`xyz`."""
    names = table.dtype.names or ()
    map_fields = {ours: name for ours, name in known_fields(names).items() if ours not in ("x", "y", "z")}
    out = {ours: np.ascontiguousarray(table[name]) for ours, name in map_fields.items()}
    for packed in ("rgb", "rgba"):
        if packed in names and "red" not in out and table.dtype[packed].itemsize == 4:
            word = np.ascontiguousarray(table[packed]).view(np.uint32)
            out |= {c: ((word >> s) & 255).astype(np.uint8) for c, s in (("red", 16), ("green", 8), ("blue", 0))}
    kept = {name: column for name, column in out.items() if column.ndim == 1 and column.dtype.kind in "iuf"}
    return Cloud(xyz(source, table), other_fields(names), fields=kept)


def table_of(cloud: Cloud, kinds: Sequence[tuple[str, np.dtype[Any]]]) -> NDArray[np.void]:
    """The rows of a file: a structured array of x, y, z and fields, as ``kinds`` orders and types them."""
    table = np.empty(len(cloud.points), dtype=list(kinds))
    for name, _ in kinds:
        table[name] = cloud.points[:, "xyz".index(name)] if name in "xyz" else cloud.fields[name]
    return table


def xyz(source: str, table: NDArray[np.void]) -> NDArray[np.floating]:
    """(n, 3) of a structured array's x, y, z in their own precision; MapvoteError if one is missing."""
    return np.ascontiguousarray(xyz_view(source, table))


def xyz_view(source: str, table: NDArray[np.void]) -> NDArray[np.floating]:
    """The result of :func:`xyz`, as a view of ``table`` where its coordinates are adjacent float32, as in nearly every
    LiDAR's clouds."""
    names = table.dtype.names or ()
    columns = known_fields(names)
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise MapvoteError(f"{source}: no field {', '.join(missing)} among {', '.join(names)}; points need x, y and z")
    x, y, z = (table.dtype.fields[columns[axis]] for axis in "xyz")  # type: ignore[index]
    single = x[0] == y[0] == z[0] == np.dtype("<f4") and (y[1], z[1]) == (x[1] + 4, x[1] + 8)
    if single and table.flags.c_contiguous and len(table):
        raw = table.view(np.uint8).data  # fields may overlap, or be listed in another order than they lie
        return np.ndarray((len(table), 3), "<f4", raw, x[1], (table.dtype.itemsize, 4))
    short = (np.float32, np.float16, np.int16, np.uint16, np.int8, np.uint8)  # float32 holds them exactly
    exact = any(table.dtype[columns[axis]] not in short for axis in "xyz")
    out: NDArray[Any] = np.empty((len(table), 3), dtype=np.float64 if exact else np.float32)
    for column, axis in enumerate("xyz"):
        out[:, column] = table[columns[axis]]
    return out


def warn_of_float32(source: str, cloud: CloudPieces) -> None:
    """Warn when float32 would move points by more than half a millimetre (coordinates beyond 8 km)."""
    peak_m = float(np.abs(cloud.corners).max())
    loss_m = 0.5 * float(np.spacing(np.float32(peak_m)))
    if loss_m > 0.0005:
        problem = "%s: coordinates of %.0f m as float32 are rounded by up to %.1f mm; subtract an offset, or use LAS"
        log.warning(problem, source, peak_m, 1000 * loss_m)
