"""Ballot <-> bytes: all that passes between vehicle and server (docs/decisions/data.md).

A msgpack envelope of planes, each a zstd frame. Reading checks every size before it allocates memory; a ballot of
another format, or without a required field, is refused.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapvote.codec.fields import pack_fields, unpack_fields
from mapvote.codec.planes import Words, compress, pack_plane, pack_words, unpack_bytes, unpack_plane, unpack_sparse
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, Lattice, TileIndex
from mapvote.core.kernel import kernel
from mapvote.core.points import Fields, Values, point_field
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I8, I64, N_STATES, NO_VOTE, U8, U16, Bool, CellState, MapvoteError

FORMAT_VERSION = 1


@record()
@dataclass(frozen=True, slots=True)
class BallotLimits:
    """Largest sizes of a ballot's parts: no honest ballot has more."""

    tiles: int = 4096
    """Tiles of a ballot."""
    tile_index: int = 1 << 20
    """Largest row or column of a tile, in tiles from the map's origin."""
    attribute_bytes: int = 16
    """Size of all attributes of a new point together, bytes."""
    points_per_cell: int = 64
    """New points in a cell: one per voxel of its column."""
    path_step_m: float = 5.0
    """Least distance between two cells of a path, metres."""
    path_cells: int = 100_000
    """Cells of a path."""


BALLOT_LIMITS = BallotLimits()

Id = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z")]
"""Vehicle and drive names: 1-64 of letters, digits, dot, underscore, dash; they appear in URLs and file names."""
_Text = Annotated[str, msgspec.Meta(pattern=r"^[^\x00-\x1f]*\Z", max_length=200)]
"""No control characters: some databases refuse them, and no log should print them."""
_Hash = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{0,64}\Z")]
_Count = Annotated[int, msgspec.Meta(ge=0, le=1 << 31)]


class BallotTile(msgspec.Struct, frozen=True, kw_only=True):
    """One tile's votes. Every plane is a zstd frame; see :func:`unpack_planes`."""

    tile: tuple[int, int]
    states: bytes | None = None
    """(256, 256) uint8 CellState or NO_VOTE: two-stage."""
    tally: bytes | None = None
    """(5, 256, 256) uint16 votes in VOTE_UNITs, class-major: one-stage."""
    gone: bytes | None = None
    """(256, 256) column words: which voxels of a changed-empty cell are gone (delete mask)."""
    new_points: bytes | None = None
    """(m, 3) from the tile's corner, sorted by voxel key: one per 0.3 m voxel of changed-occupied cells."""
    fields: bytes | None = None
    """Their attributes (m,), see :func:`mapvote.codec.fields.pack_fields`: those that the map has and the sensor
    measures; None: there are none."""
    free: bytes | None = None
    """(256, 256) column words: voxels that this drive's rays passed through."""
    odds: bytes | None = None
    """(changed cells,) int8 in the order of the states: how sure the vehicle is of each; two-stage
    alone. None: it does not say."""
    clouds: bool = False
    """Whether the vehicle kept the clouds around a doubtful change on it, as DRIVE_ROW_COL.mcap: newer ones may have
    displaced them since."""


class Ballot(msgspec.Struct, frozen=True, kw_only=True):
    """The votes of one vehicle after one drive. Self-contained."""

    format_version: int = FORMAT_VERSION
    map_id: _Text
    base: dict[str, _Hash]
    """Content hash of every tile the votes were cast against, by "row,col"; "" for a tile the map lacked."""
    version: Annotated[int, msgspec.Meta(ge=1, le=(1 << 31) - 1)]
    """Version of the map that the vehicle used."""
    vehicle: Id
    drive: Id
    start_ns: int
    end_ns: int
    method: _Text
    settings_hash: _Text
    scans: _Count
    """Scans in the drive."""
    scans_localised: _Count
    """Scans that voted; the others abstained because the vehicle was not sure where it was."""
    median_sigma_m: float
    """Median position sigma of the scans that voted."""
    length_m: float | None = None
    """Road driven while localised; None if the ballot does not say."""
    prior_misfit_m: float | None = None
    """Median distance, in the plane, between fix and prior of the scans that voted; None without a prior."""
    prior_sigma_m: float | None = None
    """The standard deviation that the prior states."""
    path: bytes | None = None
    """Where it drove, see :func:`pack_path`; None if the ballot does not say."""
    tiles: list[BallotTile]

    @property
    def stage(self) -> str:
        """ "two-stage" if the vehicle decided its cells, "one-stage" if it sends its tally."""
        return "one-stage" if any(tile.tally is not None for tile in self.tiles) else "two-stage"


