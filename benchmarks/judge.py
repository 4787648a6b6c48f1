"""Every scan of a drive through our vehicle and through what people use today, in turn, on one pinned core.

    python benchmarks/judge.py OUT --street street:2 --street street:2:hdl64e --kitti ../shared/data/kitti/*  [--last N]

Writes OUT/judge.json and the table OUT/judge.md; drives and maps are kept in OUT. Times are
CPU time, so that a busy neighbour counts little. Ours is everything that ``Vehicle.observe`` does, moving windows and
first looks included; the peers' side is in judge_peers.py. A first drive compiles; of the judged one the first
WARM_UP scans do not count. Quality comes from the same run: poses against the truth (each trajectory laid on it as a
whole), moving points and, per cell, changes. Simulated drives have all three, KITTI poses only: its map is made of
every second scan, its poses.txt is odometry.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from judge_peers import CloudToCloud, Dufomap, Vgicp
from mapvote.config import Settings
from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.types import F64, U64, Bool, Drive
from mapvote.detection.voter import Voter
from mapvote.formats import open_drive, read_map, read_T_map_lidar, write_map
from mapvote.localisation.prepare import deskew, motion_at
from mapvote.perception.frontend import Observation
from mapvote.slam.build import build_map
from mapvote.vehicle import Vehicle
from mapvote_lab.evaluation.baselines import heights_above_ground
from mapvote_lab.evaluation.experiments.cases import ballot_states
from mapvote_lab.evaluation.scores import score_cells
from mapvote_lab.evaluation.truths import Truth, error_summary, lay_on, read_truth, rigid_between
from mapvote_lab.simulation import simulate


@dataclass(frozen=True)
class Street:
    """A map, a drive through it, and what is true."""

    name: str
    point_map: PointMap
    drive: Drive
    T_true: F64
    truth: Truth | None


def simulated(out: Path, scene: str) -> Street:
    """``SCENARIO:SEED[:SENSOR]``; a folder of drives in OUT is used again."""
    scenario, seed, *sensor = scene.split(":")
    folder = out / scene.replace(":", "_")
    if not folder.exists():
        simulate(scenario, folder, int(seed), overrides={"sensor": sensor[0]} if sensor else {})
    point_map = _map(out, folder.name, sorted(folder.glob("survey_*")), None)
    T_true = read_T_map_lidar(folder / "truth" / "v1" / "poses.txt", folder / "v1")
    return Street(scene, point_map, open_drive(folder / "v1"), T_true, read_truth(folder))


def recorded(out: Path, folder: Path) -> Street:
    """A KITTI drive: the map is made of every second scan."""
    point_map = _map(out, folder.name, [folder], "::2")
    T_true = read_T_map_lidar(folder / "poses.txt", folder)
    return Street(f"KITTI {folder.name[-4:]}", point_map, open_drive(folder), T_true, None)


def _map(out: Path, name: str, surveys: list[Path], scans: str | None) -> PointMap:
    path = out / f"map_{name}"
    if not path.exists():
        write_map(build_map([open_drive(survey, scans=scans) for survey in surveys])[0], path)
    return read_map(path)


WARM_UP = 25
"""Scans: the first leaves for the voter after some fifteen."""
LOOK_AHEAD = 10
"""Scans in a second: how late both sides say what moves."""
STAGES = {
    "localise": ("localise",),
    "ground": ("ground",),
    "moving": ("moving",),
    "see + vote": ("see", "vote"),
}
WHOLE = "whole scan"


class Watched:
    """A voter that also keeps what the filter said."""

    def __init__(self, voter: Voter) -> None:
        self.voter, self.seen = voter, {}

    def observe(self, seen: Observation) -> U64:
        self.seen[seen.scan.index] = np.packbits(seen.moving), np.packbits(seen.scan.obstacle)
        return self.voter.observe(seen)

    def votes(self) -> Any:
        return self.voter.votes()

    def each(self) -> Any:
        return self.voter.each()


def judge(street: Street, last: int | None) -> dict[str, Any]:
    """{"ours": .., "peers": ..}: by stage milliseconds (median, mean, worst), and the quality."""
    count = min(len(street.drive), last or len(street.drive))
    vehicle = _vehicle(street)
    for i in range(min(count, WARM_UP)):
        vehicle.observe(*_scan(street, i))
    vehicle.finish()  # so that what comes last is compiled too
    vehicle, ms = _vehicle(street), defaultdict(lambda: np.zeros(count))
    watched = vehicle._voter = Watched(vehicle._voter)
    points_map = all_points(street.point_map)
    vgicp, dufo = Vgicp(points_map, street.T_true), Dufomap(LOOK_AHEAD)
    above = heights_above_ground(street.point_map, points_map) > GROUND_MARGIN_M
    grid = None if street.truth is None else street.truth.grid_on(street.point_map.lattice)
    half = 0.5 * vehicle.settings.voting.window_m
    clouds = CloudToCloud(points_map[above], grid or _around(street), half)
    for i in range(count):
        ours = lambda i=i: _ours(vehicle, street, i, ms)  # noqa: E731
        theirs = lambda i=i: _theirs(street, i, ms, (vgicp, dufo, clouds))  # noqa: E731
        for turn in (ours, theirs) if i % 2 else (theirs, ours):
            turn()
    vehicle.finish()
    dufo.finish()
    return {
        "ours": _times(ms, "ours") | _quality_of_ours(street, vehicle, watched, grid),
        "peers": _times(ms, "peers") | _quality_of_peers(street, vgicp, dufo, clouds, watched, grid),
        "scans": count,
        "points": int(np.mean([len(street.drive.read_scan(i).points) for i in range(0, count, 10)])),
    }


def _vehicle(street: Street) -> Vehicle:
    drive = street.drive
    sigmas = {"prior_sigma_m": drive.prior_sigma_m, "prior_sigma_deg": drive.prior_sigma_deg}
    return Vehicle(drive.vehicle, drive.sensor, street.point_map, Settings(), **sigmas)


def _scan(street: Street, i: int) -> tuple[Any, F64 | None]:
    prior = street.drive.T_map_lidar_prior
    return street.drive.read_scan(i), None if prior is None else prior[i]


def _around(street: Street) -> Any:
    first = next(iter(street.point_map.tiles.values())).window
    for tile in street.point_map.tiles.values():
        first = first.union(tile.window)
    return first


def _ours(vehicle: Vehicle, street: Street, i: int, ms: Any) -> None:
    stages = vehicle.report.stage_s
    before = {name: (len(s), sum(s)) for name, s in stages.items()}
    start = time.process_time()
    scan = _scan(street, i)
    read = time.process_time()
    vehicle.observe(*scan)
    ms["ours", WHOLE][i] = 1e3 * (time.process_time() - read)
    ms["ours", "read"][i] = 1e3 * (read - start)
    for name, parts in STAGES.items():
        ms["ours", name][i] = 1e3 * sum(sum(stages.get(p, [])[before.get(p, (0, 0))[0] :]) for p in parts)


def _theirs(street: Street, i: int, ms: Any, chain: tuple[Vgicp, Dufomap, CloudToCloud]) -> None:
    def clock(stage: str, work: Callable[[], Any]) -> Any:
        start = time.process_time()
        out = work()
        took = 1e3 * (time.process_time() - start)
        ms["peers", stage][i] += took
        ms["peers", WHOLE][i] += took
        return out

    scan = street.drive.read_scan(i)
    points = deskew(scan, motion_at(street.drive.stamps_ns, street.T_true, i))
    T = chain[0](points, clock)
    chain[1](points, T, clock)
    chain[2](points, T, clock)


def _times(ms: Any, side: str) -> dict[str, Any]:
    of = {name: all_[WARM_UP:] for (who, name), all_ in ms.items() if who == side}
    return {
        "ms": {n: {"median": np.median(v), "mean": v.mean(), "worst": v.max()} for n, v in of.items()},
        "each_ms": {n: v.round(3).tolist() for n, v in of.items()},
    }


def _quality_of_ours(street: Street, vehicle: Vehicle, watched: Watched, grid: Any) -> dict[str, Any]:
    out = {"poses": _poses(street, np.array(vehicle.report.T_map_lidar)), "lost": len(vehicle.report.lost)}
    if street.truth is not None:
        masks = {i: moving for i, (moving, _) in watched.seen.items()}
        out["movers"] = _movers(street, watched, lambda i, n: np.unpackbits(masks[i])[:n].astype(bool))
        states, window = ballot_states(vehicle.ballot(), street.point_map)
        out["changes"] = _changes(street.truth, lay_on(states, window, grid))
    return out


def _quality_of_peers(
    street: Street, vgicp: Vgicp, dufo: Dufomap, clouds: CloudToCloud, watched: Watched, grid: Any
) -> dict[str, Any]:
    out = {"poses": _poses(street, np.array(vgicp.poses)), "lost": vgicp.lost}
    if street.truth is not None:
        out["movers"] = _movers(street, watched, lambda i, n: dufo.masks[i])
        states = clouds.states(lambda points: heights_above_ground(street.point_map, points) > GROUND_MARGIN_M)
        out["changes"] = _changes(street.truth, states)
    return out


def _poses(street: Street, T_found: F64) -> dict[str, float]:
    true = street.T_true[: len(T_found)]
    errors = error_summary(T_found, rigid_between(T_found, true) @ true)
    return {"median_m": errors.median_m, "p99_m": errors.p99_m, "max_m": errors.max_m}


def _movers(street: Street, watched: Watched, found: Callable[[int, int], Bool]) -> dict[str, float]:
    """Precision and recall per point above ground, over the scans that we saw."""
    right = said = true = 0
    for i, (_, obstacle) in watched.seen.items():
        label = street.truth.moving(street.drive.vehicle, i)
        above = np.unpackbits(obstacle)[: len(label)].astype(bool)
        moving = found(i, len(label)) & above
        right, said, true = (
            right + int((moving & label).sum()),
            said + int(moving.sum()),
            true + int((label & above).sum()),
        )
    return {"precision": right / max(said, 1), "recall": right / max(true, 1)}


def _changes(truth: Truth, states: Any) -> dict[str, float]:
    f1 = score_cells(states, truth.strict).f1
    return {"occupied_f1": f1.changed_occupied, "empty_f1": f1.changed_empty}


PEERS = {"localise": "VGICP", "moving": "dufomap", "see + vote": "cloud-to-cloud", WHOLE: "the three"}


def table(results: dict[str, Any]) -> str:
    """Markdown: times and ratios by street and stage, then the quality of both sides."""
    lines = [
        "| street | stage | ours, ms: median / mean / worst | peer | median / mean / worst | times, medians / means |",
        "|---|---|---|---|---|---|",
    ]
    for name, result in results.items():
        ours, peers = result["ours"]["ms"], result["peers"]["ms"]
        for stage in ("read", *STAGES, WHOLE):
            row = f"| {name} | {stage} | {_three(ours[stage])} "
            if stage in peers:
                ratios = [peers[stage][k] / ours[stage][k] for k in ("median", "mean")]
                row += f"| {PEERS[stage]} | {_three(peers[stage])} | **{ratios[0]:.1f} / {ratios[1]:.1f}** |"
            lines.append(row if stage in peers else row + "| | | |")
        spike = ours[WHOLE]["worst"] / ours[WHOLE]["median"]
        lines.append(f"| {name} | worst over median | {spike:.1f} | | | |")
    lines += [
        "",
        "| street | side | poses, m: median / 99 % / most | lost | movers P / R | new F1 | gone F1 |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, result in results.items():
        lines += [_quality(name, side, result[side]) for side in ("ours", "peers")]
    return "\n".join(lines) + "\n"


def _three(ms: dict[str, float]) -> str:
    return f"{ms['median']:.2f} / {ms['mean']:.2f} / {ms['worst']:.1f}"


def _quality(name: str, side: str, of: dict[str, Any]) -> str:
    p, m, c = of["poses"], of.get("movers"), of.get("changes")
    row = f"| {name} | {side} | {p['median_m']:.4f} / {p['p99_m']:.4f} / {p['max_m']:.4f} | {of['lost']} "
    row += f"| {m['precision']:.4f} / {m['recall']:.4f} " if m else "| - "
    return row + (f"| {c['occupied_f1']:.3f} | {c['empty_f1']:.3f} |" if c else "| - | - |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--street", action="append", default=[], metavar="SCENARIO:SEED[:SENSOR]")
    parser.add_argument("--kitti", type=Path, nargs="*", default=[], metavar="DRIVE")
    parser.add_argument("--last", type=int, metavar="N", help="stop each drive after so many scans")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    results: dict[str, Any] = {}
    for scene in options.street:
        results[scene] = judge(simulated(options.out, scene), options.last)
    for folder in options.kitti:
        street = recorded(options.out, folder)
        results[street.name] = judge(street, options.last)
    (options.out / "judge.json").write_text(json.dumps(results, indent=1) + "\n")
    (options.out / "judge.md").write_text(table(results))
    print(table(results))


if __name__ == "__main__":
    main()
