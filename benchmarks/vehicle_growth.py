"""Does a vehicle's memory grow with the road it drives? One simulated street, laid end to end.

    python benchmarks/vehicle_growth.py SIMULATED_FOLDER MAP KM [KM ..]

SIMULATED_FOLDER is what ``mapvote simulate`` wrote, MAP what ``mapvote build`` made of its surveys. The map's three
middle tiles and the part of v1's drive through them are repeated every 230.4 m; scans, priors and stamps go on. Where
two copies meet the scan shows another street than the map: there scans may be lost, which says nothing here. What is
printed for each distance: megabytes beside interpreter, kernels and map (resident, and the most until then), CPU a
scan, and at the end what making and encoding the ballot takes. Distances are driven one after another, as one drive.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapvote.codec.ballot import encode
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive, Scan
from mapvote.formats import open_drive, read_map
from mapvote.vehicle import Vehicle

TILES = 3
PERIOD_M = TILES * TILE_CELLS * CELL_SIZE


def laid_end_to_end(point_map: PointMap, copies: int) -> PointMap:
    """The columns 0 to 2 of the map's tiles, again and again along x."""
    tiles = {}
    for (row, col), tile in point_map.tiles.items():
        for k in range(copies if 0 <= col < TILES else 0):
            index = row, col + TILES * k
            tiles[index] = replace(tile, window=point_map.lattice.tile(index), points=tile.points.copy())
    return replace(point_map, tiles=tiles, driven=())


def long_drive(drive: Drive, x0: float, copies: int) -> Iterator[tuple[Scan, F64]]:
    """Scans and their priors of the part of the drive from ``x0`` on, again and again."""
    assert drive.T_map_lidar_prior is not None
    x = drive.T_map_lidar_prior[:, 0, 3]
    part = np.flatnonzero((x >= x0) & (x < x0 + PERIOD_M))
    step_ns = int(np.median(np.diff(drive.stamps_ns)))
    for k in range(copies):
        for n, i in enumerate(part):
            prior = drive.T_map_lidar_prior[i].copy()
            prior[0, 3] += k * PERIOD_M
            yield (
                replace(drive.read_scan(int(i)), stamp_ns=int(drive.stamps_ns[0]) + step_ns * (k * len(part) + n)),
                prior,
            )


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def most_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def new_vehicle(drive: Drive, point_map: PointMap) -> Vehicle:
    sigmas = {"prior_sigma_m": drive.prior_sigma_m, "prior_sigma_deg": drive.prior_sigma_deg}
    return Vehicle(drive.vehicle, drive.sensor, point_map, **sigmas)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("map", type=Path)
    parser.add_argument("km", type=float, nargs="+")
    options = parser.parse_args()
    drive, street = open_drive(options.folder / "v1"), read_map(options.map)
    assert drive.T_map_lidar_prior is not None
    warm = new_vehicle(drive, street)
    for i in range(30):
        warm.observe(drive.read_scan(i), drive.T_map_lidar_prior[i])
    warm.finish()
    warm.ballot()
    del warm
    copies = int(np.ceil(1e3 * max(options.km) / PERIOD_M)) + 1
    vehicle = new_vehicle(drive, laid_end_to_end(street, copies))
    base, x0 = resident_mb(), 0.5 * (drive.T_map_lidar_prior[:, 0, 3].min() + drive.T_map_lidar_prior[:, 0, 3].max())
    x0 -= 0.5 * PERIOD_M
    distances, start = sorted(options.km), time.process_time()
    print(f"base {base:.0f} MB: interpreter, kernels, a map of {len(vehicle.point_map.tiles)} tiles")
    print("| km | scans (lost) | MB | most | CPU ms a scan |\n|---|---|---|---|---|")
    for scans, (scan, prior) in enumerate(long_drive(drive, x0, copies), start=1):
        vehicle.observe(scan, prior)
        if prior[0, 3] - x0 >= 1e3 * distances[0]:
            took = 1e3 * (time.process_time() - start) / scans
            lost, now, most = len(vehicle.report.lost), resident_mb() - base, most_mb() - base
            print(f"| {distances.pop(0):g} | {scans} ({lost}) | {now:.0f} | {most:.0f} | {took:.1f} |")
            if not distances:
                break
    vehicle.finish()
    start = time.process_time()
    ballot = vehicle.ballot()
    data = encode(ballot)
    print(
        f"ballot: {len(ballot.tiles)} tiles, {len(data) / len(ballot.tiles) / 1e3:.1f} kB each, "
        f"{time.process_time() - start:.1f} s of CPU, most {most_mb() - base:.0f} MB"
    )


if __name__ == "__main__":
    main()