_BALLOT, _BALLOT_TILE = msgspec.msgpack.Decoder(Ballot), msgspec.msgpack.Decoder(BallotTile)
"""Made when the module is loaded: msgspec makes what it knows of a type at its first use, and the process crashes where
two threads do so at once."""


def tile_index(key: str) -> TileIndex:
    """The inverse of :func:`tile_key`; ValueError if it is none."""
    row, _, col = key.partition(",")
    return int(row), int(col)


def tile_key(tile: TileIndex) -> str:
    """The name of a tile in manifests and ballots: "row,col"."""
    return f"{tile[0]},{tile[1]}"


def encode(ballot: Ballot) -> bytes:
    """The ballot as one self-contained file."""
    return msgspec.msgpack.encode(ballot)


def encode_tile(tile: BallotTile) -> bytes:
    """The votes on one tile as a ballot holds them."""
    return msgspec.msgpack.encode(tile)


def decode_tile(data: bytes) -> BallotTile:
    """The inverse of :func:`encode_tile`; MapvoteError if it is damaged."""
    try:
        return _BALLOT_TILE.decode(data)
    except msgspec.DecodeError as error:
        raise MapvoteError(f"ballot: the votes on a tile are not readable ({error})") from error


def is_ballot(data: bytes) -> bool:
    """Whether bytes begin as a ballot does, with a map of msgpack: they may be damaged behind that."""
    return bool(data) and (0x80 <= data[0] <= 0x8F or data[0] in (0xDE, 0xDF))


def decode(data: bytes) -> Ballot:
    """Check the envelope; planes are checked when they are unpacked. MapvoteError if unusable."""
    try:
        ballot = _BALLOT.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:  # ValidationError is a DecodeError
        raise MapvoteError(f"ballot: not readable ({error}); was it written by this version of mapvote?") from error
    if ballot.format_version != FORMAT_VERSION:
        raise MapvoteError(f"ballot: format {ballot.format_version}; this mapvote reads format {FORMAT_VERSION}")
    indices = [t.tile for t in ballot.tiles]
    if len(indices) > BALLOT_LIMITS.tiles or len(set(indices)) != len(indices):
        raise MapvoteError(f"ballot: {len(indices)} tiles; at most {BALLOT_LIMITS.tiles}, each once")
    for tile in ballot.tiles:
        if max(abs(tile.tile[0]), abs(tile.tile[1])) > BALLOT_LIMITS.tile_index:
            raise MapvoteError(f"ballot: tile {tile.tile} lies outside any map")
        if (tile.states is None) == (tile.tally is None):
            raise MapvoteError(f"ballot: tile {tile.tile} needs either states or a tally")
        if tile_key(tile.tile) not in ballot.base:
            raise MapvoteError(f"ballot: tile {tile.tile} has no base hash")
    if ballot.start_ns > ballot.end_ns:
        raise MapvoteError("ballot: ends before it starts; check the drive's clock")
    if ballot.scans_localised > ballot.scans:
        raise MapvoteError(
            f"ballot: {ballot.scans_localised} of {ballot.scans} scans were localised: more than there are"
        )
    for name in ("median_sigma_m", "length_m", "prior_misfit_m", "prior_sigma_m"):
        value = getattr(ballot, name)
        if value is not None and not 0.0 <= value < math.inf:
            raise MapvoteError(f"ballot: {name} = {value} is no distance")
    return ballot


