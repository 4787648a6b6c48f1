"""CPU seconds that each numba kernel takes to compile, and by how many signatures: python benchmarks/compile_time.py

Everything that `mapvote warmup` compiles, into an empty cache. Kernels that numba inlines count where they are used.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import defaultdict

os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="mapvote-compile-")

from numba.core import event

from mapvote.warmup import warm_up


class Clock(event.Listener):
    """Adds up what each kernel's compilation takes, without that of the kernels it calls."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.signatures: dict[str, int] = defaultdict(int)
        self.running: list[tuple[float, float]] = []

    def on_start(self, event: event.Event) -> None:
        self.running.append((time.process_time(), 0.0))

    def on_end(self, event: event.Event) -> None:
        start, within = self.running.pop()
        took = time.process_time() - start
        function = event.data["dispatcher"].py_func
        name = f"{function.__module__.removeprefix('mapvote.')}.{function.__name__}"
        self.seconds[name] += took - within
        self.signatures[name] += 1
        if self.running:
            outer, inside = self.running[-1]
            self.running[-1] = (outer, inside + took)


def main() -> None:
    clock = Clock()
    event.register("numba:compile", clock)
    whole = sum(seconds for _, seconds in warm_up())
    print(f"{'CPU s':>7} {'signatures':>10}  kernel")
    for name, seconds in sorted(clock.seconds.items(), key=lambda item: -item[1]):
        print(f"{seconds:7.2f} {clock.signatures[name]:10d}  {name}")
    total = sum(clock.seconds.values())
    print(f"{total:7.2f} {sum(clock.signatures.values()):10d}  in all; {whole:.1f} s with the work itself")


if __name__ == "__main__":
    main()
