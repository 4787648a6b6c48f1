"""The figures of docs/results.md, drawn from the tables that benchmarks/matrix.py wrote into docs/matrix.md.

    python benchmarks/result_figures.py

Nothing is typed in here: a table that is written anew gives another figure.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

ROOT = Path(__file__).parent.parent
MATRIX = ROOT / "docs/matrix.md"
CASES = "1", "2", "3", "4", "5", "1 column", "5 column", "columns_v1 one-stage", "columns_v1"
TRUTHS = ("macro strict", "#24476b"), ("macro prov.", "#8fb3d9")
WORTH = ("F1 ch.-occ. strict", "#c0392b"), ("F1 ch.-empty strict", "#2471a3"), ("macro strict", "#444444")


def table(text: str, experiment: str) -> dict[str, dict[str, str]]:
    """The first table under the heading that begins with ``experiment``: row name -> column name -> cell."""
    section = text.split(f"\n### {experiment} ", 1)[1].split("\n#", 1)[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    return {row[0]: dict(zip(rows[0], row, strict=False)) for row in rows[2:]}


def mean_and_worst(cell: str) -> tuple[float, float]:
    """Of "0.929 ± 0.036 (0.867)": .929 and .867."""
    found = re.fullmatch(r"(\S+) ± \S+ \((\S+)\)", cell)
    if found is None:
        raise ValueError(f"no mean and worst seed in {cell!r}")
    return float(found[1]), float(found[2])


def bars(axes: Axes, rows: dict[str, dict[str, str]], names: Sequence[str], columns: Sequence[tuple[str, str]]) -> None:
    """A bar for every row and column, a line down to the worst seed."""
    width = 0.8 / len(columns)
    for k, (column, colour) in enumerate(columns):
        measured = [mean_and_worst(rows[name][column]) for name in names]
        at = [i + (k - 0.5 * (len(columns) - 1)) * width for i in range(len(names))]
        axes.bar(at, [mean for mean, _ in measured], 0.9 * width, color=colour, label=column)
        axes.vlines(at, [worst for _, worst in measured], [mean for mean, _ in measured], color="black", linewidth=1)
        axes.plot(at, [worst for _, worst in measured], "_", color="black", markersize=5)
    axes.set_ylim(0, 1)
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(columns), frameon=False, fontsize=9)


def draw(names: Sequence[str], labels: Sequence[str], columns: Sequence[tuple[str, str]], out: Path) -> None:
    rows = table(MATRIX.read_text(), "main")
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axes = figure.add_subplot()
    bars(axes, rows, names, columns)
    axes.set_xticks(range(len(names)), labels, fontsize=9)
    figure.savefig(out, dpi=110, metadata={"Software": None})
    print(out)


def main() -> None:
    pictures = ROOT / "docs/pictures"
    draw(CASES, [name.replace(" ", "\n") for name in CASES], TRUTHS, pictures / "cases.png")
    rows = table(MATRIX.read_text(), "main")
    grown = [*sorted((name for name in rows if re.fullmatch(r"columns_v1 [A-H]+", name)), key=len), "columns_v1"]
    labels = [f"+ {name[-1]}" if name != "columns_v1" else "+ I\n(all)" for name in grown]
    draw(grown, labels, WORTH, pictures / "rules.png")


if __name__ == "__main__":
    main()
