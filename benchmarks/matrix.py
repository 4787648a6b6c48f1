"""The experiment matrix: every case, every condition, over seeds; tables in Markdown and all numbers in JSON.

    python benchmarks/matrix.py --seeds 3,5,6,7,8 --out out/matrix  # everything
    python benchmarks/matrix.py --scenario corner --seeds 1 --experiments main # minutes

A run that was cut short goes on where it stopped; what is done is written after every experiment. Seed 1 of
`street570` is for development: report on others.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from pathlib import Path

from rich.console import Console

from mapvote.config import cache_folder, load_settings
from mapvote.formats.atomic import whole_file
from mapvote_lab.evaluation.experiments.matrix import EXPERIMENTS, Matrix
from mapvote_lab.evaluation.reporting import matrix_tables
from mapvote_lab.evaluation.results import MatrixResult, to_json


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="street570", help="a scenario's name or file (default street570)")
    parser.add_argument("--seeds", default="3,5,6,7,8", help="comma-separated (default 3,5,6,7,8)")
    parser.add_argument("--experiments", help=f"comma-separated, of: {', '.join(EXPERIMENTS)} (default all)")
    parser.add_argument("--cases", help='instead of all, in main and liars: "1,1 column,surfaces" is half of it')
    parser.add_argument("--parked", type=int, help="cars parked during each pass in parked (default 12; corner: 2)")
    parser.add_argument("--out", type=Path, default=Path("out/matrix"))
    parser.add_argument("--cache", type=Path, default=cache_folder(), help="where drives, maps and ballots are kept")
    parser.add_argument("--config", type=Path, help="settings (TOML)")
    parser.add_argument("--workers", type=int, default=2, help="experiments at a time, each on one core")
    parser.add_argument("--drop-drives", action="store_true", help="delete scans (3 GB a seed) once they are done with")
    parser.add_argument("--tables-only", action="store_true", help="only write what earlier runs measured")
    arguments = parser.parse_args()
    seeds = tuple(int(seed) for seed in arguments.seeds.split(","))
    names = list(EXPERIMENTS) if arguments.experiments is None else arguments.experiments.split(",")
    unknown = [name for name in names if name not in EXPERIMENTS]
    if unknown:
        parser.error(f"no experiment {unknown[0]!r}; choose from {', '.join(EXPERIMENTS)}")
    console = Console(width=220)
    matrix = Matrix(
        arguments.scenario,
        seeds,
        arguments.cache,
        load_settings(arguments.config),
        workers=arguments.workers,
        cases=arguments.cases,
        parked=arguments.parked,
    )
    results: dict[str, dict[int, MatrixResult]] = {}
    started = time.monotonic()
    if arguments.tables_only:
        done = [(name, seed) for name in names for seed in seeds if matrix.result_file(name, seed).is_file()]
        ended: Iterable[tuple[str, int, MatrixResult]] = ((n, seed, matrix.run(n, seed)) for n, seed in done)
    else:
        ended = matrix.run_all(names)
    for name, seed, result in ended:
        results.setdefault(name, {})[seed] = result
        console.print(f"{(time.monotonic() - started) / 60:6.1f} min  {name}, {arguments.scenario} {seed}")
        if arguments.drop_drives:
            matrix.drop_drives(names, seed)
        write({name: dict(sorted(results[name].items())) for name in names if name in results}, arguments.out)
    print(f"{arguments.out / 'matrix.md'}: every table; matrix.json beside it: all numbers")


def write(results: dict[str, dict[int, MatrixResult]], out: Path) -> None:
    """matrix.json and matrix.md into ``out``."""
    sheets = [matrix_tables.table(results, name) for name in results]
    if "main" in results:
        sheets += [matrix_tables.class_table(results, "main"), matrix_tables.ceiling_table(results, "main")]
    with whole_file(out / "matrix.md") as partial:
        partial.write_text("\n".join(sheet.to_markdown() for sheet in sheets))
    with whole_file(out / "matrix.json") as partial:
        partial.write_text(to_json({name: {str(k): r for k, r in found.items()} for name, found in results.items()}))


if __name__ == "__main__":
    main()
