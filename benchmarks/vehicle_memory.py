"""Does a vehicle's memory grow with the road that it drives? One simulated street, laid end to end.

    python benchmarks/vehicle_memory.py SIMULATED_FOLDER MAP KM [KM ..]

SIMULATED_FOLDER is the output of ``mapvote simulate``, MAP the map that ``mapvote build`` made of its surveys. The
three middle tiles of the map and the part of v1's drive through them are repeated every 230.4 m; scans, priors and
stamps go on. Where two copies meet the scan shows another street than the map: there the vehicle is lost, and searches
the whole map. The lines say for each distance how many megabytes the vehicle has beside interpreter, kernels and map,
which is held whole, the most until then, and the CPU time a scan, reading it included. Distances are driven one after
another, as one drive.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapvote.codec.ballot import encode
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.point_map import PointMap
from mapvote.core.process_memory import give_back_free_pages
from mapvote.core.types import F64, Drive, Scan
from mapvote.formats import open_drive, read_map, write_map
from mapvote.formats.maps.cloud import ReadSizes
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
    """Scans and their priors (4, 4) of the part of the drive from ``x0``, map metres, again and again."""
    assert drive.T_map_lidar_prior is not None
    x = drive.T_map_lidar_prior[:, 0, 3]
    part = np.flatnonzero((x >= x0) & (x < x0 + PERIOD_M))
    step_ns = int(np.median(np.diff(drive.stamps_ns)))
    for k in range(copies):
        for n, i in enumerate(part):
            prior = drive.T_map_lidar_prior[i].copy()
            prior[0, 3] += k * PERIOD_M
            stamp_ns = int(drive.stamps_ns[0]) + step_ns * (k * len(part) + n)
            yield replace(drive.read_scan(int(i)), stamp_ns=stamp_ns), prior


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def new_vehicle(drive: Drive, point_map: PointMap) -> Vehicle:
    sigmas = {"prior_sigma_m": drive.prior_sigma_m, "prior_sigma_deg": drive.prior_sigma_deg}
    return Vehicle(drive.vehicle, drive.sensor, point_map, **sigmas)


def load_kernels(drive: Drive, street: PointMap) -> None:
    """A first drive, which leaves nothing but the kernels."""
    assert drive.T_map_lidar_prior is not None
    vehicle = new_vehicle(drive, street)
    for i in range(30):
        vehicle.observe(drive.read_scan(i), drive.T_map_lidar_prior[i])
    vehicle.finish()
    vehicle.ballot()


def measure(drive: Drive, point_map: PointMap, kilometres: list[float], copies: int) -> None:
    """Drive, and print a row for each distance and a line on the ballot."""
    assert drive.T_map_lidar_prior is not None
    vehicle = new_vehicle(drive, point_map)
    base = resident_mb()
    print(f"{base:.0f} MB: interpreter, kernels, a map of {len(point_map.tiles)} tiles")
    print("| km | scans (lost) | MB | most | CPU ms a scan |\n|---|---|---|---|---|")
    x = drive.T_map_lidar_prior[:, 0, 3]
    x0 = 0.5 * (x.min() + x.max()) - 0.5 * PERIOD_M
    most = 0.0
    start = time.process_time()
    for scans, (scan, prior) in enumerate(long_drive(drive, x0, copies), start=1):
        vehicle.observe(scan, prior)
        now = resident_mb() - base
        most = max(most, now)
        if prior[0, 3] - x0 >= 1e3 * kilometres[0]:
            cpu_ms = 1e3 * (time.process_time() - start) / scans
            lost = len(vehicle.report.lost)
            print(f"| {kilometres.pop(0):g} | {scans} ({lost}) | {now:.0f} | {most:.0f} | {cpu_ms:.1f} |", flush=True)
            if not kilometres:
                break
    vehicle.finish()
    ballot = vehicle.ballot()
    print(f"ballot: {len(ballot.tiles)} tiles, {len(encode(ballot)) / len(ballot.tiles) / 1e3:.1f} kB each")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("map", type=Path)
    parser.add_argument("km", type=float, nargs="+")
    parser.add_argument("--lay-out", type=Path, help="only write the long map there: a process of its own does that")
    options = parser.parse_args()
    copies = int(np.ceil(1e3 * max(options.km) / PERIOD_M)) + 1
    street = read_map(options.map)
    if options.lay_out is not None:
        write_map(laid_end_to_end(street, copies), options.lay_out)
        return
    drive = open_drive(options.folder / "v1")
    load_kernels(drive, street)
    del street
    give_back_free_pages()
    with tempfile.TemporaryDirectory() as folder:
        long_map = Path(folder) / "map"
        subprocess.run([sys.executable, *sys.argv, "--lay-out", str(long_map)], check=True)
        measure(drive, read_map(long_map, sizes=ReadSizes(kept_points=1 << 40)), sorted(options.km), copies)


if __name__ == "__main__":
    main()
