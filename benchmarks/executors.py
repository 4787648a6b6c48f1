"""A round of one store fused alone, by two threads, and over Dask with two workers on this machine, in turns.

    python benchmarks/executors.py                 # 1,000 tiles; needs mapvote[server,dask]

Nothing is published. Every executor fuses once before it is measured, so that nobody compiles. ``own_cpu_s`` is the CPU
of the process that publishes, without Dask's workers.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing

from distributed import Client, LocalCluster

from city import build
from mapvote_server.store.publish import preview
from mapvote_server.store.store import Store


def timed(url: str, name: str, executor: Executor | None) -> dict[str, object]:
    """One dry run of a store that was just opened: nothing of an earlier round is kept."""
    with closing(Store.open(url)) as store:
        start = time.perf_counter()
        cpu_s = time.process_time()
        outcome = preview(store, executor=executor)
        wall_s = time.perf_counter() - start
        own_cpu_s = time.process_time() - cpu_s
    row = {"executor": name, "tiles": len(outcome.tiles), "points_deleted": outcome.points_deleted}
    return row | {"wall_s": round(wall_s, 1), "own_cpu_s": round(own_cpu_s, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, default=1000)
    parser.add_argument("--turns", type=int, default=2)
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
        ThreadPoolExecutor(2) as threads,
    ):
        url = f"sqlite:///{folder}/store.db"
        build(url, options.tiles, 9)
        executors: Mapping[str, Executor | None] = {
            "alone": None, "two threads": threads, "two Dask workers": client.get_executor()
        }  # fmt: skip
        for turn in range(options.turns + 1):
            for name, executor in executors.items():
                row = timed(url, name, executor)
                if turn:
                    print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
