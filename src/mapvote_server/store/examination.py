"""A ballot as it arrives: its envelope is decoded at once, its planes are unpacked a slice at a time. No database."""

from __future__ import annotations

import hashlib
import math
import time
from dataclasses import dataclass

import numpy as np

from mapvote.codec.ballot import Ballot, BallotTile, check_path, decode, encode_tile, tile_key, unpack_planes
from mapvote.core.grid import TILE_CELLS, TileIndex
from mapvote.core.record import record
from mapvote.core.types import Bool, MapvoteError
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


class Examination:
    """A ballot as it arrives. Its envelope is sound; its planes are once :meth:`go_on` has unpacked them all.

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
        """Method and stage: all ballots of a round agree on them."""
        self.size = len(data)
        """Bytes."""
        self.digest = hashlib.sha256(data).hexdigest()
        """SHA-256 of the bytes that the vehicle sent."""
        self.key_hash = key_hash
        """Hash of the key that sent the ballot; None: a client of this machine that needs none."""
        self.spoken: dict[TileIndex, bytes] = {}
        """The cells on which it votes, by tile: 65536 bits, row by row."""
        self.heights_m: dict[TileIndex, tuple[float, float]] = {}
        """Heights of the lowest and the highest new point on each tile that has any, map metres."""
        self.sums: dict[TileIndex, str] = {}
        """The sum of each tile's row of ``ballot_tiles``."""
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

    def go_on(self, for_s: float = math.inf) -> bool:
        """Unpack tiles until all are done or ``for_s`` seconds of CPU are used; whether all are done.

        MapvoteError on the first defect.
        """
        if not self.spoken and self.ballot.path is not None:
            check_path(self.ballot.path, self.tiles)
        ends_s = time.thread_time() + for_s
        for tile in self.ballot.tiles[len(self.spoken) :]:
            self._unpack(tile)
            if time.thread_time() > ends_s:
                break
        return len(self.spoken) == len(self.ballot.tiles)

    def _unpack(self, tile: BallotTile) -> None:
        planes = unpack_planes(tile)
        self._unpacked_bytes += planes.nbytes
        if self._unpacked_bytes > EXAMINATION_RULE.unpacked_bytes:
            most = f"ballot: larger than {EXAMINATION_RULE.unpacked_bytes} bytes when decompressed"
            raise MapvoteError(f"{most}; send a shorter drive")
        self.spoken[tile.tile] = np.packbits(planes.spoken()).tobytes()
        if planes.new_points is not None and len(planes.new_points):
            z = planes.new_points[:, 2]
            self.heights_m[tile.tile] = (float(np.min(z)), float(np.max(z)))
        # A publish soon after need not unpack them again.
        self.sums[tile.tile] = sum_of(self.ballot.base[tile_key(tile.tile)], encode_tile(tile))
        remembered.put(self.sums[tile.tile], planes)


def examine(data: bytes, drive: tuple[str, str] | None = None, key_hash: str | None = None) -> Examination:
    """The whole of :class:`Examination` at once; MapvoteError as there."""
    examined = Examination(data, drive, key_hash)
    examined.go_on()
    return examined


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
