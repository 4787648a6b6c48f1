"""Description of a file: a title and rows of text for a map, a drive or a ballot."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mapvote.codec.ballot import Ballot, decode, unpack_points, unpack_states
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.point_map import SOURCES, PointMap
from mapvote.core.sensor_height import check_heights
from mapvote.core.times import utc
from mapvote.core.types import CellState, Drive, MapvoteError, Scan
from mapvote.formats import open_drive, read_map
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.mapvote_folder import is_map_folder
from mapvote.formats.maps.marked_points import without_marked
from mapvote.formats.maps.tiling import in_map_metres, map_of
from mapvote.formats.registry import DRIVES, MAPS

Rows = list[tuple[str, str]]


def describe(path: Path, *, rate_hz: float | None = None, topic: str | None = None) -> tuple[str, Rows]:
    """(title, rows of name and value) of whatever lies at ``path``; MapvoteError if it is nothing of ours."""
    if is_map_folder(path):
        return "mapvote map", _map(read_map(path))
    for kind, layout in MAPS.items():
        if layout.recognised(path):
            about: dict[str, dict[str, None]] = {"other fields": {}, "stored as": {}}
            point_map = map_of(
                str(path), in_map_metres(str(path), _noted(without_marked(path, layout.stream(path)), about))
            )
            return kind, _map(point_map) + [(name, ", ".join(names) or "none") for name, names in about.items()]
    for kind, drive_layout in DRIVES.items():
        if drive_layout.recognised(path):
            return f"drive, {kind}", _drive(open_drive(path, rate_hz=rate_hz, topic=topic))
    if path.is_file():
        data = path.read_bytes()
        try:
            return "ballot", _ballot(decode(data), len(data))
        except MapvoteError as error:
            raise MapvoteError(f"{path}: neither map nor drive, and no ballot: {error}") from error
    return "", _map(read_map(path))  # raises, and names the files there


def _noted(pieces: Iterator[Cloud], about: dict[str, dict[str, None]]) -> Iterator[Cloud]:
    for piece in pieces:
        about["other fields"] |= dict.fromkeys(piece.dropped)
        about["stored as"] |= {str(piece.points.dtype): None}
        yield piece


def _map(point_map: PointMap) -> Rows:
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    known_share = 0.0
    learned = 0
    fields: dict[str, str] = {}
    for tile in point_map.tiles.values():
        low = np.minimum(low, tile.points_map.min(axis=0, initial=np.inf))
        high = np.maximum(high, tile.points_map.max(axis=0, initial=-np.inf))
        known_share += float(np.isfinite(tile.ground_z).mean()) / len(point_map.tiles)
        learned += tile.free is not None
        fields |= {name: f"{name} ({column.dtype})" for name, column in tile.fields.items()}
    rows = [
        ("map id", point_map.map_id),
        ("version", str(point_map.version or "unknown")),
        ("points", f"{point_map.n_points:,}"),
        ("tiles", f"{len(point_map.tiles)} of {TILE_CELLS * CELL_SIZE:.1f} m"),
        ("x", f"{low[0]:.2f} to {high[0]:.2f} m"),
        ("y", f"{low[1]:.2f} to {high[1]:.2f} m"),
        ("z", f"{low[2]:.2f} to {high[2]:.2f} m"),
        ("lattice", f"cells of {CELL_SIZE} m from ({point_map.lattice.x0}, {point_map.lattice.y0})"),
        ("ground", f"known in {known_share:.0%} of the tiles' cells"),
        ("fields", ", ".join(fields.values()) or "none"),
        ("known free", f"learned in {learned} tiles" if learned else "never learned"),
    ]
    rows += _sources(point_map)
    rows += [(f"drive {k}", str(check_heights(point_map, path))) for k, path in enumerate(point_map.driven, 1)]
    return rows + [(f"georeference: {name}", text.strip()) for name, text in point_map.georeference.items()]


def _sources(point_map: PointMap) -> Rows:
    """Points of a merged map by the map that they came from, in the order in which the maps were given to merge."""
    columns = [tile.fields[SOURCES] for tile in point_map.tiles.values() if SOURCES in tile.fields]
    if not columns:
        return []
    sources = np.concatenate(columns)
    maps = range(int(np.bitwise_or.reduce(sources)).bit_length())
    alone = [int((sources == np.uint64(1) << np.uint64(k)).sum()) for k in maps]
    in_each = [int((sources >> np.uint64(k) & np.uint64(1)).sum()) for k in maps]
    rows = [(f"source map {k + 1}", f"{in_each[k]:,} points, {alone[k]:,} of them in no other") for k in maps]
    return [*rows, ("since the merge", f"{int((sources == 0).sum()):,} points")]


def _drive(drive: Drive) -> Rows:
    seconds = (drive.stamps_ns[-1] - drive.stamps_ns[0]) * 1e-9
    start = utc(int(drive.stamps_ns[0]))
    first = drive.read_scan(0)
    T = drive.T_map_lidar_prior
    rows = [
        ("vehicle", drive.vehicle),
        ("drive", drive.drive_id),
        ("sensor", f"{drive.sensor.name}, {drive.sensor.beams} beams, {drive.sensor.rate_hz:g} Hz"),
        ("sensor is", drive.sensor_told),
        ("scans", f"{len(drive)} in {seconds:.1f} s, the first with {len(first.points):,} points"),
        ("starts", start if start >= "1991" else "time of day unknown"),
        ("point times", _times(first)),
        ("mounted at", ", ".join(f"{v:.2f}" for v in drive.T_base_lidar[:3, 3]) + " m (T_base_lidar)"),
    ]
    if T is None:
        return [*rows, ("prior", "none")]
    length_m = float(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum())
    about = f"{length_m:.0f} m driven, sigma {drive.prior_sigma_m:g} m and {drive.prior_sigma_deg:g} deg"
    ends = " to ".join("({:.1f}, {:.1f}, {:.1f})".format(*T[i, :3, 3]) for i in (0, -1))
    return [*rows, ("prior", about), ("from", ends)]


def _times(scan: Scan) -> str:
    """How the times of the points are known."""
    origin = "" if scan.times is None else f" ({scan.times.told})"
    return f"none: taken as motion-compensated{origin}" if scan.time_s is None else f"yes: scans are de-skewed{origin}"


def _foundation(ballot: Ballot) -> str:
    if ballot.length_m is None:
        return "unknown"
    misfit = "no prior"
    if ballot.prior_misfit_m is not None and ballot.prior_sigma_m is not None:
        misfit = f"{ballot.prior_misfit_m:.2f} m off its prior (median), which claims {ballot.prior_sigma_m:.2f} m"
    return f"{ballot.length_m:.0f} m driven, {ballot.scans_localised / max(ballot.scans, 1):.0%} of scans, {misfit}"


def _ballot(ballot: Ballot, size: int) -> Rows:
    counts = np.zeros(len(CellState), dtype=np.int64)
    for tile in ballot.tiles:
        if tile.states is not None:
            counts += np.bincount(unpack_states(tile.states).ravel(), minlength=256)[: len(CellState)]
    new = sum(len(unpack_points(t.new_points)) for t in ballot.tiles if t.new_points is not None)
    names = ("states", "tally", "gone", "free", "new_points", "odds")
    planes = [name for name in names if any(getattr(t, name) for t in ballot.tiles)]
    seconds = (ballot.end_ns - ballot.start_ns) * 1e-9
    rows = [
        ("vehicle", ballot.vehicle),
        ("drive", f"{ballot.drive}, {seconds:.1f} s"),
        ("map id", ballot.map_id),
        ("version", str(ballot.version or "unknown")),
        ("method", f"{ballot.method}, settings {ballot.settings_hash[:16]}"),
        ("scans", f"{ballot.scans_localised} of {ballot.scans} voted, median sigma {ballot.median_sigma_m:.3f} m"),
        ("founded on", _foundation(ballot)),
        ("tiles", str(len(ballot.tiles))),
        ("planes", ", ".join(planes)),
        ("new points", f"{new:,}"),
        ("size", f"{size:,} bytes"),
    ]
    states = [(s.name.lower().replace("_", " "), f"{counts[s]:,} cells") for s in CellState]
    return rows + (states if any(t.states is not None for t in ballot.tiles) else [("votes", "undecided tally")])
