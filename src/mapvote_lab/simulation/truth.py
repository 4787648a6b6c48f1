"""True changes, from the simulator alone (docs/decisions/truth.md): two definitions, cell by cell.

**strict** comes from a noise-free survey: dense rays from the true poses of all drives, into the street
before and the street after. A cell gained if a built body's surface lies in it where nothing was before, and
lost if a demolished body's did where nothing is now. **provenance** comes from the object ids of the points that
the drives recorded: lost, if most survey points in the cell fell on removed bodies; gained, if it has at least
``TruthRule.support`` points of new surface (fewer: unscored, and counted).

In both, a cell whose only surface is old but was never seen by the surveys is unscored: it is no change of the
world, and the map cannot know it. So are cells of cars that some passes met and others did not, where a majority
of passes contradicts the survey. Points less than 0.3 m above the ground count for nothing.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.grid import CELL_SIZE, Grid, Lattice
from mapvote.core.kernel import kernel
from mapvote.core.record import record
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, U8, Bool
from mapvote.core.voxels import voxel_downsample
from mapvote_lab.simulation.lidar import NOTHING, Caster
from mapvote_lab.simulation.patterns import in_view
from mapvote_lab.simulation.routes import Route
from mapvote_lab.simulation.scenario import Scenario
from mapvote_lab.simulation.shapes import sample
from mapvote_lab.simulation.world import Role, World


class Label(IntEnum):
    """Truth of a cell, in ``strict`` and ``provenance`` of truth.npz."""

    UNCHANGED = 0
    CHANGED_OCCUPIED = 1
    CHANGED_EMPTY = 2
    UNSCORED = 255


@record()
@dataclass(frozen=True, slots=True)
class TruthRule:
    """How the truth is measured in the simulated street."""

    support: int = 20
    """Points, pooled over the drives at 10 Hz, that make a surface well supported (in proportion at other rates)."""
    most_surfaces: int = 8
    """Surfaces of demolished bodies through which one ray is followed: four walls, twice."""
    beyond_m: float = 0.15
    """A ray that ends nearer behind a surface did not pass it, metres: half a voxel."""
    step_on_m: float = 0.01
    """A followed ray starts again this far behind the surface it passed, metres."""
    step_m: float = 1.5
    """Distance between poses of the noise-free survey, metres."""
    reach_m: float = 50.0
    """The noise-free survey casts rays at changed bodies within this distance of a pose, metres."""
    azimuth_step_deg: float = 0.3
    """Angle between neighbouring azimuths of the noise-free survey, degrees."""
    sample_m: float = 0.1
    """Voxel side by which samples of changed surfaces are thinned, metres."""
    kept_sample_m: float = 0.25
    """Distance between samples of surfaces that stay, metres."""


TRUTH_RULE = TruthRule()


@dataclass(frozen=True, slots=True)
class Recorded:
    """Records of the drives on static bodies, cell by cell."""

    survey: I32
    """(roles, rows, cols) points of the survey drives."""
    vehicles: I32
    """(roles, rows, cols) points of the voting vehicles."""
    densest: I32
    """(rows, cols) most points that one scan of a vehicle had on built bodies."""
    passed: Bool
    """(rows, cols) whether a vehicle's ray went through the place of a demolished surface
    (:func:`passed_surfaces`)."""


class Reason(IntEnum):
    """Why a cell is unscored, in ``reason`` of truth.npz; the first applies to provenance only."""

    WEAKLY_SUPPORTED = 1
    REMOVED_NEVER_SURVEYED = 2
    OLD_NEVER_SURVEYED = 3
    CAR_OF_SOME_PASSES = 4


def T_map_street(scenario: Scenario) -> F64:
    """(4, 4) from the frame in which a street is laid out, along x, to that of its truth and its drives."""
    return from_xyz_rpy(0.0, 0.0, 0.0, 0.0, 0.0, np.radians(scenario.heading_deg))


def truth_grid(scenario: Scenario) -> Grid:
    """The scored window around the street, the road in its middle, its first corner at map (0, 0)."""
    far = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]) * (scenario.length_m, scenario.width_m, 0.0)
    corners = transform(T_map_street(scenario), far)[:, :2]
    (col, row), (end_col, end_row) = (
        np.rint(side(corners, axis=0) / CELL_SIZE).astype(int) for side in (np.min, np.max)
    )
    return Grid(Lattice(), int(row), int(col), int(end_row - row), int(end_col - col))


def on_grid(points: F32, scenario: Scenario) -> F32:
    """Points (n, 3) of the street's frame in that of :func:`truth_grid`, metres from its corner."""
    if not scenario.heading_deg:
        return points
    grid = truth_grid(scenario)
    return (transform(T_map_street(scenario), points) - (grid.x0, grid.y0, 0.0)).astype(np.float32)


