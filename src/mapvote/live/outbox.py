"""Ballots of a live drive on disk: the open one as a journal, closed ones until the server has them.

STATE/VEHICLE holds, of each ballot ``NAME-003`` of a vehicle, one of

* ``NAME-003.journal``: it is open. Every record is a ballot of some tiles, as they stood then; of each tile the last
  record counts. A record that a crash cut off is left out.
* ``NAME-003.ballot``: it is closed and whole, on its way to the spool of the server or to a folder.

``.last`` names the last ballot that was begun: no name is given twice, whatever ended the process. One thread writes
and another sends, so that no slow disk delays a scan and no slow server delays the disk.
"""

from __future__ import annotations

import fcntl
import logging
import os
import queue
import re
import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec

from mapvote.client import MapClient
from mapvote.codec.ballot import Ballot, decode, encode, path_near
from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.vehicle import stretch_name

log = logging.getLogger("mapvote.live")
_RECORD = struct.Struct("<II")
"""Before each record of a journal: its length, and its CRC-32."""


@record()
@dataclass(frozen=True, slots=True)
class OutboxSizes:
    """Numbers of the outbox of a live vehicle."""

    retry_s: float = 60.0
    """Time between two attempts to send waiting ballots, or to write again after a full disk, seconds."""
    journal_s: float = 8.0
    """Time after which a tile with new votes is written to the journal, seconds. With the waiting scans, and with tiles
    that are written one at a time, a crash costs less than 30 s of road."""
    journal_share: float = 0.05
    """Share of the time that this takes at most, while no tile waits for more than twice as long."""
    held: int = 64
    """Closed ballots that are held in memory while the disk is full: with cuts of 10 minutes half a day."""
    queued: int = 256
    """Pieces of work that wait for the disk; tiles of the open ballot are not added to more. It is half an hour of
    road."""


OUTBOX_SIZES = OutboxSizes()
_LAST = "the name of the last ballot"


