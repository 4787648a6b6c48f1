"""Random histories of a street lived through by the store and by its rules in plain words: how often do they differ?

python benchmarks/histories.py --sqlite 2000 --postgres 300
python benchmarks/histories.py --sqlite 100 --postgres 0 --csv results/histories.csv      # goes on where that ends

Drives that repeat, objects that come, go and come back, policies that change, minimum age, withdrawal, rollback,
replay, verdicts of reviewers and racing publishers, in one of three copies of ballots too (tests/histories.py). After
every publish another one without new votes must change nothing. Prints every disagreement with its seed, and at the end
a line for docs/measurements/votes.md. With ``--csv`` every history is a row (database, seed, steps, what disagreed),
appended as it ends.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

TESTS = Path(__file__).parents[1] / "tests"
sys.path.insert(0, str(TESTS))

from hand_made import two_walls  # noqa: E402
from histories import START_S, Clock, live  # noqa: E402
from mapvote.server.store.store import Store  # noqa: E402
from postgres_cluster import PostgresCluster  # noqa: E402

MakeStore = Callable[[Clock], Store]


@contextmanager
def on_sqlite() -> Iterator[MakeStore]:
    """New stores, each a copy of one that was made once; in memory where the machine has a place for that."""
    shm = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as folder:
        first = Path(folder) / "first.db"
        Store.create(f"sqlite:///{first}", two_walls(), clock=lambda: START_S * 10**9).close()

        def make(clock: Clock) -> Store:
            file = Path(folder) / "store.db"
            for old in Path(folder).glob("store.db*"):
                old.unlink()
            shutil.copy(first, file)
            return Store.open(f"sqlite:///{file}", clock=clock)

        yield make


@contextmanager
def on_postgres() -> Iterator[MakeStore]:
    """The same on a private PostgreSQL."""
    cluster, numbers = PostgresCluster(), itertools.count()
    try:
        Store.create(cluster.create("first"), two_walls(), clock=lambda: START_S * 10**9).close()

        def make(clock: Clock) -> Store:
            return Store.open(cluster.create(f"s{next(numbers)}", like="first"), clock=clock)

        yield make
    finally:
        cluster.close()


def first_seed(file: Path | None, database: str, otherwise: int) -> int:
    """The seed after the last one in the file."""
    if file is None or not file.exists():
        return otherwise
    with file.open() as rows:
        return max((int(row[1]) + 1 for row in csv.reader(rows) if row[0] == database), default=otherwise)


def tell(file: Path | None, *row: object) -> None:
    if file is not None:
        with file.open("a", newline="") as rows:
            csv.writer(rows).writerow(row)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sqlite", type=int, default=2000)
    parser.add_argument("--postgres", type=int, default=300)
    parser.add_argument("--first", type=int, default=10_000, help="seed of the first history")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--csv", type=Path, help="append a row for every history, and go on after the last one there")
    asked = parser.parse_args()
    for name, stores, n in (("SQLite", on_sqlite, asked.sqlite), ("PostgreSQL", on_postgres, asked.postgres)):
        if n:
            counted: Counter[str] = Counter()
            start, wrong, first = time.process_time(), 0, first_seed(asked.csv, name, asked.first)
            with stores() as make:
                for done, seed in enumerate(range(first, first + n), 1):
                    found = live(seed, make, asked.steps, counted)
                    tell(asked.csv, name, seed, asked.steps, found or "")
                    wrong += found is not None
                    if found is not None or done % 100 == 0 or done == n:
                        line = f"| {name} | {done} histories of {asked.steps} steps | {wrong} mismatches |"
                        line += f" {counted['repeated']} publishes repeated, {counted['remnants']} remnants gone |"
                        print(found or f"{line} {time.process_time() - start:.0f} s of CPU |", flush=True)


if __name__ == "__main__":
    main()