def ground_cells(world: World, scenario: Scenario) -> F64:
    """(rows, cols) height of the ground at the centres of :func:`truth_grid`'s cells."""
    grid = truth_grid(scenario)
    x, y = np.meshgrid(*grid.centres())
    street = transform(inverse(T_map_street(scenario)), np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))
    return world.terrain.height(street[:, 0].reshape(grid.shape), street[:, 1].reshape(grid.shape))


@kernel
def count_hits(points: F32, objects: I32, roles: I32, ground: F64, size: float, margin: float, counts: I32) -> None:
    """Add points (n, 3) in the grid's own frame to ``counts`` (roles, rows, cols) by the role of the object hit."""
    for i in range(len(points)):
        if objects[i] <= 0:  # the ground, or nothing
            continue
        c = int(np.floor(points[i, 0] / size))
        r = int(np.floor(points[i, 1] / size))
        if r < 0 or c < 0 or r >= ground.shape[0] or c >= ground.shape[1]:
            continue
        if points[i, 2] - ground[r, c] >= margin:
            counts[roles[objects[i]], r, c] += 1


def dense_survey(
    world: World, route: Route, sensor: Sensor, scenario: Scenario, rule: TruthRule = TRUTH_RULE
) -> tuple[I32, F32, U8]:
    """Noise-free rays from the true poses of one route, into the street before and the street after.

    Gives counts (2, roles, rows, cols) of hits, and samples (m, 3) of surfaces that came or went, street metres, with
    their role (m,).
    Only rays towards bodies that changed are cast: elsewhere nothing could change.
    """
    # Poses along the route, and the circles around bodies that changed.
    roles = world.roles()
    ground = ground_cells(world, scenario)
    changed = [i for i, role in enumerate(roles) if role in (Role.ADDED, Role.REMOVED)]
    circles = np.array([_circle(world.bodies[i].triangles) for i in changed]).reshape(-1, 3)
    poses = route.poses(np.arange(0.0, route.length / route.speed, rule.step_m / route.speed))
    hits = np.zeros((2, len(Role), *ground.shape), dtype=np.int32)
    samples = []
    labels = []
    # The street before holds objects that stay or are demolished; the street after those that stay or are built.
    for when, role in enumerate((Role.REMOVED, Role.ADDED)):
        caster = Caster(*world.mesh([i for i, r in enumerate(roles) if r in (Role.KEPT, role)]))
        changed_points = [np.zeros((0, 3), dtype=np.float32)]
        for T in poses:
            directions = _towards(T, circles, sensor, rule)
            origins = np.ascontiguousarray(np.broadcast_to(T[:3, 3].astype(np.float32), directions.shape))
            ranges, objects, _ = caster.cast(origins, directions)
            met = objects != NOTHING
            points = origins[met] + ranges[met, None] * directions[met]
            objects = objects[met]
            count_hits(on_grid(points, scenario), objects, roles, ground, CELL_SIZE, GROUND_MARGIN_M, hits[when])
            changed_points.append(points[roles[objects] == role])
        # One sample of a changed surface for each voxel.
        cloud = np.concatenate(changed_points)
        samples.append(cloud[voxel_downsample(cloud, rule.sample_m)])
        labels.append(np.full(len(samples[-1]), role, dtype=np.uint8))
    return hits, np.concatenate(samples), np.concatenate(labels)


