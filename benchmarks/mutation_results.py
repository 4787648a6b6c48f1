"""What a run of mutants found: rows of results/mutation.csv, and the page made of them, docs/mutation.md."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
EQUAL = ROOT / "benchmarks/equal_mutants.csv"
"""module, change, reason: mutants that no test can tell from the original."""


@dataclass(frozen=True)
class Result:
    """What became of one mutant."""

    seed: int
    module: str
    place: int
    line: int
    change: str
    outcome: str
    """killed, crashed, hangs (all three noticed) or survived."""
    seconds: float
    source: str
    """Digest of the module."""
    tests: str
    """Digest of its tests."""


COLUMNS = tuple(Result.__dataclass_fields__)


def read_results(path: Path) -> list[Result]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [
            Result(int(r["seed"]), r["module"], int(r["place"]), int(r["line"]), r["change"], r["outcome"],
                   float(r["seconds"]), r["source"], r["tests"])
            for r in csv.DictReader(file)
        ]  # fmt: skip


def write_results(path: Path, results: Sequence[Result]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix(".tmp")
    with fresh.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for r in sorted(results, key=lambda r: (r.seed, r.module, r.place)):
            writer.writerow([f"{v:.1f}" if isinstance(v, float) else v for v in (getattr(r, c) for c in COLUMNS)])
    fresh.replace(path)


def report(results: Sequence[Result]) -> None:
    """Write docs/mutation.md."""
    seeds = sorted({r.seed for r in results})
    lines = [
        "# Do the tests notice a changed operator?",
        "",
        "Random one-operator mutants of the modules that decide, each held against the tests that name its module.",
        "Written by `python benchmarks/mutation.py` from `results/mutation.csv`; do not edit.",
        "",
        "| module | " + " | ".join(f"seed {seed}: killed of" for seed in seeds) + " |",
        "|---|" + "---|" * len(seeds),
    ]
    for module in [*sorted({r.module for r in results}), ""]:
        counts = []
        for seed in seeds:
            mine = [r for r in results if r.seed == seed and module in (r.module, "")]
            dead = sum(r.outcome != "survived" for r in mine)
            counts.append(f"{dead} of {len(mine)} ({dead / len(mine):.0%})" if mine else "")
        lines.append(f"| {f'`{module}`' if module else 'all'} | " + " | ".join(counts) + " |")
    lines += ["", "## Survivors", "", "| seed | module, line | change | equal, because |", "|---|---|---|---|"]
    why = equal_mutants()
    for r in results:
        if r.outcome == "survived":
            change = f"`{r.change}`".replace("|", "\\|")
            lines.append(f"| {r.seed} | `{r.module}` {r.line} | {change} | {why.get((r.module, r.change), '')} |")
    (ROOT / "docs/mutation.md").write_text("\n".join(lines) + "\n")


def equal_mutants() -> dict[tuple[str, str], str]:
    if not EQUAL.exists():
        return {}
    with EQUAL.open(newline="") as file:
        return {(r["module"], r["change"]): r["reason"] for r in csv.DictReader(file)}
