"""A desk with a tiny street on it: the folders and files that the documents name, made once by the program itself."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from command_line import type_in
from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.core.geometry import from_xyz_rpy, transform
from mapvote.core.point_map import all_points
from mapvote.core.types import F64, CellState
from mapvote.formats import read_map, write_pcd
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import write_las
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import send

TINY = """
name = "tiny"
length_m = 30.0
width_m = 60.0
rate_hz = 2.5
sensor = "vlp16"
vehicles = 3
surveys = ["east inner"]

[[changes]]
kind = "demolished"
side = "south"
from_m = 8.0
to_m = 22.0
"""

LANELETS = "".join(
    [
        "<osm>",
        *(
            f"<node id='{k}'><tag k='local_x' v='{x}'/><tag k='local_y' v='{y}'/></node>"
            for k, (x, y) in enumerate([(0, 5), (9, 5), (0, 1), (9, 1)])
        ),
        *(f"<way id='{k}'><nd ref='{2 * k}'/><nd ref='{2 * k + 1}'/></way>" for k in (0, 1)),
        "<relation id='7'><member type='way' role='left' ref='0'/><member type='way' role='right' ref='1'/>",
        "<tag k='type' v='lanelet'/></relation></osm>",
    ]
)
"""One lanelet over the wall that the store's second version lacks."""


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything that the documents name. Tests link what they need from here and change nothing.

    The first process of the tests that asks makes it, and all others take it from there."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "made"
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            partial = tmp_path_factory.mktemp("partial")
            make_all(partial)
            partial.rename(folder)
    return folder


def make_all(folder: Path) -> None:
    """What the documents name, into an empty folder."""
    home = Path.cwd()
    os.chdir(folder)
    try:
        Path("tiny.toml").write_text(TINY)
        type_in("mapvote simulate tiny.toml street --seed 2")
        for name, drive in {
            "MY_DRIVE": "survey_1", "survey": "survey_1", "drive": "v1", "ANOTHER_DRIVE": "v1",
            "monday": "v1", "tuesday": "v2", "friday": "v3",
        }.items():  # fmt: skip
            os.symlink(f"street/{drive}", name)
        type_in("mapvote build MY_DRIVE --out my_map")
        type_in("mapvote vote monday --map my_map --vehicle car_1 --out car_1.ballot")
        type_in("mapvote vote tuesday --map my_map --vehicle car_2 --out car_2.ballot")
        type_in("mapvote export my_map tiles")
        type_in("mapvote export my_map city.pcd")
        type_in("mapvote export my_map old_map.las")
        os.symlink("tiles", "my_autoware_map")
        make_clouds(all_points(read_map("my_map")))
        make_store(Path("STORE"))
        for copy in ("fleet.db", "BACKUP", "backup.db"):
            shutil.copy("STORE", copy)
        type_in("mapvote log STORE --from 1 --out changes.geojson")
        Path("lanelet2_map.osm").write_text(LANELETS)
        Path("key").write_text("mv_" + "0" * 40)
    finally:
        os.chdir(home)


@pytest.fixture
def desk(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Lay these names of ``made`` into a new folder of one's own and go there."""

    def lay(*names: str) -> Path:
        for name in names:
            if (made / name).is_file():
                shutil.copy(made / name, tmp_path / name)
            else:
                os.symlink(made / name, tmp_path / name)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        return tmp_path

    return lay


def make_clouds(street: F64) -> None:
    """Points of the street (n, 3): a session's cloud in a frame of its own, and two parts that overlap by 40 m, with
    noise."""
    rng = np.random.default_rng(5)
    noisy = street + rng.normal(0.0, 0.01, street.shape)
    write_pcd(Path("session.pcd"), Cloud(transform(from_xyz_rpy(40.0, -15.0, 2.0, yaw=0.7), noisy)))
    write_las(Path("north.laz"), Cloud(street[street[:, 1] > 10.0]))
    write_las(Path("south.laz"), Cloud(noisy[street[:, 1] < 50.0]))


def make_store(path: Path) -> None:
    """A store of two versions: VEHICLE and car_1 voted a wall away, and car_1 has voted again since."""
    before = two_walls()
    gone = {(0, 0): Say(states_plane({(10, c): CellState.CHANGED_EMPTY for c in (10, 11, 12)}))}
    stays = {(0, 1): Say(states_plane({(10, c): CellState.UNCHANGED_OCCUPIED for c in (10, 11, 12)}))}
    store = Store.create(f"sqlite:///{path}", before)
    send(store, *[make_ballot(before, gone, name) for name in ("VEHICLE", "car_1")])
    publish(store, override=True)
    send(store, *[make_ballot(before, stays, name, "d2") for name in ("VEHICLE", "car_1")])
    store.close()
