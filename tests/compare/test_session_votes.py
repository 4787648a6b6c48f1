"""A session's cloud votes: on what it shows, and on nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from made_courts import CARS, court_clouds, made_court
from mapvote.codec.ballot import Ballot
from mapvote.compare.session_votes import vote_of_session
from mapvote.compare.trajectory_rays import with_free_space
from mapvote.config import Settings, choose_case
from mapvote.core.geometry import from_xyz_rpy, transform
from mapvote.core.point_map import PointMap, all_points, map_from_points
from mapvote.core.types import F64, MapvoteError
from mapvote.formats import read_map
from mapvote.fusion.fuse import update_map

NEW = (-2.0, -8.0, 2.0, -6.2, 1.5)
SURFACES = choose_case(Settings(), "surfaces")


def session(seed: int, point_map: PointMap, cloud: F64) -> Ballot:
    moved = map_from_points(transform(from_xyz_rpy(10.0 * seed, 5.0, 1.0, yaw=float(seed)), cloud))
    return vote_of_session(f"robot{seed}", f"s{seed}", point_map, moved, SURFACES, end_ns=10**18 + seed).ballot


def in_box(point_map: PointMap, x0: float, y0: float, x1: float, y1: float) -> int:
    """Points in a box that do not lie on the ground."""
    p = all_points(point_map)
    above = p[:, 2] - 0.01 * p[:, 0] - 0.005 * p[:, 1] > 0.35
    return int((above & (p[:, 0] > x0) & (p[:, 0] < x1) & (p[:, 1] > y0) & (p[:, 1] < y1)).sum())


@pytest.mark.slow
def test_two_sessions_publish_what_both_saw_and_one_alone_publishes_nothing() -> None:
    before = map_from_points(made_court())
    ballots = [session(seed, before, made_court((*CARS[1:], NEW), seed=seed)) for seed in (2, 3)]
    after, decisions = update_map(before, ballots, SURFACES.fuse.model_copy(update={"min_votes": 2}))
    assert in_box(before, -20.5, -17.5, -15.0, -14.5) > 300
    assert in_box(after, -20.5, -17.5, -15.0, -14.5) < 30
    assert in_box(after, -2.5, -8.5, 2.5, -5.7) > 100
    elsewhere = sum(d.deleted for d in decisions.values()) - in_box(before, -20.5, -17.5, -15.0, -14.5)
    assert elsewhere < 20
    alone, _ = update_map(before, ballots[:1], SURFACES.fuse.model_copy(update={"min_votes": 2}))
    assert alone.n_points == before.n_points


@pytest.mark.slow
def test_a_tree_crown_over_a_car_that_left_stays() -> None:
    rng = np.random.default_rng(4)
    crown = np.array([-17.8, -16.1, 4.0]) + rng.normal(0.0, (1.2, 1.2, 0.5), (800, 3))
    before = map_from_points(np.concatenate([made_court(), crown]))
    ballots = [session(seed, before, made_court(CARS[1:], seed=seed)) for seed in (2, 3)]
    after, _ = update_map(before, ballots, SURFACES.fuse.model_copy(update={"min_votes": 2}))
    high = (all_points(after)[:, 2] > 2.6) & (np.abs(all_points(after)[:, :2] + [17.8, 16.1]) < 4.0).all(axis=1)
    assert high.sum() > 750


@pytest.mark.slow
def test_rays_of_a_trajectory_make_free_what_they_pass_and_nothing_behind_a_wall() -> None:
    court = map_from_points(made_court(()))
    driven = np.column_stack([np.arange(-20.0, 21.0, 1.0), np.zeros(41), np.full(41, 1.8)])
    carved = with_free_space(court, driven)
    free = {index: tile.free for index, tile in carved.tiles.items() if tile.free is not None}
    assert free

    def is_free(x: float, y: float) -> bool:
        rows, cols = court.lattice.cells_of(np.array([[x, y]]))
        index = int(rows[0]) // 256, int(cols[0]) // 256
        word = int(free[index][rows[0] % 256, cols[0] % 256])
        return bool(word >> 4 & 1)

    assert is_free(0.5, 5.0)
    assert not is_free(0.0, -23.5)  # behind the wall at y = -22


def test_the_papers_rule_counts_scans_and_a_cloud_has_none() -> None:
    court = map_from_points(made_court())
    with pytest.raises(MapvoteError, match="counts scans, and a cloud has none: use surfaces"):
        vote_of_session("r", "s", court, court, choose_case(Settings(), "5"), end_ns=1)


@pytest.mark.slow
def test_three_sessions_of_the_real_court_publish_its_three_changes_and_no_crown_and_one_alone_nothing() -> None:
    folder: Path = court_clouds()
    before = read_map(folder / "gtmap.pcd")
    said = [
        vote_of_session(name, name, before, read_map(folder / f"{name}.pcd"), SURFACES, end_ns=10**18 + i)
        for i, name in enumerate(("robot1", "robot2", "robot3"))
    ]
    assert [bool(one.registered.bent) for one in said] == [False, False, True]
    two = SURFACES.fuse.model_copy(update={"min_votes": 2})
    after, decisions = update_map(before, [one.ballot for one in said], two)
    changed = [np.argwhere(np.isin(d.states, (2, 3))) * 0.3 + 76.8 * np.array(index) for index, d in decisions.items()]
    y, x = np.concatenate(changed).T
    boxes = ((-5.7, -4.1, -1.6, 3.3), (15.3, -32.3, 28.1, -23.7), (-7.2, 9.7, -3.4, 14.1))
    inside = [(x > x0) & (x < x1) & (y > y0) & (y < y1) for x0, y0, x1, y1 in boxes]
    assert all(one.sum() * 0.09 > 1.5 for one in inside)
    assert (~np.logical_or.reduce(inside)).sum() * 0.09 < 2.0  # all of it together, not one object
    alone, _ = update_map(before, [said[0].ballot], two)
    assert alone.n_points == before.n_points
    assert after.n_points != before.n_points
