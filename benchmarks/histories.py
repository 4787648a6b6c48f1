"""Random histories of a street lived through by the store and by its rules in plain words: how often do they differ?

python benchmarks/histories.py --sqlite 2000 --postgres 300

Drives that repeat, objects that come, go and come back, policies that change, minimum age, withdrawal, rollback,
replay, verdicts of reviewers and racing publishers, in one of three copies of ballots too (tests/histories.py). After
every publish another one without new votes must change nothing. Prints every disagreement with its seed, and at the end
a line for docs/measurements/votes.md.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import two_walls
from histories import START_S, live
from mapvote.server.store.store import Store
from postgres_cluster import PostgresCluster
from standing_clock import Clock


@contextmanager
def stores(on_postgres: bool) -> Iterator[Callable[[Clock], Store]]:
    """New stores, each a copy of one that was made once; SQLite in memory where the machine has a place for that."""
    shm, numbers = Path("/dev/shm"), itertools.count()
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as folder:
        cluster, first, file = PostgresCluster() if on_postgres else None, f"{folder}/first.db", f"{folder}/store.db"
        url = cluster.create("first") if cluster else f"sqlite:///{first}"
        Store.create(url, two_walls(), clock=lambda: START_S * 10**9).close()

        def make(clock: Clock) -> Store:
            if cluster:
                return Store.open(cluster.create(f"s{next(numbers)}", like="first"), clock=clock)
            for old in Path(folder).glob("store.db*"):
                old.unlink()
            return Store.open(f"sqlite:///{shutil.copy(first, file)}", clock=clock)

        try:
            yield make
        finally:
            if cluster:
                cluster.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sqlite", type=int, default=2000)
    parser.add_argument("--postgres", type=int, default=300)
    parser.add_argument("--first", type=int, default=10_000, help="seed of the first history")
    parser.add_argument("--steps", type=int, default=20)
    asked = parser.parse_args()
    for name, n in (("SQLite", asked.sqlite), ("PostgreSQL", asked.postgres)):
        if not n:
            continue
        counted: Counter[str] = Counter()
        start, wrong = time.process_time(), 0
        with stores(name == "PostgreSQL") as make:
            for done in range(1, n + 1):
                found = live(asked.first + done - 1, make, asked.steps, counted)
                wrong += found is not None
                if found is not None or done % 100 == 0 or done == n:
                    line = f"| {name} | {done} histories of {asked.steps} steps | {wrong} mismatches |"
                    line += f" {counted['repeated']} publishes repeated, {counted['remnants']} remnants gone |"
                    print(found or f"{line} {time.process_time() - start:.0f} s of CPU |", flush=True)


if __name__ == "__main__":
    main()
