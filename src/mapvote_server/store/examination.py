"""A ballot as it arrives: its envelope is decoded at once, its planes are unpacked a slice at a time. No database."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mapvote.codec.ballot import Ballot, BallotTile, Planes, check_path, decode, tile_key, unpack_planes
from mapvote.core.grid import TILE_CELLS, TileIndex
from mapvote.core.record import record
from mapvote.core.types import Bool, MapvoteError
from mapvote_server.store import schema
from mapvote_server.store.database import remembered, sum_of


@record()
@dataclass(frozen=True, slots=True)
class ExaminationRule:
    """Limits of a ballot's content."""

    unpacked_bytes: int = 512 << 20
    """All planes of one ballot together, decompressed, bytes: some ten kilometres of street."""
    min_scans: int = 3
    """Localised scans below which a drive founds no ballot: its place was never confirmed by others."""
    misfit_sigmas: float = 3.0
    """Standard deviations of the priors by which the fixes of a drive may lie off them."""
    misfit_slack_m: float = 1.0
    """Metres more by which they may. A drive steadily beyond is held back: its clock, its GNSS or its place is
    wrong."""


EXAMINATION_RULE = ExaminationRule()


@dataclass(frozen=True, slots=True)
class Votes:
    """Facts of a ballot's votes on one tile, for admission."""

    tile: TileIndex
    spoken: bytes
    """The cells that it votes on: 65536 bits, row by row."""
    heights_m: tuple[float, float] | None
    """Heights of its lowest and highest new point, map metres; None: it has none."""
    stored: tuple[Any, ...] = field(repr=False)
    """Base, planes and sum, as the last columns of ``ballot_tiles``."""


@dataclass(frozen=True, slots=True)
class Incoming:
    """A ballot that is sound in itself."""

    ballot: Ballot
    votes: Sequence[Votes]
    """The votes on each of its tiles."""
    digest: str
    """SHA-256 of the bytes that the vehicle sent."""
    cast_by: str
    """Method and stage: all ballots of a round agree on them."""
    size: int
    """Bytes."""
    key_hash: str | None = None
    """Hash of the key that sent the ballot; None: a client of this machine that needs none."""

    @property
    def drive(self) -> tuple[str, str]:
        """(vehicle, drive)."""
        return self.ballot.vehicle, self.ballot.drive


class Examination:
    """A ballot whose envelope is sound; :meth:`go_on` unpacks its planes.

    MapvoteError if the envelope is not, or if the ballot is of another ``drive`` (vehicle, drive) than its URL. The key
    is not checked.
    """

    def __init__(self, data: bytes, drive: tuple[str, str] | None = None, key_hash: str | None = None) -> None:
        ballot = decode(data)
        if not ballot.tiles:
            raise MapvoteError("ballot: votes on no tile")
        _check_founded(ballot)
        if any((tile.states is None) != (ballot.tiles[0].states is None) for tile in ballot.tiles):
            raise MapvoteError(
                "ballot: some tiles hold states and some a tally; a ballot is either two-stage or one-stage"
            )
        self.ballot = ballot
        self.cast_by = f"{ballot.method}, {ballot.stage}"
        self.size = len(data)
        self.digest = hashlib.sha256(data).hexdigest()
        self._key_hash = key_hash
        self._votes: list[Votes] = []
        self._unpacked_bytes = 0
        if drive not in (None, self.drive):
            raise MapvoteError(f"the ballot is of {'/'.join(self.drive)}, not {drive[0][:64]}/{drive[1][:64]}")

    @property
    def drive(self) -> tuple[str, str]:
        """(vehicle, drive)."""
        return self.ballot.vehicle, self.ballot.drive

    @property
    def tiles(self) -> list[TileIndex]:
        """The tiles that it votes on."""
        return [tile.tile for tile in self.ballot.tiles]

    def go_on(self, for_s: float = math.inf) -> Incoming | None:
        """Unpack tiles until all are done or ``for_s`` seconds of CPU are used; the ballot, or None if tiles remain.

        MapvoteError on the first defect.
        """
        if not self._votes and self.ballot.path is not None:
            check_path(self.ballot.path, self.tiles)
        ends_s = time.thread_time() + for_s
        for tile in self.ballot.tiles[len(self._votes) :]:
            planes = unpack_planes(tile)
            self._unpacked_bytes += planes.nbytes
            if self._unpacked_bytes > EXAMINATION_RULE.unpacked_bytes:
                most = f"ballot: larger than {EXAMINATION_RULE.unpacked_bytes} bytes when decompressed"
                raise MapvoteError(f"{most}; send a shorter drive")
            self._votes.append(_votes_of(tile, self.ballot.base[tile_key(tile.tile)], planes))
            if time.thread_time() > ends_s:
                break
        if len(self._votes) < len(self.ballot.tiles):
            return None
        return Incoming(self.ballot, self._votes, self.digest, self.cast_by, self.size, self._key_hash)


def examine(data: bytes, drive: tuple[str, str] | None = None, key_hash: str | None = None) -> Incoming:
    """The whole of :class:`Examination` at once; MapvoteError as there."""
    incoming = Examination(data, drive, key_hash).go_on()
    assert incoming is not None
    return incoming


def _votes_of(tile: BallotTile, base: str, planes: Planes) -> Votes:
    packed = base, *(getattr(tile, plane) for plane in schema.BALLOT_PLANES)
    digest = sum_of(*packed)
    remembered.put(digest, planes)
    z = () if planes.new_points is None else planes.new_points[:, 2]
    heights = (float(np.min(z)), float(np.max(z))) if len(z) else None
    return Votes(tile.tile, np.packbits(planes.spoken()).tobytes(), heights, (*packed, digest))


def _check_founded(ballot: Ballot) -> None:
    if ballot.scans_localised < EXAMINATION_RULE.min_scans:
        raise MapvoteError(
            f"ballot: only {ballot.scans_localised} of {ballot.scans} scans were localised, "
            f"{EXAMINATION_RULE.min_scans} are needed; drive farther on the map"
        )
    if ballot.prior_misfit_m is None or ballot.prior_sigma_m is None:
        return
    allowed = EXAMINATION_RULE.misfit_sigmas * ballot.prior_sigma_m + EXAMINATION_RULE.misfit_slack_m
    if ballot.prior_misfit_m > allowed:
        raise MapvoteError(
            f"ballot held back: fixes and priors of {ballot.vehicle}/{ballot.drive} lie {ballot.prior_misfit_m:.1f} m "
            f"apart (median), the priors claim {ballot.prior_sigma_m:.2f} m; check the vehicle's clock and GNSS, state "
            "its true sigma, or vote without a prior (--prior none)"
        )


def cells_of(spoken: bytes) -> Bool:
    """(256, 256) bool, of packed bits."""
    bits = np.unpackbits(np.frombuffer(spoken, dtype=np.uint8))
    return bits.astype(np.bool_).reshape(TILE_CELLS, TILE_CELLS)
