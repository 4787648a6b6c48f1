"""Every scan of a drive through our vehicle and through what people use today, in turn, on one pinned core.

    python benchmarks/judge.py OUT --street street:2 --street street:2:hdl64e --kitti ../shared/data/kitti/*  [--last N]

Writes OUT/judge.json, the table OUT/judge.md and the figure OUT/judge.png; drives and maps are kept in OUT. Times are
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
from pathlib import Path
from typing import Any

from judge_run import STAGES, WARM_UP, WHOLE, judge
from judge_streets import recorded, simulated
from mapvote.plots import GONE, STANDING, new_figure, save

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


def figure(results: dict[str, Any], path: Path) -> None:
    """CPU time of every scan, ours and the peers', on a logarithmic axis."""
    fig, axes = new_figure(9.0, 2.3 * len(results), rows=len(results))
    for ax, (name, result) in zip(axes[:, 0], results.items(), strict=True):
        for side, colour in (("peers", STANDING), ("ours", GONE)):
            ms = result[side]["each_ms"][WHOLE]
            ax.semilogy(range(WARM_UP, WARM_UP + len(ms)), ms, color=colour, label=side, linewidth=0.9)
        ax.set(title=f"{name}, {result['points'] / 1e3:.0f}k points a scan", ylabel="CPU ms a scan")
        ax.legend(loc="center right", frameon=False)
    axes[-1, 0].set_xlabel("scan")
    save(fig, path)


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
    figure(results, options.out / "judge.png")
    print(table(results))


if __name__ == "__main__":
    main()
