"""What a simulated sensor's rays into the sky truly meet, in streets with panes, dark paint and wet patches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.core.geometry import rows_from
from mapvote.core.grid import CELL_SIZE
from mapvote.formats import open_drive
from mapvote.formats.drives.trajectory import read_poses
from mapvote.localisation.prepare import deskew, motion_at
from mapvote.perception.fans import follow_rays
from mapvote.perception.sky import Sky
from mapvote_lab.simulation import simulate
from mapvote_lab.simulation.lidar import Caster
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.world import make_world

WINDOW_M = 40.0


@pytest.mark.slow
def test_hardly_a_ray_into_the_sky_meets_anything_in_the_window(tmp_path: Path) -> None:
    simulate("corner", tmp_path / "corner", 5)
    world = make_world(load_scenario("corner", {}), 5)
    for number, vehicle in enumerate(("v1", "v2")):
        drive = open_drive(tmp_path / "corner" / vehicle)
        poses = read_poses(tmp_path / "corner" / "truth" / vehicle / "poses.txt")
        street, sky = Caster(*world.mesh(world.standing(number))), Sky(drive.sensor)
        reach = []
        for i in range(0, len(drive), 8):
            T = poses[i]
            points = deskew(drive.read_scan(i), motion_at(drive.stamps_ns, poses, i)) @ T[:3, :3].T + T[:3, 3]
            rays = sky.rays(T[:3, 2].copy(), follow_rays(rows_from(points, T[:3, 3].copy()), 0.45))
            way = np.column_stack([rays.x, rays.y, rays.slope * CELL_SIZE])
            length = np.linalg.norm(way, axis=1)
            starts = np.broadcast_to(T[:3, 3].astype(np.float32), way.shape).copy()
            ranges, _, _ = street.cast(starts, (way / length[:, None]).astype(np.float32))
            reach.append(ranges / length)
        met = np.concatenate(reach) < WINDOW_M
        assert len(met) > 200 * len(reach)
        assert met.mean() < 0.002
