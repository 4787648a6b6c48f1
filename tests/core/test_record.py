"""Records of numbers: listed with their sentences, hashed into the digest of settings, varied by tests as arguments."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import pytest

from mapvote.core import record

SRC = Path(__file__).parents[2] / "src"
PACKAGES = ("mapvote", "mapvote_server", "mapvote_lab")


@pytest.mark.parametrize("package", ["mapvote", "mapvote_lab"])
def test_every_field_of_every_record_has_a_default_and_a_sentence(package: str) -> None:
    listed = record.numbers(packages=(package,))
    assert len(listed) > 10
    assert [number.name for number in listed if not number.meaning.endswith((".", ")"))] == []


def test_another_number_of_a_vote_is_another_version_of_the_method() -> None:
    listed = record.numbers(votes=True)
    assert record.digest_of_numbers(listed) == record.method_version()
    (k,) = [k for k, number in enumerate(listed) if number.name == "Movers.past_s"]
    other = [*listed[:k], replace(listed[k], value=2.5), *listed[k + 1 :]]
    assert record.digest_of_numbers(other) != record.method_version()


def test_a_digest_reads_no_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are parsed out of the source, which takes longer than everything else of a digest."""
    monkeypatch.delattr(record, "_sentences")
    assert record.digest_of_numbers(record.numbers(votes=True)) == record.method_version()


def test_records_are_found_in_the_sources_without_importing_other_modules() -> None:
    """A class decorated with @record in any file is found, and no file without one."""
    marked = set()
    for package in PACKAGES:
        for source in (SRC / package).rglob("*.py"):
            classes = [node for node in ast.walk(ast.parse(source.read_text())) if isinstance(node, ast.ClassDef)]
            if any("record(" in ast.unparse(word) for node in classes for word in node.decorator_list):
                marked.add(".".join(source.relative_to(SRC).with_suffix("").parts))
    assert set(record.modules_with_records(PACKAGES)) == marked
