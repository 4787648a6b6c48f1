"""What holds cases 1 to 5 on `as_published` below the paper's Table IV: one thing at a time made perfect, on one seed.

    python benchmarks/published_causes.py --seed 1 --folder out/causes --csv results/published_causes.csv

Of the development seeds 1, 11 and 12, not of those that are reported, and on a third of the street with a third of its
changes and cars, so that all variants take minutes; ``--whole`` is the whole street. A variant whose JSON lies in the
folder already is not driven again; ``--variants`` chooses some. Truth: provenance.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mapvote.config import Settings, cache_folder
from mapvote.evaluation.evaluate import evaluate
from mapvote.evaluation.experiments.cases import choose_cases
from mapvote.evaluation.experiments.conditions import Conditions
from mapvote.evaluation.experiments.scene import Scene
from mapvote.evaluation.experiments.study import as_paper
from mapvote.evaluation.reporting.tables import as_json, write_text

CASES = "1,2,3,4,5"
TRUTH = "provenance"


@dataclass(frozen=True)
class Variant:
    """What is different from `as_published` as it is evaluated."""

    true_poses: bool = False
    overrides: Mapping[str, Any] = field(default_factory=dict)
    """Of the scenario."""
    drop_strays: bool = False


THIRD: Mapping[str, Any] = {
    "length_m": 189.9,
    "temporary_cars": 3,
    "changes": [
        {"kind": "built", "side": "north", "from_m": 30.0, "to_m": 52.0},
        {"kind": "demolished", "side": "south", "from_m": 56.0, "to_m": 92.0, "count": 2},
        {"kind": "demolished", "side": "north", "from_m": 128.0, "to_m": 156.0, "count": 2},
    ],
}
EXACT = {"flaws": {"range_sigma_m": 0.0}}
VARIANTS = {
    "as it is": Variant(),
    "map without strays": Variant(drop_strays=True),
    "map without strays, true poses": Variant(True, drop_strays=True),
    "map without strays, no range noise": Variant(overrides=EXACT, drop_strays=True),
    "map without strays, both": Variant(True, EXACT, True),
    "true poses": Variant(True),
    "no range noise": Variant(overrides=EXACT),
    "both": Variant(True, EXACT),
}


def measured(variant: Variant, street: Mapping[str, Any], seed: int, cache: Path, file: Path) -> dict[str, Any]:
    """The numbers of one variant, as ``mapvote evaluate --json`` writes them; ``street``: overrides for all alike."""
    if not file.exists():
        settings = as_paper(Settings(), "as_published")
        mapping = settings.mapping.model_copy(update={"drop_strays": variant.drop_strays})
        settings = settings.model_copy(update={"mapping": mapping})
        conditions = Conditions(true_poses=variant.true_poses)
        scene = Scene("as_published", seed, settings, cache, {**street, **variant.overrides}, conditions)
        cases, _ = choose_cases(settings, CASES)
        write_text(as_json(evaluate(scene, cases).result), file)
    return dict(json.loads(file.read_text()))


def row(name: str, run: Mapping[str, Any]) -> list[str]:
    """Macro-F1 of the cases; precision and recall of changed-occupied and of changed-empty, in case 1 and 2."""
    scores = [run["cases"][case][TRUTH] for case in CASES.split(",")]
    out = [name, *(f"{score['macro_f1']:.3f}" for score in scores)]
    for kind in ("changed_occupied", "changed_empty"):
        out += [f"{score['precision'][kind]:.2f} / {score['recall'][kind]:.2f}" for score in scores[:2]]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--whole", action="store_true", help="the whole street instead of a third")
    parser.add_argument("--variants", default=";".join(VARIANTS), help="names, by semicolons")
    parser.add_argument("--folder", type=Path, default=Path("out/causes"), help="JSON of each variant")
    parser.add_argument("--cache", type=Path, default=cache_folder())
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    head = ["", *(f"case {case}" for case in CASES.split(","))]
    head += [f"{kind} P / R, case {case}" for kind in ("occupied", "empty") for case in ("1", "2")]
    rows = []
    for name in options.variants.split(";"):
        words = name.replace(",", "").split()
        file = options.folder / f"{'_'.join([str(options.seed), *(['whole'] if options.whole else []), *words])}.json"
        street = {} if options.whole else THIRD
        rows.append(row(name, measured(VARIANTS[name], street, options.seed, options.cache, file)))
    for line in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(line)} |")
    if options.csv is not None:
        with options.csv.open("w", newline="") as out:
            csv.writer(out, lineterminator="\n").writerows([["variant", *head[1:]], *rows])


if __name__ == "__main__":
    main()
