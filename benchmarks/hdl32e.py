"""The simulated HDL-32E beside real scans of one: elevations, lost returns, mixed pixels, noise.

    python benchmarks/hdl32e.py REAL_FOLDER SIMULATED_DRIVE

REAL_FOLDER: PCD scans with intensity (public repository cwchen1102/map_reconstruction, pcd/; no licence: local use
only). SIMULATED_DRIVE: a drive of `mapvote simulate`. Both go through the same measures. What a scan lacks is counted
between two returns of one beam that lie on one surface, so the sky counts for nothing.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, I64, Scan
from mapvote.formats import open_drive
from mapvote.formats.maps.pcd import read_pcd_table

_BANDS_M = ((2, 5), (5, 10), (10, 20), (20, 40), (40, 70))
_SAME_M = 0.3
"""Two returns of one beam this near in range lie on one surface."""
_EDGE_M = (0.6, 3.0)


class Beams(NamedTuple):
    """A scan by beam and firing: (beams, firings), NaN where nothing came back."""

    reach: F64
    intensity: F64
    elevation: F64
    step_deg: float
    """Between two firings."""


def by_beam(scan: Scan) -> Beams:
    sensor = SENSORS["hdl32e"]
    slopes = np.sort(np.radians(sensor.elevations_deg))
    points = scan.points.astype(np.float64)
    reach = np.linalg.norm(points, axis=1)
    elevation = np.arcsin(points[:, 2] / reach)
    ring: I64 = np.round(np.interp(elevation, slopes, np.arange(len(slopes)))).astype(np.int64)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    order = np.lexsort((azimuth, ring))
    ring, azimuth, reach, elevation = ring[order], azimuth[order], reach[order], elevation[order]
    gaps = np.diff(azimuth)[np.diff(ring) == 0]
    step_deg = float(np.mean(gaps[(gaps > 0.5 * np.median(gaps)) & (gaps < 1.5 * np.median(gaps))]))
    ahead = np.append(0, np.maximum(np.round(np.diff(azimuth) / step_deg), 1.0)).astype(np.int64)
    first = np.flatnonzero(np.diff(ring, prepend=-1))
    along = np.cumsum(ahead)
    col = along - np.repeat(along[first], np.diff(np.append(first, len(ring))))
    shape = sensor.beams, int(col.max()) + 1
    planes = [np.full(shape, np.nan) for _ in range(3)]
    level = np.zeros(len(ring)) if scan.intensity is None else scan.intensity[order]
    for plane, values in zip(planes, (reach, level, elevation), strict=True):
        plane[ring, col] = values
    return Beams(*planes, step_deg)


def real_scan(file: Path) -> Scan:
    """A PCD scan, without what the sensor says of its own mount (returns nearer than 1 m)."""
    table = read_pcd_table(file)
    points = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float32)
    near = np.isfinite(points).all(axis=1) & (np.linalg.norm(points, axis=1) > 1.0)
    return Scan(0, points[near], intensity=table["intensity"][near].astype(np.float32) / np.float32(255.0))


def measures(scans: list[Scan]) -> dict[str, str]:
    """What a table says of them."""
    beams = [by_beam(scan) for scan in scans]
    off_deg, spread_deg = _elevations(beams)
    told = {
        "points a scan": f"{np.mean([len(scan.points) for scan in scans]):.0f}",
        "azimuth step, deg": f"{np.mean([b.step_deg for b in beams]):.4f}",
        "beams off their elevation, deg (median, most)": off_deg,
        "spread within a beam, deg": spread_deg,
        "returns between returns that mix two surfaces, % of edges": f"{100 * _mixed(beams):.0f}",
    }
    for low, high in _BANDS_M:
        told[f"lost on one surface, {low} to {high} m, %"] = _percent(_lost(beams, low, high))
        told[f"range noise, {low} to {high} m, cm"] = f"{100 * _noise(beams, low, high):.1f}"
    bright = np.nanquantile(np.concatenate([b.intensity.ravel() for b in beams]), (0.1, 0.5))
    told["lost beside dark returns (darkest tenth), %"] = _percent(_lost(beams, 2, 70, (-1.0, bright[0])))
    told["lost beside bright returns (brighter half), %"] = _percent(_lost(beams, 2, 70, (bright[1], np.inf)))
    return told


def _percent(share: float) -> str:
    return "-" if np.isnan(share) else f"{100 * share:.1f}"


def _elevations(beams: list[Beams]) -> tuple[str, str]:
    found = np.degrees([np.nanmedian(b.elevation, axis=1) for b in beams])
    off = np.abs(np.nanmedian(found, axis=0) - np.sort(SENSORS["hdl32e"].elevations_deg))
    spread = np.nanmedian([np.nanstd(np.degrees(b.elevation), axis=1) for b in beams])
    return f"{np.nanmedian(off):.3f}, {np.nanmax(off):.3f}", f"{spread:.3f}"


def _lost(beams: list[Beams], low: float, high: float, bright: tuple[float, float] = (-np.inf, np.inf)) -> float:
    """Share of the firings between two returns on one surface that have none."""
    lost = asked = 0
    for b in beams:
        before, here, after = b.reach[:, :-2], b.reach[:, 1:-1], b.reach[:, 2:]
        level = b.intensity[:, :-2]
        one = (np.abs(before - after) < _SAME_M) & (before >= low) & (before < high)
        one &= (level >= bright[0]) & (level <= bright[1])
        asked += int(one.sum())
        lost += int((one & np.isnan(here)).sum())
    return lost / asked if asked else float("nan")


def _noise(beams: list[Beams], low: float, high: float) -> float:
    """Standard deviation of the range, robust, from second differences along a beam on one surface."""
    found = []
    for b in beams:
        before, here, after = b.reach[:, :-2], b.reach[:, 1:-1], b.reach[:, 2:]
        one = (np.abs(before - here) < _SAME_M) & (np.abs(here - after) < _SAME_M) & (here >= low) & (here < high)
        found.append((before - 2.0 * here + after)[one])
    bends = np.concatenate(found)
    return float(1.4826 * np.median(np.abs(bends - np.median(bends))) / np.sqrt(6.0)) if len(bends) else float("nan")


def _mixed(beams: list[Beams]) -> float:
    """Share of the edges (two firings apart, 0.6 to 3 m) whose firing between reports a range well between both."""
    mixed = edges = 0
    for b in beams:
        before, here, after = b.reach[:, :-2], b.reach[:, 1:-1], b.reach[:, 2:]
        step = np.abs(before - after)
        edge = (step > _EDGE_M[0]) & (step < _EDGE_M[1]) & ~np.isnan(here)
        share = (here - np.minimum(before, after)) / np.maximum(step, 1e-6)
        edges += int(edge.sum())
        mixed += int((edge & (share > 0.2) & (share < 0.8)).sum())
    return mixed / max(edges, 1)


def _spread(n: int, wanted: int) -> I64:
    """At most ``wanted`` of n, evenly."""
    return np.linspace(0, n - 1, min(wanted, n)).astype(np.int64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("real", type=Path)
    parser.add_argument("simulated", type=Path)
    parser.add_argument("--scans", type=int, default=33)
    said = parser.parse_args()
    files = sorted(said.real.glob("*.pcd"))
    drive = open_drive(said.simulated, prior="none")
    real = [real_scan(files[i]) for i in _spread(len(files), said.scans)]
    simulated = [drive.read_scan(int(i)) for i in _spread(len(drive), said.scans)]
    print(f"{len(real)} real scans, {len(simulated)} simulated ones")
    columns = [measures(real), measures(simulated)]
    print("| | real | simulated |\n|---|---|---|")
    for name, value in columns[0].items():
        print(f"| {name} | {value} | {columns[1][name]} |")


if __name__ == "__main__":
    main()
