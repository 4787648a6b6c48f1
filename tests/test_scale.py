"""What docs/scale.md reckons follows from what was measured."""

from __future__ import annotations

import runpy
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_tables_of_a_city_follow_from_the_curves_that_were_measured() -> None:
    scale = runpy.run_path(str(ROOT / "benchmarks" / "scale.py"))
    rows, page = scale["read"](ROOT / "results" / "scale.csv"), (ROOT / "docs" / "scale.md").read_text()
    for table in (scale["curves"](rows), scale["city"](rows)):
        assert "\n".join(table) in page, "python benchmarks/scale.py prints the tables of docs/scale.md"
