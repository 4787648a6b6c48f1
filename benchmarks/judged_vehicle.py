"""The vehicle of judge.py: one process for each checkout, so that any commit can be judged with its own dependencies.

    python benchmarks/judged_vehicle.py DRIVE MAP WARM_UP

It imports only names that every commit has had. For each number on stdin it takes one scan and prints its CPU
milliseconds by stage. A path ends it: the poses of all scans go to that file.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np

from mapvote.formats import open_drive, read_map
from mapvote.vehicle import Vehicle

STAGES = "localise", "ground", "moving", "see", "vote"


def watch(drive_path: str, map_path: str, warm_up: str) -> None:
    """Compile with the first scans, then answer each line."""
    drive, point_map = open_drive(drive_path), read_map(map_path)
    T = drive.T_map_lidar_prior

    def fresh() -> Vehicle:
        sigmas = {"prior_sigma_m": drive.prior_sigma_m, "prior_sigma_deg": drive.prior_sigma_deg}
        return Vehicle(drive.vehicle, drive.sensor, point_map, **sigmas)

    vehicle = fresh()
    for i in range(min(len(drive), int(warm_up))):
        vehicle.observe(drive.read_scan(i), None if T is None else T[i])
    vehicle.finish()  # so that what comes last is compiled too
    vehicle = fresh()
    print("ready", flush=True)
    for line in sys.stdin:
        if not line.strip().isdigit():
            vehicle.finish()
            np.save(line.strip(), np.array(vehicle.report.T_map_lidar))
            print(len(vehicle.report.lost), flush=True)
            return
        i, stages = int(line), vehicle.report.stage_s
        scan, before = drive.read_scan(i), {name: len(s) for name, s in stages.items()}
        start = time.process_time()
        vehicle.observe(scan, None if T is None else T[i])
        ms = {"whole scan": 1e3 * (time.process_time() - start)}
        ms |= {name: 1e3 * sum(stages.get(name, [])[before.get(name, 0) :]) for name in STAGES}
        print(json.dumps(ms), flush=True)


if __name__ == "__main__":
    watch(*sys.argv[1:])
