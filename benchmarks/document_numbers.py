"""Write the tables of numbers in the documents anew, from the records of the program.

    python benchmarks/document_numbers.py

A table stands below a line ``<!-- numbers: Movers, Sky -->``, which names its records (mapvote/core/record.py). A test
fails while a table is not what this writes.
"""

from __future__ import annotations

import re
from pathlib import Path

from mapvote.core.record import numbers_table

ROOT = Path(__file__).parents[1]
_TABLE = re.compile(r"^(<!-- numbers: ([\w, ]+) -->\n)(?:\|.*\n)*", re.MULTILINE)


def with_tables(text: str) -> str:
    """A page with every table of numbers as the program has them."""
    return _TABLE.sub(lambda found: f"{found[1]}{numbers_table(found[2].split(', '))}\n", text)


def main() -> None:
    for page in sorted((ROOT / "docs").rglob("*.md")):
        text = page.read_text()
        if with_tables(text) != text:
            page.write_text(with_tables(text))
            print(f"{page.relative_to(ROOT)}: written")


if __name__ == "__main__":
    main()
