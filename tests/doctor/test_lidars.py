"""LiDARs of one vehicle whose frames are swapped, or which sit elsewhere than stated, are found by their points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from faults import Recording, serious, sound_street
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.types import F64
from mapvote.doctor.diagnosis import diagnose
from recorded_bags import write_bag

PLACES = {
    "front": from_xyz_rpy(1.5, 0.0, 0.2, 0.0, 0.1, 0.0),
    "left": from_xyz_rpy(0.2, 0.6, 0.4, 0.2, 0.0, 1.4),
    "rear": from_xyz_rpy(-1.5, 0.2, 0.3, 0.0, 0.0, 2.9),
}


@pytest.fixture(scope="module")
def sound() -> Recording:
    """A bend along a street, in the axes of the vehicle."""
    rng, street = np.random.default_rng(3), sound_street()
    T = [from_xyz_rpy(0, 0, 1.8)]
    for _ in range(7):
        T.append(T[-1] @ from_xyz_rpy(0.8, 0, 0, yaw=0.03))
    scans = []
    for one in T:
        seen = transform(inverse(one), street[rng.random(len(street)) < 0.6])
        away = np.linalg.norm(seen, axis=1)
        scans.append(np.column_stack([seen, away])[(away < 40) & (away > 4)])
    return Recording(scans, np.array(T), np.linspace(0.0, 0.7, len(T)), {})


def told(r: Recording, folder: Path, names: tuple[str, ...], stated: Mapping[str, F64]) -> list[str]:
    write_bag(r, folder, mounts={name: PLACES[name] for name in names}, stated=stated)
    return what_of(folder, names)


def what_of(folder: Path, names: tuple[str, ...]) -> list[str]:
    """Everything serious about the places of the LiDARs."""
    options = {"topic": ",".join(f"/{name}" for name in names), "prior": "/odom", "sensor": "hdl32e"}
    found = diagnose(folder, options).findings
    return [
        f"{f.what} -> {f.mend}"
        for f in found
        if f.what in serious([f]) and ("swapped" in f.what or "its stated place" in f.what)
    ]


@pytest.mark.parametrize("names", [("front", "left"), ("front", "left", "rear")])
def test_lidars_that_sit_as_stated_are_sound(tmp_path: Path, sound: Recording, names: tuple[str, ...]) -> None:
    assert told(sound, tmp_path / "b", names, PLACES) == []


@pytest.mark.slow
@pytest.mark.parametrize("pair", [("front", "left"), ("left", "rear")])
def test_swapped_frames_are_named_and_the_line_that_is_advised_mends_them(
    tmp_path: Path, sound: Recording, pair: tuple[str, str]
) -> None:
    a, b = pair
    names = ("front", "left", "rear")
    (error,) = told(sound, tmp_path / "b", names, {**PLACES, a: PLACES[b], b: PLACES[a]})
    assert f"the frames of /{a} and /{b} are swapped" in error
    (tmp_path / "b" / "drive.toml").write_text(error.split("write into drive.toml: ")[1])
    assert what_of(tmp_path / "b", names) == []


@pytest.mark.slow
def test_a_lidar_off_its_stated_place_is_measured_and_the_line_that_is_advised_mends_it(
    tmp_path: Path, sound: Recording
) -> None:
    names = ("front", "left")
    off = PLACES["left"] @ from_xyz_rpy(0.3, 0.1, 0.0, yaw=0.05)
    what = told(sound, tmp_path / "b", names, {**PLACES, "left": off})
    (warning,) = [one for one in what if "off its stated place" in one]
    assert "the points of /left show it 0.3" in warning
    line = warning.split("write into drive.toml: ")[1].split("; or leave")[0]
    (tmp_path / "b" / "drive.toml").write_text(line)
    assert what_of(tmp_path / "b", names) == []
