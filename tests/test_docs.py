"""Facts that a reader of the documents relies on: links lead somewhere, lines fit a window, names are those of the
house."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mapvote.core.types import MapvoteError
from mapvote.formats import export_map, read_map, registry

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
SOURCES = sorted([*(ROOT / "src").rglob("*.py"), *(ROOT / "src").rglob("*.js")])
_spec = importlib.util.spec_from_file_location("document_numbers", ROOT / "benchmarks/document_numbers.py")
assert _spec is not None
assert _spec.loader is not None
document_numbers = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(document_numbers)
names = [str(page.relative_to(ROOT)) for page in PAGES]


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_links_and_files_that_a_page_names_are_there_and_its_prose_wraps_at_120(page: Path) -> None:
    text = page.read_text()
    links = [
        link for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text) if not link.startswith(("http", "mailto:"))
    ]
    assert [link for link in links if not (page.parent / link).exists()] == []
    files = set(re.findall(r"`((?:[a-z_]+/)+[a-z_0-9]+\.(?:py|toml|js))`", text))
    rooms = (ROOT, *(ROOT / "src" / room for room in ("", "mapvote", "mapvote_server", "mapvote_lab")), ROOT / "docs")
    assert sorted(name for name in files if not any((room / name).exists() for room in rooms)) == []
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL).splitlines()
    assert [line for line in prose if len(line) > 120 and not line.startswith(("|", "!["))] == []


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_a_cell_of_a_table_holds_at_most_three_sentences(page: Path) -> None:
    cells = [cell for line in page.read_text().splitlines() if line.startswith("|") for cell in line.split("|")]
    assert [cell for cell in cells if len(re.findall(r"[a-z0-9)%`*][.?!](?= [A-Z`*])", cell)) > 2] == []


def test_every_page_is_reached_from_the_index_by_links() -> None:
    reached, to_read = set(), [ROOT / "docs/index.md"]
    while to_read:
        page = to_read.pop()
        if page in reached:
            continue
        reached.add(page)
        links = re.findall(r"\]\(([^)#:]+\.md)(?:#[^)]*)?\)", page.read_text())
        to_read += [(page.parent / link).resolve() for link in links]
    assert sorted(set((ROOT / "docs").rglob("*.md")) - reached) == []


def test_every_benchmark_is_named_by_a_page_or_used_by_another() -> None:
    """A benchmark that no page cites measures for nobody."""
    scripts = sorted((ROOT / "benchmarks").glob("*.py"))
    texts = [page.read_text() for page in [*PAGES, *scripts]]
    assert [
        script.name
        for script in scripts
        if not any(re.search(rf"benchmarks/{script.name}|^(import|from) {script.stem} ?", text, re.M) for text in texts)
    ] == []


@pytest.mark.parametrize("door", ["vehicles", "operators", "compare"])
def test_a_door_has_commands_output_a_picture_and_at_most_four_links(door: str) -> None:
    text = (ROOT / f"docs/{door}.md").read_text()
    links = set(re.findall(r"\]\(([^)#:]+\.md)", text))
    assert "```\nmapvote " in text
    assert "```text\n" in text
    assert "](pictures/" in text
    assert len(links) <= 4, links


def test_the_site_lists_every_page() -> None:
    """A page outside the navigation is a warning of mkdocs, and warnings are errors."""
    listed = set(re.findall(r"(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    pages = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    assert pages == listed - {"pictures/*.md"}


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="the extra docs is not installed")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    api = (tmp_path / "site" / "api" / "index.html").read_text()
    assert all(f".{name}" in api for name in ("build_map", "vote_drive", "update_map", "MapClient"))


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_tables_of_numbers_are_those_of_the_program(page: Path) -> None:
    """``<!-- numbers: Movers -->`` stands above a table that benchmarks/document_numbers.py writes."""
    assert document_numbers.with_tables(page.read_text()) == page.read_text(), "python benchmarks/document_numbers.py"


def test_no_source_refers_to_a_document_that_is_not_here() -> None:
    for file in SOURCES:
        for link in re.findall(r"docs/[\w/]+\.md", file.read_text()):
            assert (ROOT / link).exists(), f"{file.relative_to(ROOT)} points at {link}"


def test_the_map_format_of_the_documents_is_read_and_written(tmp_path: Path) -> None:
    """The example is run as it stands."""
    (example,) = re.findall(r"^```python\n(.*?MAPS\[.*?)^```", (ROOT / "docs/extending.md").read_text(), re.M | re.S)
    exec(example, {})
    try:
        source, again = tmp_path / "a.xyz", tmp_path / "b.xyz"
        source.write_text("".join(f"{x} {y} 0.0\n" for x in range(20) for y in range(20)))
        export_map(read_map(source), again)
        assert read_map(again).n_points == 400
        source.write_text("one two three\n")
        with pytest.raises(MapvoteError, match="no lines of three numbers"):
            read_map(source)
    finally:
        del registry.WRITERS[".xyz"], registry.MAPS["XYZ file"]