class Odds(NamedTuple):
    """Confidence of a vehicle, or of the vehicles that agree, in some cells of a tile; other cells have none."""

    cells: I64
    """(n,) flat cells of the tile, ascending."""
    steps: I8
    """(n,) log-odds in steps, see :func:`in_steps`."""

    @classmethod
    def none(cls) -> Odds:
        """No cell has a stated confidence."""
        return cls(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int8))

    def at(self, cells: I64) -> I8:
        """(m,) the confidence of flat ``cells`` (m,); UNSAID where none is stated."""
        plane = np.full(CELLS, UNSAID, dtype=np.int8)
        plane[self.cells] = self.steps
        return plane[cells]

    def within(self, chosen: Bool) -> Odds:
        """Only those of the flat cells given (65536,)."""
        keep = chosen[self.cells]
        return Odds(self.cells[keep], self.steps[keep])


@dataclass(frozen=True, slots=True, kw_only=True)
class Planes:
    """The planes of a :class:`BallotTile`, unpacked and checked."""

    states: U8 | None = None
    """(256, 256): two-stage."""
    tally: U16 | None = None
    """(256, 256, 5): one-stage."""
    gone: Words | None = None
    """Column words to delete where the vote is changed-empty, and remnants where the cell stands; None: no
    remnants, and the whole column above ground."""
    new_points: F32 | None = None
    """(m, 3) from the tile's corner; used only where the vote is changed-occupied."""
    fields: Fields = field(default_factory=dict)
    """Attributes (m,) of the new points that were measured, see core/points.py."""
    free: Words | None = None
    """Column words that rays passed through."""
    odds: Odds | None = None
    """How sure it is of the cells that it calls changed; None: it does not say."""
    clouds: bool = False
    """Whether the vehicle kept clouds of the tile."""

    @property
    def nbytes(self) -> int:
        """Bytes of all planes."""
        planes: list[NDArray[Any] | None] = [self.states, self.tally, self.new_points, *self.fields.values()]
        planes += [*(self.gone or ()), *(self.free or ()), *(self.odds or ())]
        return sum(plane.nbytes for plane in planes if plane is not None)

    def spoken(self) -> Bool:
        """(256, 256) the cells on which it votes."""
        if self.states is not None:
            return self.states != NO_VOTE
        assert self.tally is not None
        return np.asarray(self.tally.any(axis=-1))

    def speaks_of(self, cell: tuple[int, int]) -> bool:
        """Whether it votes on a cell (row, column) of the tile."""
        if self.states is not None:
            return int(self.states[cell]) != NO_VOTE
        assert self.tally is not None
        return bool(self.tally[cell].any())


def pack_planes(tile: TileIndex, planes: Planes) -> BallotTile:
    """The votes on one tile as a ballot holds them; planes without content are left out."""
    new_points = planes.new_points
    return BallotTile(
        tile=tile,
        states=None if planes.states is None else pack_plane(planes.states),
        tally=None if planes.tally is None else pack_plane(np.moveaxis(planes.tally, -1, 0)),
        gone=None if planes.gone is None else pack_words(planes.gone),
        new_points=None if new_points is None or not len(new_points) else pack_points(new_points),
        fields=compress(pack_fields(planes.fields)) if planes.fields else None,
        free=None if planes.free is None else pack_words(planes.free),
        odds=None if planes.odds is None else pack_odds(planes.odds.steps),
    )


