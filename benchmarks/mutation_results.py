"""What a run of mutants found: rows of results/mutation.csv, and the page made of them, a table."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
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
    first: str
    """The same when it was first tried: before anybody had looked at the survivors, and written tests for them."""
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
            Result(int(r["seed"]), r["module"], int(r["place"]), int(r["line"]), r["change"], r["outcome"], r["first"],
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
    """Print the table and the survivors."""
    why = equal_mutants()
    survivors = [r for r in results if r.outcome == "survived"]
    rows = [
        _row(f"`{name}`", [r for r in results if r.module == name], why) for name in dict.fromkeys(_modules(results))
    ]
    least = min(Counter(r.module for r in results).values())
    lines = [
        "# Do the tests notice a changed operator?",
        "",
        "Random one-operator mutants of the modules that decide, each held against the tests that name its module (an",
        "operator, a small constant or a negation changed, `min` for `max`, `any` for `all`).",
        f"{least} of each were drawn; where more than two of those were equal, as many again",
        "(`--mutants 448 --only MODULE`).",
        "*At first* is before anybody had looked at the survivors; then tests were written that state what they break.",
        "*Equal* ones no test can tell from the original; they count as not killed. What is not in the",
        "table has not been run yet: the command goes on where it stopped.",
        "",
        f"From results/mutation.csv, `python benchmarks/mutation.py --seed {_seeds(results)}`.",
        "",
        "| module | mutants | killed at first | killed now | of the others: equal |",
        "|---|---|---|---|---|",
        *rows,
        _row("all", results, why),
        "",
        "## Survivors",
        "",
        "| module, line | change | equal, because |",
        "|---|---|---|",
    ]
    for r in survivors:
        change = f"`{r.change}`".replace("|", "\\|")
        lines.append(f"| `{r.module}` {r.line} | {change} | {why.get((r.module, r.change), '')} |")
    print("\n".join(lines))


def _modules(results: Sequence[Result]) -> list[str]:
    return sorted(r.module for r in results)


def _seeds(results: Sequence[Result]) -> str:
    return ", ".join(str(seed) for seed in sorted({r.seed for r in results}))


def _row(name: str, mine: Sequence[Result], why: Mapping[tuple[str, str], str]) -> str:
    first, now = (sum(outcome != "survived" for outcome in some) for some in ([r.first for r in mine], _now(mine)))
    equal = sum((r.module, r.change) in why for r in mine if r.outcome == "survived")
    n = max(len(mine), 1)
    return f"| {name} | {len(mine)} | {first} ({first / n:.0%}) | {now} ({now / n:.0%}) | {equal or ''} |"


def _now(mine: Sequence[Result]) -> list[str]:
    return [r.outcome for r in mine]


def equal_mutants() -> dict[tuple[str, str], str]:
    if not EQUAL.exists():
        return {}
    with EQUAL.open(newline="") as file:
        return {(r["module"], r["change"]): r["reason"] for r in csv.DictReader(file)}
