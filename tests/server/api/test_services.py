"""Many requests, one piece of work: each gets its own answer. Memory of ballots on their way."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Sequence

import pytest

from mapvote_server.api.services import Batcher, RateLimit, Uploads
from mapvote_server.errors import TooLarge, TooMany, Unavailable


class Ledger:
    """Doubles numbers, refuses the odd ones, and breaks on a batch that holds a zero. Each batch takes a moment."""

    def __init__(self) -> None:
        self.batches: list[list[int]] = []
        self.gate = threading.Event()

    def work(self, numbers: Sequence[int]) -> list[int | Exception]:
        self.gate.wait(5.0)
        self.batches.append(list(numbers))
        if 0 in numbers:
            raise OSError("the disk is full")
        return [2 * n if n % 2 == 0 else ValueError(n) for n in numbers]


def answers(ledger: Ledger, numbers: Sequence[int], limit: int = 100) -> list[int | BaseException]:
    async def ask() -> list[int | BaseException]:
        batcher: Batcher[int, int] = Batcher(ledger.work, limit)
        asked = [asyncio.create_task(batcher.put(n)) for n in numbers]
        await asyncio.sleep(0.05)
        ledger.gate.set()
        found = await asyncio.gather(*asked, return_exceptions=True)
        await batcher.close()
        return found

    return asyncio.run(ask())


def test_who_comes_together_is_served_together_and_each_hears_its_own_answer() -> None:
    ledger = Ledger()
    found = answers(ledger, [2, 3, 4])
    assert ledger.batches == [[2, 3, 4]]
    assert (found[0], found[2]) == (4, 8)
    assert isinstance(found[1], ValueError)


def test_a_batch_is_no_longer_than_its_limit() -> None:
    ledger = Ledger()
    assert answers(ledger, range(2, 22, 2), limit=4) == list(range(4, 44, 4))
    assert [len(batch) for batch in ledger.batches] == [4, 4, 2]


def test_a_failure_of_the_whole_batch_is_heard_by_all_of_it_and_by_nobody_else() -> None:
    ledger = Ledger()
    found = answers(ledger, [2, 0, 4, 6], limit=3)
    assert all(isinstance(answer, OSError) for answer in found[:3])
    assert found[3] == 12


def test_who_goes_away_leaves_the_others_their_answers() -> None:
    ledger = Ledger()

    async def ask() -> int:
        batcher: Batcher[int, int] = Batcher(ledger.work, 100)
        impatient, patient = asyncio.create_task(batcher.put(2)), asyncio.create_task(batcher.put(4))
        await asyncio.sleep(0.01)
        impatient.cancel()
        ledger.gate.set()
        return await patient

    assert asyncio.run(ask()) == 8


class Slow:
    """A body whose pieces come when told."""

    def __init__(self) -> None:
        self.pieces: asyncio.Queue[bytes] = asyncio.Queue()

    async def stream(self) -> AsyncIterator[bytes]:
        while piece := await self.pieces.get():
            yield piece

    async def send(self, piece: bytes) -> None:
        self.pieces.put_nowait(piece)
        for _ in range(3):
            await asyncio.sleep(0)


def test_when_memory_is_short_the_largest_upload_goes_and_a_small_one_is_taken() -> None:
    async def story() -> None:
        uploads = Uploads(each=100, together=150)
        bodies = [Slow() for _ in range(3)]
        reads = [asyncio.create_task(uploads.read(f"v{i}", body.stream(), None)) for i, body in enumerate(bodies)]
        await bodies[0].send(bytes(90))
        await bodies[1].send(bytes(50))
        await bodies[2].send(bytes(20))
        assert not any(read.done() for read in reads)
        for body in bodies[1:]:
            await body.send(b"x")
            await body.send(b"")
        assert [len(await read) for read in reads[1:]] == [51, 21]
        await bodies[0].send(b"more")
        with pytest.raises(Unavailable, match="send this one again"):
            await reads[0]
        again = Slow()
        read = asyncio.create_task(uploads.read("v0", again.stream(), None))
        await again.send(bytes(100))
        await again.send(b"")
        assert len(await read) == 100

    asyncio.run(story())


def test_one_vehicle_holds_so_many_uploads_and_no_more_and_others_are_not_counted() -> None:
    async def story() -> None:
        uploads, bodies = Uploads(each=100, together=1000), [Slow() for _ in range(Uploads.AT_ONCE)]
        reads = [asyncio.create_task(uploads.read("v", body.stream(), None)) for body in bodies]
        await asyncio.sleep(0)
        with pytest.raises(TooMany, match="'v'"):
            await uploads.read("v", Slow().stream(), None)
        other, last = Slow(), Slow()
        read = asyncio.create_task(uploads.read("w", other.stream(), None))
        await other.send(b"ballot")
        await other.send(b"")
        assert await read == b"ballot"
        for body, one in zip(bodies, reads, strict=True):
            await body.send(b"")
            await one
        read = asyncio.create_task(uploads.read("v", last.stream(), None))
        await last.send(b"")
        assert await read == b""

    asyncio.run(story())


@pytest.mark.parametrize("declared", ["101", None])
def test_a_body_beyond_the_limit_is_refused_announced_or_not(declared: str | None) -> None:
    async def pieces() -> AsyncIterator[bytes]:
        for _ in range(11):
            yield bytes(10)

    with pytest.raises(TooLarge, match="100"):
        asyncio.run(Uploads(each=100, together=1000).read("v", pieces(), declared))


def test_a_bucket_refills_with_time_and_looking_into_it_takes_nothing_out() -> None:
    now = 0.0
    limit = RateLimit(per_minute=60.0, burst=2, clock=lambda: now)
    for _ in range(5):
        limit.check("v")
    limit.take("v")
    limit.take("v")
    with pytest.raises(TooMany, match="60") as refused:
        limit.take("v")
    assert refused.value.after_s == 1.0
    with pytest.raises(TooMany):
        limit.check("v")
    limit.take("w")
    now = 1.0
    limit.take("v")
