"""``simulate``: a scenario and a seed become drive folders, and the truth apart from them (paper V)."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.grid import CELL_SIZE
from mapvote.core.sensors import NAMED, Sensor
from mapvote.core.types import F32, F64, I32, U8, Bool, MapvoteError
from mapvote.formats.drives.scan_folder import DriveWriter, write_poses
from mapvote_lab.processes import Run, mapping
from mapvote_lab.simulation.actors import Traffic, make_traffic
from mapvote_lab.simulation.flaws import Hits, Kinds, spoil
from mapvote_lab.simulation.lidar import Caster, SlicedCaster, Sweep, measure, sweep
from mapvote_lab.simulation.patterns import MOVING_SLICES, pattern_of, turning
from mapvote_lab.simulation.routes import Route, make_routes
from mapvote_lab.simulation.scenario import Scenario, load_scenario
from mapvote_lab.simulation.truth import (
    Recorded,
    T_map_street,
    count_hits,
    dense_survey,
    ground_cells,
    on_grid,
    passed_surfaces,
    write_truth,
)
from mapvote_lab.simulation.world import Role, World, make_world

Progress = Callable[[int, int], None]
"""Called with (scans done, scans in all)."""
Begun = Callable[[Path, str, str], None]
"""Called with (folder, first survey, first vehicle) when these two drives and their truth are in the folder."""


def simulate(
    scenario: str | Path,
    out: Path,
    seed: int = 1,
    *,
    progress: Progress | None = None,
    overrides: Mapping[str, Any] | None = None,
    workers: int | None = None,
    run: Run | None = None,
    begun: Begun | None = None,
) -> None:
    """Write the drive folders ``out``/survey_1.., ``out``/v1.. and ``out``/truth; ``out`` appears whole.

    ``scenario`` is a name (:func:`mapvote_lab.simulation.scenario.scenario_names`) or a TOML file, ``overrides``
    replace its fields. The bytes written depend on scenario and seed only, not on ``workers`` (default: one process per
    core for long drives) nor on ``run``, a map over tasks by processes that are there already. The first survey and the
    first vehicle drive before all others, and then ``begun`` is called. MapvoteError if ``out`` exists or the scenario
    is not valid.
    """
    out = Path(out)
    if out.exists():
        raise MapvoteError(f"{out}: exists already; remove it or choose another folder")
    spec = load_scenario(scenario, overrides)
    stage = _stage(spec, seed)
    partial = out.with_name(f".{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        writers = [_writer(partial, route, stage).open() for route in stage.routes]
        for route in stage.routes:
            (partial / "truth" / route.name / "moving").mkdir(parents=True)
        T = T_map_street(spec)
        survey, vehicle = first = _first_drives(stage)
        waiting = {*first}

        def close(drive: int) -> None:
            route = stage.routes[drive]
            writers[drive].close(route.stamps_ns, T @ route.priors(np.random.default_rng([seed, 4, drive])))
            write_poses(partial / "truth" / route.name / "poses.txt", T @ route.poses(route.time_s))
            if drive in waiting:
                waiting.remove(drive)
                if begun and not waiting:
                    begun(partial, stage.routes[survey].name, stage.routes[vehicle].name)

        with nullcontext(run) if run else mapping(workers or _processes(stage)) as by_task:
            recorded = _drive_all(stage, partial, by_task, progress, close)
            dense = by_task(_survey, [(spec, seed, drive) for drive in range(len(stage.routes))])
            write_truth(partial / "truth", stage.world, spec, list(dense), recorded)
        os.replace(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@dataclass(frozen=True)
class Stage:
    """Everything that a scenario and a seed decide, the same in every process."""

    scenario: Scenario
    seed: int
    sensor: Sensor
    world: World
    routes: tuple[Route, ...]
    ground: F64
    """(rows, cols) of the scored window."""
    kinds: Kinds


@lru_cache(maxsize=1)
def _stage(scenario: Scenario, seed: int) -> Stage:
    world = make_world(scenario, seed)
    model = NAMED[scenario.sensor]
    noise = scenario.flaws.range_sigma_m
    sigma_m = model.range_sigma_m if noise is None else noise
    sensor = replace(model, rate_hz=max(model.rate_hz, scenario.rate_hz), range_sigma_m=sigma_m)
    routes = tuple(make_routes(scenario, world.terrain, seed))
    glazed, painted = (
        np.array([body.kind == kind for body in world.bodies], dtype=np.bool_) for kind in ("building", "parked car")
    )
    kinds = Kinds(glazed, painted, seed)
    return Stage(scenario, seed, sensor, world, routes, ground_cells(world, scenario), kinds)


@lru_cache(maxsize=1)
def _street(scenario: Scenario, seed: int, drive: int) -> tuple[Caster, Traffic]:
    """Static and moving objects of one drive."""
    stage = _stage(scenario, seed)
    route = stage.routes[drive]
    still = Caster(*stage.world.mesh(stage.world.standing(route.vehicle)))
    duration = route.scans / route.rate_hz
    rng = np.random.default_rng([seed, 5, drive])
    return still, make_traffic(scenario, stage.world.terrain, route.lane, duration, rng)


def _writer(folder: Path, route: Route, stage: Stage) -> DriveWriter:
    mount = np.eye(4)
    mount[2, 3] = route.mount_height_m
    return DriveWriter(
        folder / route.name,
        vehicle=route.name,
        sensor=stage.sensor,
        start_ns=route.start_ns,
        prior_sigma_m=route.prior_sigma_m,
        prior_sigma_deg=route.prior_sigma_deg,
        T_base_lidar=mount,
        motion_compensated=not stage.scenario.motion_distortion,
        with_times=_is_in_slices(stage),
    )


def _is_in_slices(stage: Stage) -> bool:
    """Whether the azimuths of points do not tell their times."""
    return stage.scenario.motion_distortion and pattern_of(stage.sensor) is not turning


def _bodies(stage: Stage, traffic: Traffic, rays: Sweep, stamp_s: float, T_map_lidar: F64) -> Caster | SlicedCaster:
    """Moving objects, at their places when the rays leave."""
    sensor = stage.sensor
    if not _is_in_slices(stage):
        turns_hz = sensor.rate_hz if stage.scenario.motion_distortion else None
        return Caster(*traffic.mesh(stamp_s, T_map_lidar, turns_hz, sensor.max_range_m))
    first = np.linspace(0, len(rays.time_s), MOVING_SLICES.slices, endpoint=False).astype(np.int64)
    middle_s = [float(part.mean()) for part in np.split(rays.time_s, first[1:])]
    meshes = (traffic.mesh(stamp_s + later_s, T_map_lidar, None, sensor.max_range_m) for later_s in middle_s)
    return SlicedCaster([Caster(*mesh) for mesh in meshes], first)


def _processes(stage: Stage) -> int:
    """One per core where a drive is long enough to pay for starting them."""
    return (os.cpu_count() or 1) if sum(route.scans for route in stage.routes) > 400 else 1


def _first_drives(stage: Stage) -> tuple[int, int]:
    """(first survey, first vehicle): indices of their routes."""
    surveys = [route.vehicle is None for route in stage.routes]
    return surveys.index(True), surveys.index(False)


def _drive_all(
    stage: Stage, folder: Path, run: Run, progress: Progress | None, close: Callable[[int], None]
) -> Recorded:
    """Drive every route, the first survey and the first vehicle before the others; ``close(route)`` ends each."""
    first_drives = _first_drives(stage)
    order = [*first_drives, *(drive for drive in range(len(stage.routes)) if drive not in first_drives)]
    scans_a_task = 40  # small enough to keep two processes busy to the end
    tasks = [
        (stage.scenario, stage.seed, folder, drive, first, min(first + scans_a_task, route.scans))
        for drive, route in ((drive, stage.routes[drive]) for drive in order)
        for first in range(0, route.scans, scans_a_task)
    ]
    scans = sum(route.scans for route in stage.routes)
    totals = np.zeros((2, len(Role), *stage.ground.shape), dtype=np.int32)
    densest = np.zeros(stage.ground.shape, dtype=np.int32)
    passed = np.zeros(stage.ground.shape, dtype=np.bool_)
    done = 0
    for task, (cells, hits, most, through) in zip(tasks, run(_drive, tasks), strict=True):
        survey = stage.routes[task[3]].vehicle is None
        totals[0 if survey else 1].ravel()[cells] += hits
        if not survey:
            np.maximum(densest, most, out=densest)
            passed |= through
        done += task[5] - task[4]
        if progress:
            progress(done, scans)
        if task[5] == stage.routes[task[3]].scans:
            close(task[3])
    return Recorded(survey=totals[0], vehicles=totals[1], densest=densest, passed=passed)


def _survey(task: tuple[Scenario, int, int]) -> tuple[I32, F32, U8]:
    """The noise-free survey of one route, for the truth."""
    scenario, seed, drive = task
    stage = _stage(scenario, seed)
    return dense_survey(stage.world, stage.routes[drive], stage.sensor, scenario)


_Task = tuple[Scenario, int, Path, int, int, int]


def _drive(task: _Task) -> tuple[I32, I32, U8, Bool]:
    """Simulate and write some scans of one drive; (flat index, count) of the hits by role and cell, the most that one
    scan had on built bodies (rows, cols), 255 at most, and (rows, cols) where a ray passed a demolished surface."""
    scenario, seed, folder, drive, first, last = task
    stage = _stage(scenario, seed)
    still, traffic = _street(scenario, seed, drive)
    route = stage.routes[drive]
    sensor = stage.sensor
    roles = stage.world.roles()
    writer = _writer(folder, route, stage)
    counts = np.zeros((len(Role), *stage.ground.shape), dtype=np.int32)
    most = np.zeros(stage.ground.shape, dtype=np.int32)
    removed = [] if route.vehicle is None else np.flatnonzero(roles == Role.REMOVED).tolist()
    gone = Caster(*stage.world.mesh(removed or [0]))
    passes = np.zeros_like(counts)
    for index in range(first, last):
        rng = np.random.default_rng(np.random.SeedSequence([seed, 6, drive, index]))
        stamp_s = index / route.rate_hz
        rays = sweep(sensor, route.poses, stamp_s, rng.uniform(), scenario.motion_distortion)
        ranges, objects, cosine = still.cast(rays.origins, rays.directions)
        T_map_lidar = route.poses(np.array([stamp_s]))[0]
        bodies = _bodies(stage, traffic, rays, stamp_s, T_map_lidar)
        near, passing, body_cosine = bodies.cast(rays.origins, rays.directions)
        moving = near < ranges
        ranges = np.where(moving, near, ranges)
        cosine = np.where(moving, body_cosine, cosine)
        hits = Hits(ranges, np.where(moving, passing, objects), cosine, moving)
        reported, false, lost = spoil(
            rays, hits, stage.kinds, (still, bodies), traffic.tails(stamp_s), sensor, scenario.flaws,
            np.random.default_rng(np.random.SeedSequence([seed, 7, drive, index])),
        )  # fmt: skip
        noisy, kept = measure(sensor, reported, cosine, rng)
        kept &= ~lost
        writer.write_scan(index, noisy[kept, None] * rays.directions_lidar[kept], cosine[kept], rays.time_s[kept])
        moving = moving & ~false
        np.save(folder / "truth" / route.name / "moving" / f"{index:06d}.npy", moving[kept])
        solid = kept & ~moving & ~false
        points = rays.origins[solid] + ranges[solid, None] * rays.directions[solid]
        before = counts[Role.ADDED].copy()
        count_hits(on_grid(points, scenario), objects[solid], roles, stage.ground, CELL_SIZE, GROUND_MARGIN_M, counts)
        np.maximum(most, counts[Role.ADDED] - before, out=most)
        if removed:
            through = on_grid(passed_surfaces(gone, rays.origins, rays.directions, ranges), scenario)
            owners = np.full(len(through), removed[0], dtype=np.int32)
            count_hits(through, owners, roles, stage.ground, CELL_SIZE, GROUND_MARGIN_M, passes)
    hit_cells = np.flatnonzero(counts).astype(np.int32)
    return hit_cells, counts.ravel()[hit_cells], most.clip(max=255).astype(np.uint8), passes[Role.REMOVED] > 0