def passed_surfaces(gone: Caster, origins: F32, directions: F32, ranges: F32, rule: TruthRule = TRUTH_RULE) -> F32:
    """(m, 3) places where rays (n, 3) go through surfaces of ``gone`` bodies, and go on beyond them: they end at
    ``ranges`` (n,). A ray is followed through ``rule.most_surfaces`` surfaces."""
    at = np.zeros(len(ranges), dtype=np.float32)
    active = np.arange(len(ranges))
    places = [np.zeros((0, 3), np.float32)]
    for _ in range(rule.most_surfaces):
        begins = origins[active] + at[active, None] * directions[active]
        at[active] += gone.cast(begins, directions[active])[0]
        active = active[at[active] + rule.beyond_m < ranges[active]]
        places.append(origins[active] + at[active, None] * directions[active])
        at[active] += rule.step_on_m
    return np.concatenate(places)


def _circle(triangles: F64) -> tuple[float, float, float]:
    low = triangles.min(axis=(0, 1))
    high = triangles.max(axis=(0, 1))
    middle = 0.5 * (low + high)
    return float(middle[0]), float(middle[1]), float(0.5 * np.hypot(*(high - low)[:2])) + 0.3


def _towards(T_map_lidar: F64, circles: F64, sensor: Sensor, rule: TruthRule) -> F32:
    """(n, 3) unit directions in the map frame, at twice the sensor's vertical resolution, that may meet a circle."""
    offset = circles[:, :2] - T_map_lidar[:2, 3]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    near = distance - circles[:, 2] < rule.reach_m
    azimuth = np.radians(np.arange(-180.0, 180.0, rule.azimuth_step_deg))
    wanted = np.zeros(len(azimuth), dtype=bool)
    for (dx, dy), d, radius in zip(offset[near], distance[near], circles[near, 2], strict=True):
        half = np.pi if d <= radius else np.arcsin(radius / d)
        turn = azimuth - np.arctan2(dy, dx)
        wanted |= np.abs((turn + np.pi) % (2 * np.pi) - np.pi) <= half
    azimuth = azimuth[wanted] - np.arctan2(T_map_lidar[1, 0], T_map_lidar[0, 0])
    elevation = np.radians(np.linspace(sensor.fov_bottom_deg, sensor.fov_top_deg, 2 * sensor.beams - 1))
    local = np.empty((len(azimuth), len(elevation), 3))
    local[..., 0] = np.outer(np.cos(azimuth), np.cos(elevation))
    local[..., 1] = np.outer(np.sin(azimuth), np.cos(elevation))
    local[..., 2] = np.sin(elevation)
    rays = local.reshape(-1, 3)
    return (rays[in_view(sensor, rays)] @ T_map_lidar[:3, :3].T).astype(np.float32)


def label_cells(
    dense: I32, survey: I32, vehicles: I32, rate_hz: float, rule: TruthRule = TRUTH_RULE
) -> tuple[U8, U8, U8]:
    """(strict, provenance, reason why a cell is unscored), each (rows, cols).

    ``dense`` (2, roles, rows, cols): noise-free hits before and after; ``survey`` and ``vehicles`` (roles, rows, cols):
    points recorded by survey drives and by voting vehicles.
    """
    # Cells that the surveys saw, cells with old surface now, and cells of cars that only some passes met.
    before, after = dense
    support = max(1, round(rule.support * rate_hz / 10.0))
    mapped = (survey[Role.KEPT] > 0) | (survey[Role.REMOVED] > 0)
    old_now = (after[Role.KEPT] > 0) | (vehicles[Role.KEPT] > 0)
    unclear = (survey[Role.UNCLEAR] > 0) | (vehicles[Role.UNCLEAR] > 0)

    # Strict: built or demolished surface in a cell that holds no surface that stays.
    old_before = (before[Role.KEPT] > 0) | (survey[Role.KEPT] > 0)
    lost = (before[Role.REMOVED] > 0) & ~old_before & ~old_now & (after[Role.ADDED] == 0)
    gained = (after[Role.ADDED] > 0) & (before[Role.REMOVED] == 0) & ~old_before & ~old_now & ~mapped
    strict = np.full(lost.shape, Label.UNCHANGED, dtype=np.uint8)
    strict[gained] = Label.CHANGED_OCCUPIED
    strict[lost] = Label.CHANGED_EMPTY

    # Provenance: most survey points on demolished bodies, or vehicles' points on built ones.
    lost_points = (survey[Role.REMOVED] > survey[Role.KEPT]) & ~(vehicles[Role.KEPT] > 0)
    lost_points &= vehicles[Role.ADDED] < support
    new_points = (vehicles[Role.ADDED] > 0) & ~mapped & ~old_now
    provenance = np.full(lost.shape, Label.UNCHANGED, dtype=np.uint8)
    provenance[new_points] = Label.CHANGED_OCCUPIED
    provenance[lost_points] = Label.CHANGED_EMPTY
    weak = (lost_points & (survey[Role.REMOVED] < support)) | (new_points & (vehicles[Role.ADDED] < support))

    # Cells that cannot be known are not scored; a later reason overrules an earlier one.
    reason = np.zeros(lost.shape, dtype=np.uint8)
    reason[weak] = Reason.WEAKLY_SUPPORTED
    reason[lost & ~mapped] = Reason.REMOVED_NEVER_SURVEYED
    reason[old_now & ~mapped] = Reason.OLD_NEVER_SURVEYED
    reason[unclear] = Reason.CAR_OF_SOME_PASSES
    strict[reason > Reason.WEAKLY_SUPPORTED] = Label.UNSCORED
    provenance[reason != 0] = Label.UNSCORED
    return strict, provenance, reason


