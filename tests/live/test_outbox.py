"""Ballots on disk survive a kill at any moment: no ballot is lost, none comes twice, none is damaged."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live.loopback_dds import until
from mapvote.client import MapClient
from mapvote.codec.ballot import Ballot, check_path, decode, encode, pack_path, unpack_path
from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file as really_whole_file
from mapvote.live import outbox as outbox_module
from mapvote.live.outbox import Journal, Outbox, OutboxSizes, ballot_of, records

MAP = make_map({(0, 0): make_tile(wall([(1, 1)], [1.0])), (0, 1): make_tile(wall([(1, 1)], [1.0]), index=(0, 1))})


def ballot(drive: str, scans: int = 10, tile: int = 0) -> Ballot:
    made = make_ballot(MAP, {(0, tile): Say(states_plane({(1, 1): 3}))}, "car", drive)
    return msgspec.structs.replace(made, scans=scans, scans_localised=scans)


def said(folder: Path) -> dict[str, int]:
    """By drive, how many scans the ballots in a folder are of."""
    found = [decode(file.read_bytes()) for file in folder.glob("car~*.ballot")]
    return {one.drive: one.scans for one in found}


def open_outbox(tmp_path: Path, **more: Any) -> Outbox:
    return Outbox(
        tmp_path / "state", "car", folder=tmp_path / "out", say=lambda _: None, sizes=OutboxSizes(retry_s=0.05), **more
    )


def leave(box: Outbox, n: int, *, last: bool = False) -> None:
    """The n-th ballot of the day is closed."""
    box.leave(f"day-{n:03d}", lambda: ballot(f"day-{n:03d}"), None if last else f"day-{n + 1:03d}")


def left_files(tmp_path: Path) -> list[str]:
    return sorted(f.name for f in (tmp_path / "state/car").iterdir() if f.name not in (".lock", ".last"))


def test_a_journal_cut_off_at_any_byte_gives_the_ballot_of_its_whole_records(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "a.journal")
    parts = [ballot("a", 5), ballot("a", 9, tile=1), ballot("a", 12)]
    ends = []
    for part in parts:
        journal.append(encode(part))
        ends.append(journal.path.stat().st_size)
    whole = journal.path.read_bytes()
    for length in {*range(0, len(whole), 7), *ends, *(end - 1 for end in ends)}:
        journal.path.write_bytes(whole[:length])
        n = int(np.searchsorted(ends, length, side="right"))
        assert list(records(journal.path)) == parts[:n]
        found = ballot_of(journal.path)
        assert (found is None) == (n == 0)
        if found is not None:
            assert (found.scans, [t.tile for t in found.tiles]) == ([5, 9, 12][n - 1], [(0, 0), (0, 1)][: min(n, 2)])
    journal.path.write_bytes(whole + b"half a record")
    journal.append(encode(ballot("a", 15)))
    assert [part.scans for part in records(journal.path)] == [5, 9, 12, 15], "what is written next takes its place"


def test_the_ballot_of_a_journal_is_valid_though_its_vehicle_drove_on_beyond_the_tiles_that_were_written(
    tmp_path: Path,
) -> None:
    drove = [np.array([10.0 * k, 20.0, 1.8]) for k in range(60)]
    part = msgspec.structs.replace(ballot("a"), path=pack_path(drove, MAP.lattice))
    with pytest.raises(MapvoteError, match="far from where the drive voted"):
        check_path(part.path or b"", [(0, 0)])
    journal = Journal(tmp_path / "a.journal")
    journal.append(encode(part))
    found = ballot_of(journal.path)
    assert found is not None
    assert found.path is not None
    check_path(found.path, [(0, 0)])
    columns = unpack_path(found.path)[:, 1] * CELL_SIZE
    assert (columns.min(), columns.max()) == pytest.approx((0.0, 150.0), abs=CELL_SIZE)


class Killed(BaseException):
    """The process ends here: nothing of it runs on."""


@pytest.fixture
def kill_at(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], list[str]]]:
    """Ends the process at the k-th of the calls by which files are changed; gives the names of those that were made."""

    def arm(k: int) -> list[str]:
        made: list[str] = []

        def counted(name: str, real: Callable[..., Any]) -> Callable[..., Any]:
            def call(*args: Any, **kwargs: Any) -> Any:
                if len(made) >= k:
                    raise Killed
                made.append(name)
                return real(*args, **kwargs)

            return call

        for name in ("replace", "fsync"):
            monkeypatch.setattr(os, name, counted(name, getattr(os, name)))
        monkeypatch.setattr(Path, "unlink", counted("unlink", Path.unlink))
        return made

    yield arm
    monkeypatch.undo()


def test_killed_between_any_two_file_operations_every_closed_ballot_comes_once_and_the_open_one_to_its_last_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kill_at: Callable[[int], list[str]]
) -> None:
    for k in range(100):
        home = tmp_path / str(k)
        (home / "out").mkdir(parents=True)
        with monkeypatch.context():
            made = kill_at(k)
            ended = False
            box = open_outbox(home)
            try:
                assert box.begin("day") == 1
                box.keep("day-001", ballot("day-001", 5))
                box.leave("day-001", lambda: ballot("day-001", 10), "day-002")
                box.keep("day-002", ballot("day-002", 7))
            except Killed:
                box._lock.close()
            else:
                try:
                    box.close()
                    ended = True
                except Killed:
                    pass
        monkeypatch.undo()
        again = open_outbox(home)
        number = again.begin("day")
        again.close()
        found, written = said(home / "out"), made.count("fsync")
        assert left_files(home) == []
        assert found.get("day-001") in ((10,) if ended else (None, 5, 10)), (k, made)
        assert found.get("day-002") in ((7,) if ended else (None, 7))
        assert number > max((int(drive[-3:]) for drive in found), default=0)
        if written > 3:  # .last, the first record, the closed ballot
            assert "day-001" in found
        if ended:
            return
    raise AssertionError("the drive never came to its end")


def test_one_process_at_a_time_drives_as_a_vehicle_and_no_number_is_given_twice(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    open_outbox(tmp_path).close()  # one that never began
    numbers = []
    for _ in range(3):
        box = open_outbox(tmp_path)
        with pytest.raises(MapvoteError, match="another process drives as car"):
            open_outbox(tmp_path)
        numbers.append(box.begin("day"))
        leave(box, numbers[-1], last=True)
        box.close()
    assert numbers == [1, 2, 3]
    assert set(said(tmp_path / "out")) == {"day-001", "day-002", "day-003"}


def test_a_full_disk_is_said_once_and_nothing_is_lost_that_it_takes_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said_of, full = list[str](), [False]

    def whole_file(path: Path, **more: Any) -> Any:
        if full[0]:
            raise MapvoteError(f"{path}: cannot be written (No space left on device)")
        return really_whole_file(path, **more)

    monkeypatch.setattr(outbox_module, "whole_file", whole_file)
    (tmp_path / "out").mkdir()
    box = Outbox(
        tmp_path / "state", "car", folder=tmp_path / "out", say=said_of.append, sizes=OutboxSizes(retry_s=0.02)
    )
    box.begin("day")
    full[0] = True
    for n in range(1, 4):
        leave(box, n)
    while box.report.failed_writes < 4:
        pass
    assert said(tmp_path / "out") == {}
    full[0] = False
    box.close()
    assert set(said(tmp_path / "out")) == {"day-001", "day-002", "day-003"}
    assert sum("No space left" in text for text in said_of) == 1
    assert sum("takes ballots again" in text for text in said_of) == 1


def test_a_disk_that_takes_small_files_and_deletes_but_no_ballot_is_not_said_to_take_ballots(tmp_path: Path) -> None:
    """A real refusal of the system: no file of this process may grow beyond 64 bytes."""
    said_of = list[str]()
    (tmp_path / "out").mkdir()
    box = Outbox(
        tmp_path / "state", "car", folder=tmp_path / "out", say=said_of.append, sizes=OutboxSizes(retry_s=0.02)
    )
    assert box.begin("day") == 1
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, before[1]))
    try:
        for n in range(1, 5):
            box.keep(f"day-{n:03d}", ballot(f"day-{n:03d}", 5))
            leave(box, n)
        box.discard("day-004")
        until(lambda: box.report.failed_writes > 12)
        assert len(said_of) == 5, said_of
        assert sum("File too large" in text for text in said_of) == 1
        assert sum("scans voted" in text for text in said_of) == 4
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    box.close()
    assert set(said(tmp_path / "out")) == {f"day-{n:03d}" for n in range(1, 5)}
    assert [text for text in said_of if "again" in text] == [f"{tmp_path}/state/car: the disk takes ballots again"]


def test_while_the_server_is_away_ballots_wait_in_the_spool_and_the_scan_loop_does_not(tmp_path: Path) -> None:
    away = MapClient("http://127.0.0.1:9", home=tmp_path / "home", attempts=1, timeout_s=0.2, sleep=lambda _: None)
    box = Outbox(tmp_path / "home/live", "car", client=away, say=lambda _: None, sizes=OutboxSizes(retry_s=0.02))
    box.begin("day")
    for n in range(1, 21):
        leave(box, n)
    box.close()
    assert away.waiting("car") == box.report.spooled == 20
    assert box.report.sent == 0
