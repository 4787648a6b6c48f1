"""Outputs appear whole or not at all, whatever happens while they are written."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file, whole_folder


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def folder_of(path: Path) -> AbstractContextManager[Path]:
    return whole_folder(path, sign="manifest.json")


def fill(path: Path, text: str) -> None:
    """A file, or a folder that holds one below."""
    if path.is_dir():
        (path / "tiles").mkdir()
        (path / "tiles" / text).touch()
        path = path / "manifest.json"
    path.write_text(text)


def content(path: Path) -> str:
    return (path / "manifest.json" if path.is_dir() else path).read_text()


BOTH = pytest.mark.parametrize("whole", [whole_file, folder_of])


@BOTH
def test_it_appears_when_it_is_finished_and_not_before_and_replaces_what_was_there_whole(
    tmp_path: Path, whole: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    mine = tmp_path / "deep" / "mine"
    for text in ("first", "second"):
        with whole(mine) as partial:
            fill(partial, text)
            assert partial.name.startswith("."), "hidden meanwhile"
            assert mine.exists() == (text == "second")
        assert content(mine) == text
        assert names(mine.parent) == ["mine"]
    assert not mine.is_dir() or names(mine / "tiles") == ["second"], "nothing of the first is left"


@BOTH
@pytest.mark.parametrize("error", [ValueError("mine"), KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_an_error_or_ctrl_c_leaves_the_old_and_no_litter_and_the_disks_are_one_clear_error(
    tmp_path: Path, whole: Callable[[Path], AbstractContextManager[Path]], error: BaseException
) -> None:
    mine = tmp_path / "mine"
    with whole(mine) as partial:
        fill(partial, "old")

    def write() -> None:
        with whole(mine) as partial:
            fill(partial, "half")
            raise error

    told = r"mine: cannot be written \(No space left.*nothing was changed" if isinstance(error, OSError) else None
    with pytest.raises(MapvoteError if told else type(error), match=told):
        write()
    assert content(mine) == "old"
    assert names(tmp_path) == ["mine"]


def test_an_error_between_the_two_renames_brings_the_old_folder_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with folder_of(tmp_path / "mine") as partial:
        fill(partial, "old")
    real, turns = os.replace, []

    def replace(a: Path, b: Path) -> None:
        turns.append(b)
        if len(turns) == 2:
            raise OSError(5, "Input/output error")
        real(a, b)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(MapvoteError, match="nothing was changed"), folder_of(tmp_path / "mine") as partial:
        fill(partial, "new")
    assert content(tmp_path / "mine") == "old"
    assert names(tmp_path) == ["mine"]


def test_a_private_file_is_its_owners_from_the_first_byte(tmp_path: Path) -> None:
    with whole_file(tmp_path / "key", private=True) as partial:
        assert partial.stat().st_mode & 0o777 == 0o600
        partial.write_text("secret")
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "key").read_text() == "secret"


def test_a_mistyped_path_destroys_nothing_and_an_empty_folder_is_filled(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years")
    (tmp_path / "file").write_text("text")
    for name in ("home", "file"):
        told = rf"{name}: exists and has no manifest\.json, so it is not replaced"
        with pytest.raises(MapvoteError, match=told), folder_of(tmp_path / name):
            raise AssertionError("nothing is begun")
    with pytest.raises(MapvoteError, match="cannot be written"), whole_file(tmp_path / "file" / "below" / "a.txt"):
        pass
    assert (tmp_path / "home" / "thesis.tex").read_text() == "years"
    (tmp_path / "empty").mkdir()
    with folder_of(tmp_path / "empty") as partial:
        fill(partial, "first")
    assert content(tmp_path / "empty") == "first"
