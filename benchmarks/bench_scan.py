"""Milliseconds of a whole scan by stage: localise, ground, remove movers, see, classify and vote. One thread, warm.

    python benchmarks/bench_scan.py [SIMULATED_FOLDER] [--case surfaces]

SIMULATED_FOLDER is what ``mapvote simulate`` wrote; without one the scenario ``corner`` is simulated first. The map is
built by our SLAM from the surveys. The first vehicle drives twice: the first drive compiles the kernels and warms the
caches, the second is timed, in CPU time of its one thread, so that a busy neighbour does not count. A scan's total is
the sum of its stages; the second that the moving-object filter waits is latency, not work.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from mapvote.config import Settings, choose_case
from mapvote.core.point_map import PointMap
from mapvote.core.types import Drive
from mapvote.formats import open_drive
from mapvote.perception.frontend import DriveReport
from mapvote.slam.build import build_map
from mapvote.vehicle import vote_drive
from mapvote_lab.simulation import simulate

STAGES = ("localise", "ground", "moving", "see", "vote")


def timed(drive: Drive, point_map: PointMap, settings: Settings) -> DriveReport:
    vote_drive(drive, point_map, settings)
    return vote_drive(drive, point_map, settings)[1]


def table(report: DriveReport, points: float) -> str:
    """Median and 95th percentile by stage, and of the whole."""
    scans = min(len(report.stage_s[stage]) for stage in STAGES)  # lost ones end early, and the drive's end is one more
    whole = np.sum([report.stage_s[stage][:scans] for stage in STAGES], axis=0)
    rows = [(stage, np.array(report.stage_s[stage])) for stage in STAGES] + [("whole scan", whole)]
    lines = [f"{len(whole)} scans of {points:.0f} points, ms      median    95 %"]
    lines += [f"  {n:<36}{1e3 * np.median(s):>8.2f}{1e3 * np.percentile(s, 95):>8.2f}" for n, s in rows]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--case", default="surfaces", help="surfaces, or 1 to 5")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder
        if folder is None:
            folder = Path(scratch) / "corner"
            simulate("corner", folder)
        point_map, _ = build_map([open_drive(path) for path in sorted(folder.glob("survey_*"))])
        drive = open_drive(sorted(folder.glob("v[0-9]*"))[0])
        points = float(np.mean([len(drive.read_scan(i).points) for i in range(0, len(drive), 8)]))
        print(table(timed(drive, point_map, choose_case(Settings(), options.case)), points))


if __name__ == "__main__":
    main()