def write_truth(
    folder: Path,
    world: World,
    scenario: Scenario,
    dense: Sequence[tuple[I32, F32, U8]],
    recorded: Recorded,
    rule: TruthRule = TRUTH_RULE,
) -> None:
    """truth.npz, surface.npz and objects.json into ``folder``; ``dense`` holds :func:`dense_survey` of each route."""
    # truth.npz: the two definitions, cell by cell.
    grid = truth_grid(scenario)
    hits: I32 = np.stack([counts for counts, _, _ in dense]).sum(axis=0, dtype=np.int32)
    strict, provenance, reason = label_cells(hits, recorded.survey, recorded.vehicles, scenario.rate_hz, rule)
    np.savez_compressed(
        folder / "truth.npz",
        strict=strict,
        provenance=provenance,
        reason=reason,
        densest=recorded.densest.astype(np.uint8),
        hit=recorded.vehicles[Role.ADDED] > 0,
        passed=recorded.passed,
        x0=grid.x0,
        y0=grid.y0,
        cell_size=CELL_SIZE,
    )
    # surface.npz: samples of surfaces that stay, near the scored window, and of those that came or went.
    stays = [b.triangles for i, b in enumerate(world.bodies) if b.role == Role.KEPT and i > 0]
    kept = sample(np.concatenate(stays), rule.kept_sample_m, np.random.default_rng(0)).astype(np.float32)
    near = (kept[:, :2] > -20.0) & (kept[:, :2] < (scenario.length_m + 20.0, scenario.width_m + 20.0))
    kept = kept[near.all(axis=1)]
    changed = np.concatenate([d[1] for d in dense])
    roles = np.concatenate([d[2] for d in dense])
    first = voxel_downsample(changed, rule.sample_m)
    label = np.concatenate([np.full(len(kept), Role.KEPT, dtype=np.uint8), roles[first]])
    T = T_map_street(scenario)
    surface = transform(T, np.concatenate([kept, changed[first]])).astype(np.float32)
    np.savez(folder / "surface.npz", points=surface, label=label)
    # objects.json: every body that was built or demolished, and how many cells are unscored for which reason.
    objects = [_describe(i, world, T) for i, b in enumerate(world.bodies) if b.role in (Role.ADDED, Role.REMOVED)]
    unscored = {r.name.lower(): int((reason == r).sum()) for r in Reason}
    summary = {"scenario": scenario.name, "cells": reason.size, "unscored": unscored, "objects": objects}
    (folder / "objects.json").write_text(json.dumps(summary, indent=1) + "\n")


def _describe(index: int, world: World, T_map_street: F64) -> dict[str, object]:
    body = world.bodies[index]
    corners = body.triangles.reshape(-1, 3)
    hull = corners[ConvexHull(corners[:, :2]).vertices, :2]
    ground = float(world.terrain.height(*hull.mean(axis=0)))
    hull = transform(T_map_street, np.column_stack([hull, np.zeros(len(hull))]))[:, :2]
    return {
        "id": index,
        "what": body.kind,
        "kind": "built" if body.role == Role.ADDED else "demolished",
        "footprint": hull.round(3).tolist(),
        "height_m": round(float(corners[:, 2].max()) - ground, 3),
    }
