"""The decision record: what a version decided about a tile, which ballots counted, and why the others did not.

A publish writes one record a tile that it decided. So "who says so" is read, not fused again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapvote.codec.ballot import Odds
from mapvote.codec.planes import compress, raw_plane, unpack_bytes, unpack_plane
from mapvote.core.grid import CELLS, TILE_CELLS
from mapvote.core.types import I64, N_STATES, U8, MapvoteError
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.edit import EditVotes
from mapvote.fusion.gravity import Fallen
from mapvote.fusion.loss_budget import unpack_agreed
from mapvote.fusion.tile_vote import Vote, Why

_BYTE_MAX = 255
_MAX_STANDINGS_BYTES = 64 << 20

_Standing = tuple[int, Why, bytes, bytes, int]
"""Ballot, why it did not count, its spent and its reviewed cells (flat, ascending, uint16 little-endian), the ballot
that it is a copy of; see :class:`mapvote.fusion.tile_vote.Vote`."""
_STANDINGS = msgspec.msgpack.Decoder(list[_Standing])  # made when the module is loaded: see codec/ballot.py


def pack_standings(votes: Iterable[Vote]) -> bytes:
    """All votes on a tile as one blob: their ballots, and why they did not count. Planes and names are left out."""
    standings = [
        (vote.ballot, vote.why, vote.spent.astype("<u2").tobytes(), vote.reviewed.astype("<u2").tobytes(), vote.alike)
        for vote in votes
    ]
    return compress(msgspec.msgpack.encode(standings), 1)


def unpack_standings(data: bytes) -> list[Vote]:
    """The inverse of :func:`pack_standings`; MapvoteError if it is damaged."""
    raw = unpack_bytes(data, _MAX_STANDINGS_BYTES, "decision: standings")
    try:
        standings = _STANDINGS.decode(raw)
    except msgspec.DecodeError as error:
        raise MapvoteError(f"decision: standings are damaged ({error})") from error
    return [
        Vote(ballot=ballot, why=reason, spent=_cells_in(spent), reviewed=_cells_in(reviewed), alike=alike)
        for ballot, reason, spent, reviewed, alike in standings
    ]


def _cells_in(data: bytes) -> I64:
    return np.frombuffer(data, dtype="<u2").astype(np.int64)


@dataclass(frozen=True)
class Record:
    """The decision of one version about one tile. Planes are unpacked on demand; MapvoteError if one is damaged."""

    version: int
    """0: none yet."""
    packed_states: bytes
    packed_tally: bytes
    packed_odds: bytes | None
    packed_standings: bytes
    packed_edits: bytes | None = None
    packed_fell: bytes | None = None

    @cached_property
    def states(self) -> U8:
        """(256, 256) CellState or NO_VOTE."""
        return unpack_decided(self.packed_states)

    @cached_property
    def votes(self) -> NDArray[Any]:
        """(256, 256, 5) whole votes per CellState, as :func:`unpack_votes`."""
        return unpack_votes(self.packed_tally)

    @cached_property
    def odds(self) -> Odds:
        """Log-odds of the changed cells by the vehicles that voted for them."""
        return unpack_agreed(self.packed_odds, self.states)

    @cached_property
    def edit_votes(self) -> EditVotes:
        """Votes behind what came and went in cells of which the states state no such change."""
        return EditVotes.none() if self.packed_edits is None else unpack_edit_votes(self.packed_edits)

    @cached_property
    def fell(self) -> tuple[I64, I64]:
        """(flat cells (n,) of which something fell, the first deleted cell of what it fell with (n,), see
        :class:`mapvote.fusion.gravity.Fallen`)."""
        return unpack_fell(self.packed_fell)

    @cached_property
    def standings(self) -> Sequence[Vote]:
        """Every vote that stood on the tile, without its planes and names, and why it did not count; in the order of
        the ballots."""
        return unpack_standings(self.packed_standings)


def unpack_decided(data: bytes) -> U8:
    """(256, 256) CellState or NO_VOTE. MapvoteError if it is damaged."""
    return unpack_plane(data, "<u1", (TILE_CELLS, TILE_CELLS), "decision: states")


def pack_tally(tally: NDArray[Any]) -> bytes:
    """(256, 256, 5) as a zstd frame of little-endian planes, class by class, which packs four times better than cell
    by cell: int32, or of unsigned numbers, which are whole votes, these as uint8; as they are if that holds too little.
    The length tells which."""
    planes = np.moveaxis(tally, -1, 0)
    if planes.dtype == np.int32:
        return compress(raw_plane(planes, "<i4"), 1)
    votes = planes // planes.dtype.type(VOTE_UNIT)
    return compress(raw_plane(votes, "|u1") if votes.max() <= _BYTE_MAX else raw_plane(planes, "<u2"), 1)


def unpack_votes(data: bytes) -> NDArray[Any]:
    """The whole votes of a packed tally, (256, 256, 5) uint8, uint16 or int32, whichever holds them: a view of planes,
    so that who asks for some cells pays for these."""
    raw = unpack_bytes(data, 4 * N_STATES * CELLS, "decision: tally")
    dtype, unit = {N_STATES * CELLS: ("|u1", 1), 2 * N_STATES * CELLS: ("<u2", VOTE_UNIT)}.get(
        len(raw), ("<i4", VOTE_UNIT)
    )
    planes = np.frombuffer(raw, dtype=dtype).reshape(N_STATES, TILE_CELLS, TILE_CELLS)
    return np.moveaxis(planes if unit == 1 else planes // unit, 0, -1)


_EDIT_FIELDS = ("cells", "<u2"), ("states", "|u1"), ("votes", "<u2"), ("against", "<u2")


def pack_edit_votes(edits: EditVotes) -> bytes | None:
    """Edit votes as a zstd frame, field by field; None if there are none."""
    if not len(edits.cells):
        return None
    return compress(b"".join(getattr(edits, name).astype(dtype).tobytes() for name, dtype in _EDIT_FIELDS), 1)


def unpack_edit_votes(data: bytes) -> EditVotes:
    """The inverse of :func:`pack_edit_votes`; MapvoteError if it is damaged."""
    sizes = [np.dtype(dtype).itemsize for _, dtype in _EDIT_FIELDS]
    raw = unpack_bytes(data, sum(sizes) * CELLS, "decision: edits")
    n, left = divmod(len(raw), sum(sizes))
    if left:
        raise MapvoteError(f"decision: edits are damaged ({len(raw)} bytes)")
    starts = np.cumsum([0, *sizes[:-1]]) * n
    cells, states, votes, against = (
        np.frombuffer(raw, dtype, n, int(start)) for (_, dtype), start in zip(_EDIT_FIELDS, starts, strict=True)
    )
    return EditVotes(cells.astype(np.int64), states, votes.astype(np.int32), against.astype(np.int32))


def pack_fell(fell: Fallen) -> bytes | None:
    """The cells of which something fell, and with what, as a zstd frame; None if there are none."""
    if not len(fell.cells):
        return None
    return compress(fell.cells.astype("<u2").tobytes() + fell.beside.astype("<i8").tobytes(), 1)


def unpack_fell(data: bytes | None) -> tuple[I64, I64]:
    """The inverse of :func:`pack_fell`, (n,) each; MapvoteError if it is damaged."""
    raw = b"" if data is None else unpack_bytes(data, 10 * CELLS, "decision: fell")
    n, left = divmod(len(raw), 10)
    if left:
        raise MapvoteError(f"decision: fell is damaged ({len(raw)} bytes)")
    return np.frombuffer(raw, "<u2", n).astype(np.int64), np.frombuffer(raw, "<i8", n, 2 * n).astype(np.int64)
