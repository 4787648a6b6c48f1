"""A publish of one store fused alone, by two threads, and over Dask with two workers on this machine, in turns.

    python benchmarks/executors.py                 # 1,000 tiles; needs mapvote[server,dask]

Each publish has a copy of the store and a process of its own. Every executor fuses once before it is measured (a dry
run of the same store), so that nobody compiles. ``cpu_s`` is the CPU of the process that publishes, ``workers_cpu_s``
that of Dask's workers; ``memory_mb`` and ``workers_mb`` are the highest resident memories, of all workers together.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path

from distributed import Client, LocalCluster

from city import build
from mapvote_server.store.publish import preview, publish
from mapvote_server.store.store import Store

EXECUTORS = ("alone", "two threads", "two Dask workers")


def used() -> tuple[float, int]:
    """(CPU, seconds; highest resident memory, MB) of this process."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss // 1024


@contextmanager
def executor_of(name: str) -> Iterator[tuple[Executor | None, Client | None]]:
    """An executor, and the client of its cluster if it has one."""
    if name == "two Dask workers":
        with (
            LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):
            yield client.get_executor(), client
    elif name == "two threads":
        with ThreadPoolExecutor(2) as threads:
            yield threads, None
    else:
        yield None, None


def published(file: Path, name: str) -> dict[str, object]:
    """One publish of a store."""
    with executor_of(name) as (executor, client), closing(Store.open(f"sqlite:///{file}")) as store:
        preview(store, executor=executor)
        workers = client.run(used) if client else {}
        with closing(Store.open(f"sqlite:///{file}")) as again:  # nothing of the dry run is kept
            cpu_s, _ = used()
            start = time.perf_counter()
            outcome = publish(again, override=True, executor=executor)
            wall_s = time.perf_counter() - start
        now = client.run(used) if client else {}
        spent_s, memory_mb = used()
    return {
        "executor": name,
        "tiles": len(outcome.tiles),
        "points_deleted": outcome.points_deleted,
        "wall_s": round(wall_s, 1),
        "cpu_s": round(spent_s - cpu_s, 1),
        "workers_cpu_s": round(sum(now[worker][0] - workers[worker][0] for worker in now), 1),
        "memory_mb": memory_mb,
        "workers_mb": sum(mb for _, mb in now.values()),
        "load": round(os.getloadavg()[0], 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, default=1000)
    parser.add_argument("--turns", type=int, default=2)
    parser.add_argument("--one", nargs=2, metavar=("STORE", "EXECUTOR"), help="only this publish")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(published(Path(options.one[0]), options.one[1])), flush=True)
        return
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder) / "store.db"
        build(f"sqlite:///{built}", options.tiles, 9)
        copy = Path(folder) / "copy.db"
        for _ in range(options.turns):
            for name in EXECUTORS:
                shutil.copy(built, copy)
                subprocess.run([sys.executable, __file__, "--one", str(copy), name], check=True)


if __name__ == "__main__":
    main()