class Journal:
    """The open ballot of one stretch of road. Only whole records are ever read back."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._end = 0
        """Where the last whole record ends."""

    def append(self, record: bytes) -> None:
        """Add one record, on disk when this returns. MapvoteError if the disk takes it not; it is then not there."""
        try:
            with self.path.open("r+b" if self.path.exists() else "w+b") as file:
                file.truncate(self._end)
                file.seek(self._end)
                file.write(_RECORD.pack(len(record), zlib.crc32(record)) + record)
                file.flush()
                os.fsync(file.fileno())
                self._end = file.tell()
        except OSError as error:
            raise MapvoteError(f"{self.path}: cannot be written ({error.strerror or error})") from error


def records(path: Path) -> Iterator[Ballot]:
    """The whole records of a journal, in order; what follows the first that is cut off or damaged is left out."""
    data = path.read_bytes()
    at = 0
    while at + _RECORD.size <= len(data):
        length, crc = _RECORD.unpack_from(data, at)
        record = data[at + _RECORD.size : at + _RECORD.size + length]
        at += _RECORD.size + length
        if len(record) < length or zlib.crc32(record) != crc:
            return
        try:
            yield decode(record)
        except MapvoteError:
            return


def ballot_of(path: Path) -> Ballot | None:
    """The ballot that a journal amounts to: of each tile its last record. None if there is no whole record."""
    tiles = {}
    base = {}
    last = None
    for last in records(path):
        tiles.update({tile.tile: tile for tile in last.tiles})
        base.update(last.base)
    if last is None:
        return None
    driven = None if last.path is None else path_near(last.path, tiles)  # the newest tiles are not in the journal yet
    return msgspec.structs.replace(last, tiles=[tiles[index] for index in sorted(tiles)], base=base, path=driven)


@dataclass(slots=True)
class OutboxReport:
    """Outcomes of ballots and records since the start."""

    closed: int = 0
    """Ballots that are whole and on disk."""
    empty: int = 0
    """Stretches without a localised scan: they have no ballot."""
    sent: int = 0
    refused: int = 0
    recovered: int = 0
    """Ballots of a drive that was cut off before this one began."""
    lost_ballots: int = 0
    """The disk did not take them for too long."""
    failed_writes: int = 0
    spooled: int = 0
    """Ballots that wait for the server now."""


class Outbox:
    """Where one vehicle's ballots wait. Only one process at a time holds a vehicle's outbox.

    ``client`` sends them, or ``folder`` takes them, or both. ``say`` is given a sentence about each.
    """

    def __init__(
        self,
        state: Path,
        vehicle: str,
        *,
        client: MapClient | None = None,
        folder: Path | None = None,
        say: Callable[[str], None] = log.warning,
        sizes: OutboxSizes = OUTBOX_SIZES,
    ) -> None:
        """MapvoteError if another process drives as this vehicle."""
        self.vehicle = vehicle
        self.report = OutboxReport()
        self._client = client
        self._folder = folder
        self._say = say
        self.sizes = sizes
        self._state = state / vehicle
        self._state.mkdir(parents=True, exist_ok=True)
        self._lock = (self._state / ".lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._lock.close()
            raise MapvoteError(
                f"{self._state}: another process drives as {vehicle}; stop it, or give this one its own --vehicle"
            ) from error
        self._work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._journals: dict[str, Journal] = {}
        self._unwritten: dict[str, bytes] = {}
        """Closed ballots that the disk did not take yet, by drive."""
        self._last = ""
        """The ballot that was begun last."""
        self._failing = set[str]()
        """Kinds of work that the disk refused last."""
        self._broken: BaseException | None = None
        self._to_send = threading.Event()
        self._ended = threading.Event()
        self._begun = False
        self._writer = threading.Thread(target=self._guarded, args=(self._write,), name="outbox", daemon=True)
        self._sender = threading.Thread(target=self._guarded, args=(self._send,), name="sender", daemon=True)

    def begin(self, name: str) -> int:
        """Close what a drive that was cut off left open, and begin to write and send. Returns the number of the first
        ballot of drive ``name``: one more than that of its last one, which an earlier process may have begun."""
        open_stretches = {file.stem for suffix in ("journal", "ballot") for file in self._state.glob(f"*.{suffix}")}
        last = self._state / ".last"
        stretches = [*open_stretches, last.read_text() if last.exists() else ""]
        named = [match for match in (re.fullmatch(r"(.+)-(\d{3,})", stretch) for stretch in stretches) if match]
        number = max((int(m[2]) for m in named if m[1] == name), default=0) + 1
        self._begin_ballot(stretch_name(name, number))
        for drive in sorted(open_stretches):
            self._recover(drive)
        self._writer.start()
        self._sender.start()
        self._begun = True
        return number

    def close(self) -> None:
        """Write the ballots in memory, try once to send those that wait, and end. Ballots that could not be sent stay
        in the spool. An outbox that never began has nothing to write."""
        if self._begun:
            self._work.put(None)
            self._writer.join()
            self._ended.set()
            self._to_send.set()
            self._sender.join()
        self._lock.close()
        self._raise_if_broken()

    def keep(self, drive: str, part: Ballot) -> None:
        """``part``: the open ballot of some tiles. Returns at once. It is dropped while the disk hangs: the ballot is
        written whole when it is closed."""
        self._raise_if_broken()
        if self._work.qsize() < self.sizes.queued:
            self._work.put(lambda: self._append(drive, part))

    def leave(self, drive: str, written: Callable[[], Ballot], following: str | None = None) -> None:
        """``drive`` is closed, and ``written`` makes its ballot; the ballot ``following`` begins. Returns at once."""
        self._raise_if_broken()
        self._work.put(lambda: self._close(drive, written, following))

    def discard(self, drive: str) -> None:
        """Delete the journal of this ballot. Returns at once."""
        self._work.put(lambda: self._end_journal(drive))

    def _raise_if_broken(self) -> None:
        if self._broken is not None:
            raise self._broken

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:  # the drive ends with it: see keep and leave
            self._broken = error

    def _path(self, drive: str, kind: str) -> Path:
        return self._state / f"{drive}.{kind}"

    def _begin_ballot(self, drive: str) -> None:
        self._last = drive
        with self._disk_may_fail(_LAST), whole_file(self._state / ".last") as part:
            part.write_text(drive)

    def _recover(self, drive: str) -> None:
        """A ballot that another process left open or on its way."""
        journal = self._path(drive, "journal")
        if not self._path(drive, "ballot").exists():
            ballot = ballot_of(journal)
            if ballot is not None:
                self.report.recovered += 1
                self._say(
                    f"{drive}: was cut off. Its journal holds {ballot.scans_localised} scans up to stamp "
                    f"{ballot.end_ns}: they vote. Later votes are missing, at most 30 s"
                )
                self._put_down(drive, encode(ballot))
        journal.unlink(missing_ok=True)

    def _write(self) -> None:
        going = True
        self._pass_on()
        while going:
            try:
                work = self._work.get(timeout=self.sizes.retry_s)
            except queue.Empty:
                work = self._put_down_all
            going = work is not None
            (work or self._put_down_all)()

    def _append(self, drive: str, part: Ballot) -> None:
        with self._disk_may_fail(f"the journal {drive}"):
            self._journals.setdefault(drive, Journal(self._path(drive, "journal"))).append(encode(part))

    def _close(self, drive: str, written: Callable[[], Ballot], following: str | None) -> None:
        if following is not None:
            self._begin_ballot(following)
        try:
            ballot = written()
        except MapvoteError as error:
            self.report.empty += 1
            self._say(f"{drive}: no ballot ({error})")
            self._end_journal(drive)
            return
        self._say(f"{drive}: {ballot.scans_localised} of {ballot.scans} scans voted")
        self._unwritten[drive] = encode(ballot)
        while len(self._unwritten) > self.sizes.held:
            oldest = next(iter(self._unwritten))
            del self._unwritten[oldest]
            self.report.lost_ballots += 1
            self._failing.discard(f"the ballot {oldest}")
            self._say(f"{oldest}: is lost; the disk has taken no ballot for too long")
        self._put_down_all()

    def _put_down_all(self) -> None:
        """Write the closed ballots that are not on disk, and pass on those that are."""
        if _LAST in self._failing:
            self._begin_ballot(self._last)
        for drive, data in list(self._unwritten.items()):
            with self._disk_may_fail(f"the ballot {drive}"):
                self._put_down(drive, data)
                del self._unwritten[drive]
                self.report.closed += 1
                self._is_over(f"the journal {drive}")
            if drive not in self._unwritten:
                self._end_journal(drive)
        self._pass_on()

    def _put_down(self, drive: str, data: bytes) -> None:
        with whole_file(self._path(drive, "ballot"), private=True) as part:
            part.write_bytes(data)

    def _end_journal(self, drive: str) -> None:
        with self._disk_may_fail("the end of a journal"):
            self._journals.pop(drive, None)
            self._path(drive, "journal").unlink(missing_ok=True)

    def _pass_on(self) -> None:
        """Move whole ballots to the folder and the spool. Each is in a file at every moment; twice is harmless."""
        for whole in sorted(self._state.glob("*.ballot")):
            with self._disk_may_fail(f"the way of {whole.stem}"):
                data = whole.read_bytes()
                if self._folder is not None:
                    with whole_file(self._folder / f"{self.vehicle}~{whole.stem}.ballot") as part:
                        part.write_bytes(data)
                if self._client is not None:
                    self._client.keep(data)
                whole.unlink()
        self._to_send.set()

    def _send(self) -> None:
        """Send what waits, whenever there is more, and again every minute."""
        ended = self._client is None
        while self._client is not None and not ended:
            self._to_send.wait(self.sizes.retry_s)
            self._to_send.clear()
            ended = self._ended.is_set()
            for name, came in self._client.flush(self.vehicle).items():
                if isinstance(came, MapvoteError):
                    self.report.refused += 1
                    self._say(f"{name}: {came}")
                elif came != "spooled":
                    self.report.sent += 1
                    self._say(f"{name}: {came} at the server")
            self.report.spooled = self._client.waiting(self.vehicle)

    @contextmanager
    def _disk_may_fail(self, work: str) -> Iterator[None]:
        """Reports once that the disk cannot be written, and once that it can be again: when each kind of ``work`` that
        failed has succeeded. That a small file can be written, or a file be deleted, says nothing of a ballot."""
        try:
            yield
        except (MapvoteError, OSError) as error:
            self.report.failed_writes += 1
            if not self._failing:
                self._say(f"{error}. The drive goes on. Closed ballots wait in memory; a crash now loses the open one")
            self._failing.add(work)
        else:
            self._is_over(work)

    def _is_over(self, work: str) -> None:
        """This kind of work has succeeded, or is not needed any more."""
        if self._failing == {work}:
            self._say(f"{self._state}: the disk takes ballots again")
        self._failing.discard(work)
