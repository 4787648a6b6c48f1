"""Ballot <-> bytes: all that passes between vehicle and server (docs/decisions/data.md).

A msgpack envelope of zstd-compressed planes. Reading checks every size before it allocates memory; a ballot of another
format, or without a required field, is refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated

import msgspec
import numpy as np

from mapvote.codec.arrays import pack_plane as pack_plane
from mapvote.codec.arrays import unpack_into, unpack_plane
from mapvote.codec.odds import changed_cells_of, unpack_odds
from mapvote.codec.points import unpack_points
from mapvote.core.grid import TILE_CELLS, TileIndex
from mapvote.core.types import F32, I8, N_STATES, NO_VOTE, U8, U16, MapvoteError

FORMAT_VERSION = 1
MAX_TILES = 4096
MAX_TILE_INDEX = 1 << 20
_CELLS = TILE_CELLS * TILE_CELLS

Id = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z")]
"""Vehicle and drive names: 1-64 of letters, digits, dot, underscore, dash; they appear in URLs and file names."""
_Text = Annotated[str, msgspec.Meta(pattern=r"^[^\x00-\x1f]*\Z", max_length=200)]
"""No control characters: some databases refuse them, and no log should print them."""
_Hash = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{0,64}\Z")]
_Count = Annotated[int, msgspec.Meta(ge=0, le=1 << 31)]


class BallotTile(msgspec.Struct, frozen=True, kw_only=True):
    """One tile's votes. Planes are compressed; see :func:`states_of` and its neighbours."""

    tile: tuple[int, int]
    states: bytes | None = None
    """(256, 256) uint8 CellState or NO_VOTE: two-stage."""
    tally: bytes | None = None
    """(5, 256, 256) uint16 votes in VOTE_UNITs, class-major: one-stage."""
    gone: bytes | None = None
    """(256, 256) uint64, see codec/words.py: which voxels of a changed-empty cell are gone (delete mask)."""
    new_points: bytes | None = None
    """(m, 3) from the tile's corner, see codec/points.py, sorted by voxel key: one per 0.3 m voxel of changed-occupied
    cells."""
    intensity: bytes | None = None
    """(m,) uint8 of each of them, 255 for 1.0; None: the map holds no intensity, or the sensor measures none."""
    free: bytes | None = None
    """(256, 256) uint64, likewise: voxels that this drive's rays passed through."""
    odds: bytes | None = None
    """(changed cells,) int8 in the order of the states, see codec/odds.py: how sure the vehicle is of each; two-stage
    alone. None: it does not say."""


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
    """Where it drove (codec/path.py); None if the ballot does not say."""
    tiles: list[BallotTile]

    @property
    def stage(self) -> str:
        """ "two-stage" if the vehicle decided its cells, "one-stage" if it sends its tally."""
        return "one-stage" if any(tile.tally is not None for tile in self.tiles) else "two-stage"


_BALLOT = msgspec.msgpack.Decoder(Ballot)
"""Made when the module is loaded: msgspec makes what it knows of a type at its first use, and the process crashes where
two threads do so at once."""


def tile_index(key: str) -> TileIndex:
    """The inverse of :func:`tile_key`; ValueError if it is none."""
    row, _, col = key.partition(",")
    return int(row), int(col)


def tile_key(tile: TileIndex) -> str:
    """The name of a tile in manifests and ballots: "row,col"."""
    return f"{tile[0]},{tile[1]}"


def unpack_states(data: bytes) -> U8:
    """(256, 256) uint8; MapvoteError if damaged or not a CellState."""
    return check_states(unpack_plane(data, "<u1", (TILE_CELLS, TILE_CELLS), "ballot: states"))


def unpack_sound_states(data: bytes) -> U8:
    """(256, 256) uint8, of a ballot that the server took in; MapvoteError as :func:`unpack_states`."""
    states = np.empty(_CELLS, dtype=np.uint8)
    unpack_into(data, states, "ballot: states")
    return check_states(states.reshape(TILE_CELLS, TILE_CELLS))


def check_states(states: U8) -> U8:
    """The same, of any shape; MapvoteError if one is no cell state."""
    if not ((states < N_STATES) | (states == NO_VOTE)).all():
        raise MapvoteError("ballot: states holds a value that is no cell state")
    return states


def unpack_tally(data: bytes) -> U16:
    """(256, 256, 5) uint16; MapvoteError if damaged."""
    return np.moveaxis(unpack_plane(data, "<u2", (N_STATES, TILE_CELLS, TILE_CELLS), "ballot: tally"), 0, -1)


def unpack_offer(
    new_points: bytes | None, intensity: bytes | None, unpack: Callable[[bytes], F32] = unpack_points
) -> tuple[F32 | None, U8 | None]:
    """The new points (m, 3) of a tile and their intensity (m,), of their planes; MapvoteError as ``unpack`` (of a
    ballot that the server took in, :func:`unpack_sound_points`), and if there is not one for each."""
    points = None if new_points is None else unpack(new_points)
    if intensity is None:
        return points, None
    if points is None:
        raise MapvoteError("ballot: a tile has the intensity of new points, but none of those")
    return points, unpack_plane(intensity, "|u1", (len(points),), "ballot: intensity")


def unpack_sureness(odds: bytes | None, states: U8 | None) -> I8 | None:
    """(changed cells of ``states`` (256, 256),) how sure the vehicle is of each, see codec/odds.py; None if it does not
    say. MapvoteError as :func:`mapvote.codec.odds.unpack_odds`, and if there are odds but no states."""
    if odds is None:
        return None
    if states is None:
        raise MapvoteError("ballot: a tile has the odds of changed cells, but no states")
    return unpack_odds(odds, len(changed_cells_of(states)))


def encode(ballot: Ballot) -> bytes:
    """The ballot as one self-contained file."""
    return msgspec.msgpack.encode(ballot)


def decode(data: bytes) -> Ballot:
    """Check the envelope; planes are checked when they are unpacked. MapvoteError if unusable."""
    try:
        ballot = _BALLOT.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:  # ValidationError is a DecodeError
        raise MapvoteError(f"ballot: not readable ({error}); was it written by this version of mapvote?") from error
    if ballot.format_version != FORMAT_VERSION:
        raise MapvoteError(f"ballot: format {ballot.format_version}; this mapvote reads format {FORMAT_VERSION}")
    indices = [t.tile for t in ballot.tiles]
    if len(indices) > MAX_TILES or len(set(indices)) != len(indices):
        raise MapvoteError(f"ballot: {len(indices)} tiles; at most {MAX_TILES}, each once")
    for tile in ballot.tiles:
        if max(abs(tile.tile[0]), abs(tile.tile[1])) > MAX_TILE_INDEX:
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
