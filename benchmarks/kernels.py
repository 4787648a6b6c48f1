"""Cost of every compiled kernel, and of plain numpy in its place.

    python benchmarks/kernels.py [ROOM.FILE ...]

Each kernel that Python calls is recorded while a street is mapped, voted on, fused and shown, and while `evaluate
corner` runs. Its call with the most bytes is then made again: compiled, and by NUMPY, the same work in plain numpy. A
kernel of which each step depends on the one before (a hash table, a flood, a walk, a solver) has no such form: there
the interpreter runs the loop over the same numpy arrays (NUMBA_DISABLE_JIT), for at most MOST_S. Prints the table of
docs/measurements/kernels.md: CPU time, the least of some runs, a row for each file.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SRC = Path(__file__).parents[1] / "src"
KINDS = {"kernel", "fast_math", "allocating", "inlined"}
MOST_S = 20
MOST_BYTES = 64 << 20
CELL = 0.3


def kernels() -> dict[str, dict[str, set[str]]]:
    """By module all its kernels, each with those of its module that it calls."""
    found: dict[str, dict[str, set[str]]] = {}
    for source in sorted(SRC.rglob("*.py")):
        functions = [n for n in ast.walk(ast.parse(source.read_text())) if isinstance(n, ast.FunctionDef)]
        mine = [f for f in functions if any(d in KINDS or "njit" in d for d in map(ast.unparse, f.decorator_list))]
        if mine:
            names = {f.name for f in mine}
            calls = {f.name: {n.id for n in ast.walk(f) if isinstance(n, ast.Name) and n.id in names} for f in mine}
            found[".".join(source.relative_to(SRC).with_suffix("").parts)] = calls
    return found


class Recorder:
    """Stands in the place of a kernel, and keeps the arguments of its largest call."""

    def __init__(self, kernel: Any) -> None:
        self.kernel, self.bytes, self.given = kernel, -1, b""
        self.py_func, self.signatures = kernel.py_func, kernel.signatures

    def __call__(self, *given: Any) -> Any:
        size = sum(part.nbytes for part in _arrays(given))
        if self.bytes < size <= MOST_BYTES:
            self.bytes, self.given = size, pickle.dumps(given)
        return self.kernel(*given)


def _arrays(given: Any) -> list[np.ndarray]:
    if isinstance(given, np.ndarray):
        return [given]
    return [array for part in given for array in _arrays(part)] if isinstance(given, tuple | list) else []


def recorded(work: list[Callable[[], object]]) -> dict[str, Recorder]:
    """Every kernel that Python calls during the ``work``, by module and name."""
    from numba.core.dispatcher import Dispatcher

    held: dict[int, Recorder] = {}
    replaced = []
    for module in [m for name, m in list(sys.modules.items()) if name.startswith("mapvote")]:
        for name, value in list(vars(module).items()):
            if isinstance(value, Dispatcher) and not value.targetoptions.get("inline"):
                setattr(module, name, held.setdefault(id(value), Recorder(value)))
                replaced.append((module, name, value))
    for do in work:
        with contextlib.redirect_stdout(sys.stderr):
            do()
    for module, name, value in replaced:
        setattr(module, name, value)
    return {f"{r.py_func.__module__}.{r.py_func.__name__}": r for r in held.values() if r.bytes >= 0}


def least_ms(function: Callable[..., object], given: bytes, runs: int = 6) -> float:
    """Milliseconds of CPU of one call; the arguments are fresh each time, and the first call compiles."""
    took = []
    for _ in range(runs):
        arguments = pickle.loads(given)
        start = time.perf_counter_ns()
        function(*arguments)
        took.append(time.perf_counter_ns() - start)
    return 1e-6 * min(took[1:])


def interpreted_ms(name: str, given: bytes, folder: Path) -> float:
    """The same by the interpreter, in a process that compiles nothing; infinite beyond MOST_S."""
    (folder / "given").write_bytes(given)
    code = (
        "import importlib, pickle, sys, time\n"
        "module, name = sys.argv[1].rsplit('.', 1)\n"
        "function = getattr(importlib.import_module(module), name)\n"
        "given = pickle.load(open(sys.argv[2], 'rb'))\n"
        "start = time.process_time(); function(*given); print(1e3 * (time.process_time() - start))\n"
    )
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONWARNINGS": "ignore"}
    command = [sys.executable, "-c", code, name, str(folder / "given")]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=MOST_S + 10)
    except subprocess.TimeoutExpired:
        return float("inf")
    if done.returncode:
        raise RuntimeError(f"{name}: {done.stderr[-800:]}")
    return float(done.stdout)


def _flat_cells(points, x0, y0, lattice_x0, lattice_y0, row0, col0, rows, cols, flat):  # type: ignore[no-untyped-def]
    row = np.floor((points[:, 1].astype(np.float64) + y0 - lattice_y0) / CELL).astype(np.int64) - row0
    col = np.floor((points[:, 0].astype(np.float64) + x0 - lattice_x0) / CELL).astype(np.int64) - col0
    flat[:] = np.clip(row, 0, rows - 1) * cols + np.clip(col, 0, cols - 1)


def _obstacles(words, points, corner, place, ground_z, base, counts, bottom_z, top_z):  # type: ignore[no-untyped-def]
    flat = np.empty(len(points), dtype=np.int64)
    _flat_cells(points, *corner, *place[:4], flat)
    row, col = np.divmod(flat, place[3])
    row, col = row + place[4], col + place[5]
    here = np.flatnonzero((row >= 0) & (col >= 0) & (row < words.shape[0]) & (col < words.shape[1]))
    cells = row[here], col[here]
    z = points[here, 2].astype(np.float64)
    tall = z - np.where(np.isnan(ground_z[cells]), base[cells] * CELL, ground_z[cells]) >= CELL
    z, cells = z[tall], (cells[0][tall], cells[1][tall])
    bits = np.clip(np.floor(z / CELL).astype(np.int64) - base[cells], 0, 63).astype(np.uint64)
    np.bitwise_or.at(words, cells, np.uint64(1) << bits)
    if len(counts):
        np.add.at(counts, cells, 1)
        np.minimum.at(bottom_z, cells, z.astype(np.float32))
        np.maximum.at(top_z, cells, z.astype(np.float32))


def _transformed(T: Any, points: Any, out: Any) -> None:
    out[:] = points @ T[:3, :3].T + T[:3, 3]


def _cast(tally: Any, states: Any, weights: Any) -> None:
    r, c = np.nonzero(states != 255)
    tally[r, c, states[r, c]] += weights[r, c]


def _decided(tally: Any, backers: Any, abstain: bool, least: int, states: Any) -> None:
    determined = tally[:4] if abstain else tally
    best, total = determined.max(axis=0), tally[:4].sum(axis=0, dtype=np.int64)
    states[:] = determined.argmax(axis=0)
    states[(determined == best).sum(axis=0) > 1] = 4
    states[best == 0] = np.where(tally[4] > 0, 4, 255)[best == 0]
    mine = np.take_along_axis(backers, np.minimum(states, 4)[None], axis=0)[0]
    states[((states == 2) | (states == 3)) & ((mine < least) | (abstain & (2 * best <= total)))] = 4


def _counted(one: Any, two: Any, three: Any, four: Any, counts: Any) -> None:
    for state in range(5):
        for voter in (one, two, three, four):
            counts[state] += voter == state


def _keys(points: Any, x0: float, y0: float, size: float, keys: Any) -> None:
    i = np.floor((points - [x0, y0, 0.0]) / size).astype(np.int64) + (1 << 20)
    keys[:] = (i[:, 0] << 42) | (i[:, 1] << 21) | i[:, 2]


def _summed(points: Any, of: Any, rows: Any, sums: Any) -> None:
    of = of[: len(points)]
    here = of >= 0
    np.add.at(sums, (rows[of[here]], 0), 1.0)
    for axis in range(3):
        np.add.at(sums, (rows[of[here]], 1 + axis), points[here, axis])


def _points_out(planes: Any, points: Any) -> None:
    ways = planes[:6].astype(np.int64)
    cell = np.cumsum(ways[0] + (ways[1] << 8)) & 65535
    layer = np.cumsum(ways[2] + (ways[3] << 8) + (ways[4] << 16) + (ways[5] << 24)).astype(np.int32)
    points[:] = ((np.stack([cell % 256, cell // 256, layer]) + (planes[6:] + 0.5) / 256) * CELL).T


def _words_out(raw: Any, cells: Any, words: Any) -> bool:
    n = len(cells)
    way = raw[:n] + 256 * raw[n : 2 * n].astype(np.intp)
    cells[:] = np.cumsum(way)
    words[:] = np.ascontiguousarray(raw[2 * n :].reshape(8, n).T).view("<u8").reshape(n)
    return bool((way[1:] > 0).all() and words.all())


def _marked(reached: Any, cells: Any, words: Any) -> None:
    for level in range(len(reached) - 1, 0, -1):
        reached[level, cells] |= reached[level - 1, cells] & words
    reached[0, cells] |= words


def _marked_spoken(reached: Any, cells: Any, words: Any, own: Any) -> None:
    spoken = own[cells] != 255
    _marked(reached, cells[spoken], words[spoken])


def _marked_among(reached: Any, cells: Any, words: Any, own: Any, said: int, among: Any) -> None:
    both = (own[cells] == said) & np.isin(cells, among)
    _marked(reached, np.searchsorted(among, cells[both]), words[both])


def _agreeing(cells: Any, own: Any, decided: Any, state: int, found: Any) -> object:
    return np.flatnonzero((decided[cells] == state) & (own[cells] == state))


def _deskewed(flat: Any, time_s: Any, motion: Any, turn: Any, rows: Any) -> None:
    (t, v, w), points = motion, flat.reshape(-1, 3)
    u = v + np.cross(w, points)
    there = points + time_s[:, None] * u + 0.5 * time_s[:, None] ** 2 * np.cross(w, u)
    rows[:] = (there @ turn.T + t).T


NUMPY: dict[str, Callable[..., object]] = {
    "codec.ballot._placed": _points_out,
    "codec.planes._ascending": _words_out,
    "core.columns._enter_cells": _flat_cells,
    "core.columns._mark_obstacles": _obstacles,
    "core.geometry._transform": _transformed,
    "core.geometry._rows_from": lambda points, origin, rows: np.copyto(rows, (points - origin).T, casting="same_kind"),
    "core.voting.cast": _cast,
    "core.voting._decide_cells": _decided,
    "core.voting.count_states": _counted,
    "core.voxels._group": lambda keys, *_: np.unique(keys, return_index=True, return_inverse=True),
    "core.voxels._add": _summed,
    "core.voxels._enter_keys": _keys,
    "core.voxels._thin_keys": lambda flat, every, size, keys: _keys(flat.reshape(-1, 3)[::every], 0.0, 0.0, size, keys),
    "codec.planes.mark": _marked,
    "codec.planes.mark_spoken": _marked_spoken,
    "codec.planes.mark_among": _marked_among,
    "codec.planes.agreeing": _agreeing,
    "matching.prepare._deskew": _deskewed,
}


def works(folder: Path, laboratory: bool) -> list[Callable[[], object]]:
    """Calls of every kernel; of the ``laboratory`` too, which takes a minute more."""
    from mapvote import warmup
    from mapvote.__main__ import main
    from mapvote.config import Settings
    from mapvote.core.rule import SURFACES
    from mapvote.fusion.change_time import lately_changed
    from mapvote.fusion.fuse import count
    from mapvote.fusion.tile_vote import Vote
    from mapvote.matching.global_search import GlobalSearch
    from mapvote.shapes.packed_cloud import make_levels

    point_map, drive = (
        warmup.map_from_points(warmup._street(demolished=False)),
        warmup._drive(warmup._street(True), True),
    )
    tile = next(iter(point_map.tiles.values()))

    def turns() -> None:
        """Five say that a wall stands, three who come later that it is gone."""
        says = [np.full((256, 256), 0 if i < 5 else 3, np.uint8) for i in range(8)]
        drives = [Vote(f"v{i}", i, f"{i}", states=states) for i, states in enumerate(says)]
        lately_changed(says[0], drives, count(drives, SURFACES, 2)[1], 2)

    def evaluate() -> None:
        words = ["evaluate", "corner", "--seed", "2", "--case", "1,2,3,4,5,surfaces,evidence", "--readings"]
        sys.argv = ["mapvote", *words, "--cache", str(folder)]
        with contextlib.suppress(SystemExit):
            main()

    return [
        lambda: list(warmup.warm_up()),
        lambda: make_levels(tile.points, tile.ground_z),
        turns,
        lambda: GlobalSearch(point_map, Settings().ndt, 0.02).find(drive.read_scan(0)),
        *([evaluate] if laboratory else []),
    ]


def main() -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    asked = sys.argv[1:]
    every = {m: mine for m, mine in kernels().items() if not asked or any(part in m for part in asked)}
    for module in every:
        importlib.import_module(module)
    print("| File | Kernels | numpy, compiled, times | loop, compiled, times |\n|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as name:
        jobs = works(Path(name), any(m.startswith("mapvote_lab") for m in every))
        for do in jobs:  # all is compiled before it is replaced
            do()
        found = recorded(jobs)
        for module, mine in every.items():
            spent: dict[str, list[float]] = {"numpy": [0.0, 0.0], "loop": [0.0, 0.0]}
            for kernel in mine:
                recorder = found.get(f"{module}.{kernel}")
                if recorder is None:
                    continue
                vectors = NUMPY.get(f"{module.removeprefix('mapvote.')}.{kernel}")
                kind = spent["numpy" if vectors else "loop"]
                kind[1] += least_ms(recorder.kernel, recorder.given)
                if vectors:
                    kind[0] += least_ms(vectors, recorder.given)
                else:
                    kind[0] += interpreted_ms(f"{module}.{kernel}", recorder.given, Path(name))
            told = [_short(other, own) if own else "" for other, own in spent.values()]
            file = "/".join(module.split(".")[1:]) + ".py"
            print("|", " | ".join([file, " ".join(f"`{name}`" for name in mine), *told]), "|", flush=True)


def _short(other: float, own: float) -> str:
    said = "more" if np.isinf(other) else f"{other:.3g}"
    return f"{said}, {own:.2g}, {min(other, 1e3 * MOST_S) / own:.2g}" + " or more" * bool(np.isinf(other))


if __name__ == "__main__":
    main()
