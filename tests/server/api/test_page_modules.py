"""The page's JavaScript without a browser, by Node.js: what it computes of the server's own bytes."""

from __future__ import annotations

import json
import shutil
import subprocess
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest

from hand_made import make_map, make_tile, wall
from mapvote.codec.manifest import TileHashes
from mapvote.shapes.packed_cloud import came_and_went
from mapvote_server.questions.clouds import Clouds
from mapvote_server.store.store import Store
from stores import WALL

TESTS = Path(__file__).parent / "page"


def test_the_modules_of_the_page_do_what_they_say(tmp_path: Path) -> None:
    """The facts are named in page/modules.test.js."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node.js is not installed: apt-get install nodejs")
    for folder in (files("mapvote_server") / "web", files("mapvote.shapes") / "viewer"):
        with as_file(folder) as modules:
            shutil.copytree(modules, tmp_path / "viewer", dirs_exist_ok=True)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    shutil.copytree(TESTS, tmp_path / "page")
    write_clouds(tmp_path / "page")
    command = [node, "--test", str(tmp_path / "page" / "modules.test.js")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]


def write_clouds(folder: Path) -> None:
    """Bytes as the server sends them: a level of detail, and what went when one cell of a wall was taken down."""
    ground = wall([(r, c) for r in range(0, 40, 4) for c in range(0, 40, 4)], [0.05])
    before = make_tile(np.concatenate([ground, wall(WALL, [0.45, 0.75, 1.05])]))
    after = make_tile(np.concatenate([ground, wall(WALL[1:], [0.45, 0.75, 1.05])]))
    store = Store.create(f"sqlite:///{folder / 'store.db'}", make_map({(0, 0): before}))
    (hashes,) = store.tiles().values()
    clouds = Clouds(store)
    levels = clouds.levels(TileHashes(hashes.points, hashes.ground, None))
    store.close()
    (folder / "level.bin").write_bytes(levels.part(0))
    packed = levels.packed[: levels.ends[0]].astype(np.float64)
    points = np.column_stack([packed[:, :2] * 76.8 / 65535, levels.z0_m + packed[:, 2] * levels.z_step_m])
    told = {"points": points.tolist(), "ground": float(np.nanmedian(before.ground_z))}
    (folder / "level.json").write_text(json.dumps(told))
    (folder / "changed.bin").write_bytes(came_and_went(before, after))
