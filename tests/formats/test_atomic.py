"""Outputs appear whole or not at all, whatever happens while they are written."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file, whole_folder


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_a_file_appears_when_it_is_finished_and_not_before(tmp_path: Path) -> None:
    with whole_file(tmp_path / "deep" / "map.pcd") as partial:
        partial.write_text("whole")
        assert not (tmp_path / "deep" / "map.pcd").exists()
        assert partial.name.startswith("."), "hidden meanwhile"
    assert (tmp_path / "deep" / "map.pcd").read_text() == "whole"
    assert names(tmp_path / "deep") == ["map.pcd"]


@pytest.mark.parametrize("error", [ValueError("mine"), KeyboardInterrupt()])
def test_an_error_or_ctrl_c_leaves_the_old_file_and_no_litter(tmp_path: Path, error: BaseException) -> None:
    file = tmp_path / "map.pcd"
    file.write_text("old")

    def write() -> None:
        with whole_file(file) as partial:
            partial.write_text("half")
            raise error

    with pytest.raises(type(error)):
        write()
    assert file.read_text() == "old"
    assert names(tmp_path) == ["map.pcd"]


def test_what_the_disk_refuses_is_one_clear_error_and_the_old_file_stays(tmp_path: Path) -> None:
    file = tmp_path / "map.pcd"
    file.write_text("old")
    told = r"map\.pcd: cannot be written \(No space left.*nothing was changed"
    with pytest.raises(MapvoteError, match=told), whole_file(file):
        raise OSError(28, "No space left on device")
    assert file.read_text() == "old"
    with pytest.raises(MapvoteError, match="cannot be written"), whole_file(file / "below" / "a.txt"):
        pass


def test_a_private_file_is_its_owners_from_the_first_byte(tmp_path: Path) -> None:
    with whole_file(tmp_path / "key", private=True) as partial:
        assert partial.stat().st_mode & 0o777 == 0o600
        partial.write_text("secret")
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "key").read_text() == "secret"


def fill(folder: Path, sign: str = "manifest.json") -> None:
    (folder / "tiles").mkdir()
    (folder / "tiles" / "a.bin").write_bytes(b"1")
    (folder / sign).write_text("{}")


def test_a_folder_appears_when_it_is_finished(tmp_path: Path) -> None:
    with whole_folder(tmp_path / "my_map", sign="manifest.json") as partial:
        fill(partial)
        assert names(tmp_path) == [partial.name]
    assert names(tmp_path) == ["my_map"]
    assert names(tmp_path / "my_map") == ["manifest.json", "tiles"]


def test_a_folder_of_the_same_kind_is_replaced_whole_and_an_empty_one_too(tmp_path: Path) -> None:
    mine = tmp_path / "my_map"
    mine.mkdir()
    for text in ("{}", "second"):
        with whole_folder(mine, sign="manifest.json") as partial:
            fill(partial)
            (partial / "manifest.json").write_text(text)
            (partial / text.strip("{}") if text != "{}" else partial / "left_over").touch()
        assert (mine / "manifest.json").read_text() == text
    assert names(mine) == ["manifest.json", "second", "tiles"], "nothing of the first is left"
    assert names(tmp_path) == ["my_map"]


def test_a_mistyped_path_destroys_nothing(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years")
    (tmp_path / "file").write_text("text")
    for name in ("home", "file"):
        told = rf"{name}: exists and has no manifest\.json, so it is not replaced"
        with pytest.raises(MapvoteError, match=told), whole_folder(tmp_path / name, sign="manifest.json"):
            raise AssertionError("nothing is begun")
    assert (tmp_path / "home" / "thesis.tex").read_text() == "years"


@pytest.mark.parametrize("error", [ValueError("mine"), KeyboardInterrupt(), OSError(5, "Input/output error")])
def test_an_error_leaves_the_old_folder_and_no_litter(tmp_path: Path, error: BaseException) -> None:
    mine = tmp_path / "my_map"
    mine.mkdir()
    fill(mine)
    (mine / "old").touch()

    def write() -> None:
        with whole_folder(mine, sign="manifest.json") as partial:
            fill(partial)
            raise error

    with pytest.raises(MapvoteError if isinstance(error, OSError) else type(error)):
        write()
    assert names(tmp_path) == ["my_map"]
    assert "old" in names(mine)


def test_an_error_between_the_two_renames_brings_the_old_folder_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = tmp_path / "my_map"
    mine.mkdir()
    fill(mine)
    (mine / "old").touch()
    real, turns = os.replace, []

    def replace(a: Path, b: Path) -> None:
        turns.append(b)
        if len(turns) == 2:
            raise OSError(5, "Input/output error")
        real(a, b)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(MapvoteError, match="nothing was changed"), whole_folder(mine, sign="manifest.json") as partial:
        fill(partial)
    assert names(tmp_path) == ["my_map"]
    assert "old" in names(mine)