def unpack_planes(packed: BallotTile) -> Planes:
    """The inverse of :func:`pack_planes`; MapvoteError if a plane is damaged or impossible."""
    new_points, fields = unpack_offer(packed.new_points, packed.fields)
    states = None if packed.states is None else unpack_states(packed.states)
    return Planes(
        states=states,
        tally=None if packed.tally is None else unpack_tally(packed.tally),
        gone=None if packed.gone is None else unpack_sparse(packed.gone, "gone"),
        new_points=new_points,
        fields=fields,
        free=None if packed.free is None else unpack_sparse(packed.free, "free"),
        odds=unpack_sureness(packed.odds, states),
        clouds=packed.clouds,
    )


def unpack_states(data: bytes) -> U8:
    """(256, 256) uint8; MapvoteError if damaged or not a CellState."""
    states = unpack_plane(data, "<u1", (TILE_CELLS, TILE_CELLS), "ballot: states")
    if not ((states < N_STATES) | (states == NO_VOTE)).all():
        raise MapvoteError("ballot: states holds a value that is no cell state")
    return states


def unpack_tally(data: bytes) -> U16:
    """(256, 256, 5) uint16; MapvoteError if damaged."""
    return np.moveaxis(unpack_plane(data, "<u2", (N_STATES, TILE_CELLS, TILE_CELLS), "ballot: tally"), 0, -1)


def unpack_offer(new_points: bytes | None, fields: bytes | None) -> tuple[F32 | None, dict[str, Values]]:
    """The new points (m, 3) of a tile and their attributes (m,), of their planes; MapvoteError as
    :func:`unpack_points`, if an attribute is unknown, or if it is not of each point."""
    points = None if new_points is None else unpack_points(new_points)
    if fields is None:
        return points, {}
    if points is None:
        raise MapvoteError("ballot: a tile has fields of new points, but none of those")
    raw = unpack_bytes(fields, 4096 + BALLOT_LIMITS.attribute_bytes * len(points), "ballot: fields")
    sent = unpack_fields(raw, len(points), "ballot: fields")
    for name, values in sent.items():
        if values.dtype != np.dtype(point_field(name).dtype):
            raise MapvoteError(f"ballot: {name} of type {values.dtype}, not {np.dtype(point_field(name).dtype)}")
        if not np.isfinite(values).all():
            raise MapvoteError(f"ballot: {name} holds a number that is not finite")
    return points, sent


def unpack_sureness(odds: bytes | None, states: U8 | None) -> Odds | None:
    """Log-odds of the changed cells of ``states`` (256, 256); None if the ballot states none. MapvoteError if damaged,
    not one for each changed cell, nothing that a vehicle says, or without states."""
    if odds is None:
        return None
    if states is None:
        raise MapvoteError("ballot: a tile has the odds of changed cells, but no states")
    cells = changed_cells_of(states)
    steps = unpack_plane(odds, "<i1", (len(cells),), "ballot: odds")
    if (steps == UNSAID).any():
        raise MapvoteError("ballot: odds holds a value that is no log-odds")
    return Odds(cells, steps)


# New points: the voxel of each, and where in it to a 32nd of its side. Half a centimetre is less than a sensor's noise
# and less than the error of a pose, yet as float32 three quarters of a ballot were such digits. Under zstd lie nine
# planes of bytes: the way from each point's cell to the next (two), from each layer to the next (four), and the place
# in the voxel (three).

PLACES = 32
"""Places along a voxel's side that a point may have."""
_POINT_BYTES = 9


def pack_points(points: F32) -> bytes:
    """(m, 3) from the tile's corner, inside it, in any order."""
    planes = np.empty((_POINT_BYTES, len(points)), dtype=np.uint8)
    _enter_planes(points, np.empty(3, dtype=np.int64), planes)
    return compress(planes.tobytes())


