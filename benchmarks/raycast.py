"""How fast are the simulator's rays beside Open3D's ray casting scene? One scan of a street with movers, one core.

    python benchmarks/raycast.py [--scenario street] [--seed 2] [--scans 40]

Needs the extras sim and bench. For each scan both sides get the same rays and the same triangles: what stands is laid
out once before, what moves anew for every scan, as it must be. Both answer with the range and the object that each ray
meets, and with the cosine of incidence. They take turns; what is counted is the CPU time of this process, which is held
on one core. Ranges that differ by more than a millimetre are counted too: there both are wrong, or one.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

import numpy as np
import open3d as o3d

from mapvote.core.types import F32, I32
from mapvote_lab.simulation.drives import _stage, _street
from mapvote_lab.simulation.lidar import Caster, sweep
from mapvote_lab.simulation.scenario import load_scenario

_Answer = tuple[F32, I32, F32]


def laid_out(triangles: F32) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    if len(triangles):
        corners = np.ascontiguousarray(triangles, dtype=np.float32).reshape(-1, 3)
        scene.add_triangles(corners, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3))
    return scene


def met(scene: o3d.t.geometry.RaycastingScene, owners: I32, rays: F32) -> _Answer:
    hit = scene.cast_rays(rays, nthreads=1)
    found = hit["primitive_ids"].numpy()
    cosine = np.abs(np.einsum("ij,ij->i", hit["primitive_normals"].numpy(), rays[:, 3:]))
    return hit["t_hit"].numpy(), np.append(owners, np.int32(-1))[np.minimum(found, len(owners))], cosine


def nearer(first: _Answer, second: _Answer) -> _Answer:
    closer = second[0] < first[0]
    ranges, objects, cosine = (np.where(closer, b, a) for a, b in zip(first, second, strict=True))
    return ranges, objects, cosine


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="street")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--scans", type=int, default=40)
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    scenario = load_scenario(options.scenario)
    stage = _stage(scenario, options.seed)
    drive = next(i for i, route in enumerate(stage.routes) if route.vehicle is not None)
    route, sensor = stage.routes[drive], stage.sensor
    still, traffic = _street(scenario, options.seed, drive)
    triangles, owners = stage.world.mesh(stage.world.standing(route.vehicle))
    standing = laid_out(triangles)
    ours, theirs, apart = list[float](), list[float](), 0
    rays_each, bodies_each = 0, list[int]()
    for index in np.linspace(0, route.scans - 1, options.scans + 1).astype(int).tolist():
        stamp_s = index / route.rate_hz
        rays = sweep(sensor, route.poses, stamp_s, 0.5, scenario.motion_distortion)
        turning = sensor.rate_hz if scenario.motion_distortion else None
        bodies, whose = traffic.mesh(stamp_s, route.poses(np.array([stamp_s]))[0], turning, sensor.max_range_m)
        six = np.hstack([rays.origins, rays.directions])

        def embree(rays=rays, bodies=bodies, whose=whose) -> _Answer:  # type: ignore[no-untyped-def]
            first = still.cast(rays.origins, rays.directions)
            return nearer(first, Caster(bodies, whose).cast(rays.origins, rays.directions))

        def open3d(six=six, bodies=bodies, whose=whose) -> _Answer:  # type: ignore[no-untyped-def]
            return nearer(met(standing, owners, six), met(laid_out(bodies), whose, six))

        sides: list[tuple[Callable[[], _Answer], list[float]]] = [(embree, ours), (open3d, theirs)]
        answers = []
        for side, took in sides if len(ours) % 2 else sides[::-1]:
            start = time.process_time()
            answers.append(side()[0])
            took.append(1e3 * (time.process_time() - start))
        a, b = (np.nan_to_num(ranges, posinf=1e4) for ranges in answers)
        apart += int((np.abs(a - b) > 1e-3).sum())
        rays_each = len(a)
        bodies_each.append(len(bodies))
    del ours[0], theirs[0]  # the first scan waits for what both load
    print(
        f"{options.scenario} {options.seed}: {rays_each} rays, {len(triangles)} triangles that stand, "
        f"{np.mean(bodies_each):.0f} that move; {len(ours)} scans, {apart / (rays_each * (len(ours) + 1)):.1e} of the "
        "ranges differ by more than 1 mm"
    )
    print("| CPU ms a scan | median | mean | worst |\n|---|---|---|---|")
    for name, took in (("ours (embreex)", ours), ("Open3D", theirs)):
        print(f"| {name} | {np.median(took):.1f} | {np.mean(took):.1f} | {np.max(took):.1f} |")
    medians, means = np.median(theirs) / np.median(ours), np.mean(theirs) / np.mean(ours)
    print(f"| times | {medians:.2f} | {means:.2f} | |")


if __name__ == "__main__":
    main()
