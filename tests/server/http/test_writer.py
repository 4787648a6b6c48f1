"""Many requests, one piece of work: each gets its own answer, whatever becomes of the others."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Sequence

from mapvote.server.http.services import Batcher


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