def unpack_points(data: bytes) -> F32:
    """(m, 3) float32 from the tile's corner; MapvoteError if damaged, not finite, outside the tile, or if one cell
    holds more than it may."""
    most_bytes = CELLS * BALLOT_LIMITS.points_per_cell * _POINT_BYTES
    raw = np.frombuffer(unpack_bytes(data, most_bytes, "ballot: new_points"), dtype=np.uint8)
    if len(raw) % _POINT_BYTES:
        raise MapvoteError(f"ballot: new_points has {len(raw)} bytes, which is no number of points")
    points = np.empty((len(raw) // _POINT_BYTES, 3), dtype=np.float32)
    sound = _placed(raw.reshape(_POINT_BYTES, -1), points)
    if not sound or not _all_inside(points, np.float32(TILE_CELLS * CELL_SIZE)):
        raise MapvoteError("ballot: new_points holds a point outside its tile or not finite")
    if _most_in_a_cell(points, np.zeros(CELLS, dtype=np.int64)) > BALLOT_LIMITS.points_per_cell:
        raise MapvoteError(f"ballot: new_points holds more than {BALLOT_LIMITS.points_per_cell} points in one cell")
    return points


@kernel
def _enter_planes(points: F32, voxel: I64, planes: U8) -> None:
    """Fill ``planes`` (9, m) from points (m, 3): differences modulo 2 ** 16 and 2 ** 32, lowest byte first, and steps
    in a voxel. ``voxel`` (3,): scratch."""
    last_cell = np.int64(0)
    last_layer = np.int64(0)
    for i in range(len(points)):
        for axis in range(3):
            place = np.float64(points[i, axis]) / CELL_SIZE
            voxel[axis] = int(np.floor(place))
            if axis < 2:
                voxel[axis] = min(max(voxel[axis], 0), TILE_CELLS - 1)
            planes[6 + axis, i] = min(max(int((place - voxel[axis]) * PLACES), 0), PLACES - 1)
        cell = voxel[1] * TILE_CELLS + voxel[0]
        for k in range(2):
            planes[k, i] = ((cell - last_cell) >> (8 * k)) & 0xFF
        for k in range(4):
            planes[2 + k, i] = ((voxel[2] - last_layer) >> (8 * k)) & 0xFF
        last_cell = cell
        last_layer = voxel[2]


@kernel
def _placed(planes: U8, points: F32) -> bool:
    """Fill ``points`` (m, 3) from (9, m); whether each lies in its voxel."""
    cell = np.int64(0)
    layer = np.int64(0)
    sound = True
    for i in range(len(points)):
        cell = (cell + np.int64(planes[0, i]) + (np.int64(planes[1, i]) << 8)) & (CELLS - 1)
        way = np.int64(0)
        for k in range(4):
            way |= np.int64(planes[2 + k, i]) << (8 * k)
        layer = ((layer + way + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
        for axis, voxel in enumerate((cell % TILE_CELLS, cell // TILE_CELLS, layer)):
            points[i, axis] = (voxel + (planes[6 + axis, i] + 0.5) / PLACES) * CELL_SIZE
            sound &= planes[6 + axis, i] < PLACES
    return sound


@kernel
def _all_inside(points: F32, side: np.float32) -> bool:
    """Whether all points (m, 3) are finite and within a tile; NaN fails every comparison."""
    sound = True
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        sound &= 0 <= x < side and 0 <= y < side and abs(z) <= 1e5
    return sound


@kernel
def _most_in_a_cell(points: F32, counts: I64) -> int:
    """The most of these points (m, 3), from the tile's corner and inside it, that lie in one cell; ``counts`` (cells,):
    scratch, zeros."""
    most = 0
    for i in range(len(points)):
        row = int(points[i, 1] / CELL_SIZE)
        col = int(points[i, 0] / CELL_SIZE)
        cell = min(row, TILE_CELLS - 1) * TILE_CELLS + min(col, TILE_CELLS - 1)
        counts[cell] += 1
        most = max(most, counts[cell])
    return most


# Odds: how sure a vehicle is of each cell that it calls changed, log-odds, one byte a cell. The states say which cells
# these are, so none is named again.

STEPS_PER_NAT = 4
"""To a nat: rounding moves a probability by .03 at the most, and eighths would take a fifth more bytes."""
MOST_STEPS = 127
"""31.75 nats: beyond all that anybody can know."""
UNSAID = -128
"""Where no confidence is stated; no ballot holds it."""


def in_steps(log_odds: F64) -> I8:
    """(n,) log-odds in nats as whole steps, the nearest, no farther from 0 than MOST_STEPS."""
    return np.clip(np.rint(log_odds * STEPS_PER_NAT), -MOST_STEPS, MOST_STEPS).astype(np.int8)


def in_nats(steps: I8) -> F64:
    """(n,) log-odds in nats; UNSAID has no meaning."""
    return steps.astype(np.float64) / STEPS_PER_NAT


def changed_cells_of(states: U8) -> I64:
    """(m,) flat cells that the states (256, 256) call changed, ascending."""
    # Against a CellState numpy compares in int64.
    occupied = int(CellState.CHANGED_OCCUPIED)
    empty = int(CellState.CHANGED_EMPTY)
    return np.flatnonzero((states == occupied) | (states == empty))


def pack_odds(steps: I8) -> bytes:
    """(m,) of the changed cells of a tile, in their order."""
    return compress(np.ascontiguousarray(steps, dtype=np.int8).tobytes())


# Path: a cell of the lattice every few metres, for display. Cells as steps from one to the next, int32, under zstd: two
# hundred bytes for a kilometre.


def pack_path(positions: Sequence[F64], lattice: Lattice) -> bytes:
    """Positions (x, y, ..) in map metres, in the order driven, thinned to one every
    ``BallotLimits.path_step_m``; the first and last stay."""
    kept: list[F64] = []
    for position in positions:
        if not kept or np.hypot(*(position[:2] - kept[-1][:2])) >= BALLOT_LIMITS.path_step_m:
            kept.append(position)
    if len(positions):
        kept.append(positions[-1])
    cells = np.stack(lattice.cells_of(np.reshape(kept, (len(kept), -1))[: BALLOT_LIMITS.path_cells]), axis=1)
    return pack_plane(np.diff(cells, axis=0, prepend=0).astype(np.int32))


def unpack_path(data: bytes) -> I64:
    """(n, 2) rows and columns on the lattice; MapvoteError if damaged."""
    raw = unpack_bytes(data, 8 * BALLOT_LIMITS.path_cells, "ballot: path")
    if len(raw) % 8:
        raise MapvoteError(f"ballot: path has {len(raw)} bytes, not a multiple of 8")
    return np.cumsum(np.frombuffer(raw, dtype="<i4").reshape(-1, 2).astype(np.int64), axis=0)


def check_path(data: bytes, tiles: Collection[TileIndex]) -> None:
    """MapvoteError unless the path is sound and never farther than a tile from ``tiles``, on which its drive voted."""
    for tile in np.unique(unpack_path(data) // TILE_CELLS, axis=0):
        if not _is_near(tile, tiles):
            raise MapvoteError(f"ballot: path leads over tile {tile[0]},{tile[1]}, far from where the drive voted")


def path_near(data: bytes, tiles: Collection[TileIndex]) -> bytes:
    """The path without its cells that are farther than a tile from ``tiles``."""
    cells = unpack_path(data)
    passed, which = np.unique(cells // TILE_CELLS, axis=0, return_inverse=True)
    near = np.array([_is_near(tile, tiles) for tile in passed], dtype=np.bool_)
    kept = cells[near[which.ravel()]]
    return pack_plane(np.diff(kept, axis=0, prepend=np.zeros((1, 2), np.int64)).astype(np.int32))


def _is_near(tile: I64, voted: Collection[TileIndex]) -> bool:
    others = np.array(list(voted), dtype=np.int64).reshape(-1, 2)
    return bool((np.abs(others - tile).max(axis=1, initial=0) <= 1).any())
