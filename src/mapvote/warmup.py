"""Compile every kernel that a vehicle and the map's update need, by doing once what they do, on a street of no size.

Compiled kernels stay in numba's cache: beside the program, where that is read-only in the user's own cache, and where
there is none in a temporary folder (or in ``NUMBA_CACHE_DIR``), so that later runs start at once.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

import mapvote
from mapvote.codec.ballot import Ballot, decode, encode
from mapvote.config import Settings, choose_case
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.grid import TILE_CELLS, Lattice
from mapvote.core.kernel import cached_for
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.process_memory import give_back_free_pages, seldom_collecting
from mapvote.core.record import record
from mapvote.core.rule import RULES
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, F64, Drive, Scan, read_only
from mapvote.core.voxels import VoxelCloud
from mapvote.doctor.map_points import check_cloud, in_memory
from mapvote.doctor.scans import Looking
from mapvote.formats.drives.point_fields import PointReader, spinning_time_s
from mapvote.formats.maps.cloud import xyz_view
from mapvote.fusion.fuse import update_map
from mapvote.fusion.gravity import Remains, fall_within
from mapvote.matching.global_search import GlobalSearch
from mapvote.matching.localiser import GivenPoses
from mapvote.matching.ndt import align
from mapvote.survey.build import build_map
from mapvote.vehicle import vote_drive


@record()
@dataclass(frozen=True, slots=True)
class WarmupStreet:
    """Size of the street on which every kernel is compiled."""

    scans: int = 14
    """Scans of the drive."""
    step_m: float = 0.8
    """Distance between two scans, metres."""
    spacing_m: float = 0.35
    """Distance between points of the street, metres."""


WARMUP_STREET = WarmupStreet()


def warm_vehicle(settings: Settings) -> None:
    """Load the kernels of a vehicle's first scans: of live ones none is to wait for them."""
    vote_drive(_drive(_street(demolished=True), turning=True), map_from_points(_street(demolished=False)), settings)
    give_back_free_pages()


def warm_up() -> Iterator[tuple[str, float]]:
    """(name of the step, its CPU seconds), step by step. With all kernels in the cache it takes seconds."""
    old = _street(demolished=False)
    new = _street(demolished=True)
    settings = Settings()
    built: list[PointMap] = []
    ballots: list[Ballot] = []

    def vote(case: str) -> Callable[[], object]:
        drive = _drive(new, turning=case == "surfaces")
        return lambda: ballots.append(vote_drive(drive, built[0], choose_case(settings, case))[0])

    steps: list[tuple[str, Callable[[], object]]] = [
        ("a map cut into tiles, its ground", lambda: map_from_points(old)),
        ("a map built by SLAM", lambda: built.append(build_map([_drive(old, turning=True)], settings)[0])),
        ("a drive that votes by surfaces", vote("surfaces")),
        ("a drive that votes by the paper's rule", vote("5")),
        ("ballots sent and fused", lambda: _fuse(built[0], ballots, settings)),
        ("what falls with a demolished object", _let_fall),
        ("a map searched, a drive looked at, what a long one needs", lambda: _go_far(_drive(old, True), built[0])),
    ]
    with seldom_collecting():
        for step, work in steps:
            start = time.process_time()
            work()
            yield step, time.process_time() - start


def compiled_mark() -> Path:
    """The file that stands beside the kernels once the two functions below have compiled all that they do.

    Its name holds what numba asks before it takes a kernel from its cache: the times and sizes of the program's files,
    numba, Python and the processor. If some of the kernels are taken away, but not the mark, a later run waits for
    them where it needs them.
    """
    folder, compiled_for = cached_for(align)
    sources = Path(mapvote.__file__).parent
    digest = hashlib.sha256(compiled_for.encode())
    for file in sorted(sources.rglob("*.py")):
        written = file.stat()
        digest.update(f"{file.relative_to(sources)} {written.st_mtime_ns} {written.st_size}\n".encode())
    return folder / f"compiled-{digest.hexdigest()[:16]}"


def leave_mark() -> None:
    """Say that all kernels are compiled, for the next run. Where nothing can be written, that run looks itself."""
    mark = compiled_mark()
    with suppress(OSError):
        for outdated in mark.parent.glob("compiled-*"):
            outdated.unlink()
        mark.touch()


def compile_for_maps() -> None:
    """Compile what a map that is built by SLAM and a vehicle that localises in it need. Falling bodies come first:
    beside :func:`compile_for_votes` in another process the voters, which both need, are in the cache after that."""
    with seldom_collecting():
        _let_fall()
        point_map = build_map([_drive(_street(demolished=False), turning=True)], Settings())[0]
        vote_drive(_drive(_street(demolished=True), turning=True), point_map, Settings())


def compile_for_votes() -> None:
    """Compile what a drive that votes at given poses and the fusion need."""
    with seldom_collecting():
        point_map = map_from_points(_street(demolished=False))
        drive = _drive(_street(demolished=True), turning=True)
        assert drive.T_map_lidar_prior is not None
        given = GivenPoses(drive.stamps_ns, drive.T_map_lidar_prior)
        by_case = [choose_case(Settings(), rule) for rule in RULES]
        ballots = [vote_drive(drive, point_map, settings, localise=given)[0] for settings in by_case]
        _fuse(point_map, ballots, Settings())


def _fuse(point_map: PointMap, ballots: list[Ballot], settings: Settings) -> None:
    """Each method's ballots on their own: one round never mixes them. Three voters, so that they are compared: first
    as copies of each other, then as three that happen to say the same."""
    for ballot in ballots:
        same = [decode(encode(structs.replace(ballot, vehicle=name))) for name in ("a", "b", "c")]
        for least in (settings.fuse.min_difference, 0.0):
            update_map(point_map, same, settings.fuse.model_copy(update={"min_difference": least}))


def _let_fall() -> None:
    """Compile what falls inside a demolished object: a block of 5 m, of which a voxel of the roof remains."""
    planes = {name: np.zeros((TILE_CELLS, TILE_CELLS), np.uint64) for name in ("rest", "holds", "deleted")}
    planes["deleted"][100:116, 100:116] = 0xFFFF
    planes["rest"][108, 108] = 1 << 20
    fall_within((0, 0), Remains(**planes, base=np.zeros((TILE_CELLS, TILE_CELLS), np.int32)))


def _go_far(drive: Drive, point_map: PointMap) -> None:
    """Compile the search for a vehicle that is lost; the checks of drive and map; points without times; more voxels
    than a table takes."""
    GlobalSearch(point_map, Settings().ndt, drive.sensor.range_sigma_m).find(drive.read_scan(0))
    Looking(drive).look(range(2))
    check_cloud(in_memory(drive.read_scan(0).points.astype(np.float64)))
    for columns in _FIELDS_OF_TABLES:
        spinning_time_s(xyz_view("warmup", _table(np.zeros((2, 3), np.float32), columns)), drive.sensor.rate_hz)
    VoxelCloud(Lattice()).enter(np.repeat(np.arange(40_000.0)[:, None], 3, axis=1))


def _street(demolished: bool) -> F64:
    """(n, 3) points of 50 m of road between two rows of houses; one may be gone, so that a wall behind it is seen, and
    something built on the road."""
    rng = np.random.default_rng(0)

    def surface(low: tuple[float, ...], high: tuple[float, ...]) -> F64:
        sides = np.subtract(high, low)
        n = int(np.prod(sides[sides > 0]) / WARMUP_STREET.spacing_m**2)
        return np.asarray(rng.uniform(low, high, (n, 3)) + rng.normal(0.0, 0.01, (n, 3)))

    pieces = [surface((-25, -11, 0), (25, 11, 0)), surface((-25, 18, 0), (25, 18, 6))]
    for x in (-24.0, -10.0, 4.0):
        for y in (-10.0, 10.0):
            if not (demolished and (x, y) == (-10.0, 10.0)):
                pieces += [
                    surface((x, y, 0), (x + 11, y, 6)),
                    surface((x, min(y, 1.4 * y), 0), (x, max(y, 1.4 * y), 6)),
                ]
    if demolished:
        pieces += [surface((8, 4, 0), (12, 4, 3)), surface((8, 4, 0), (8, 7, 3))]
    return np.concatenate(pieces)


_FIELDS_OF_TABLES = ("x", "y", "z"), ("x", "y", "z", "intensity")
"""Fields of tables of points. Numba compiles the kernels of a scan once for a contiguous array, and once for a
read-only view of rows, as readers of files pass them."""


def _table(points: F32, columns: tuple[str, ...]) -> NDArray[np.void]:
    """The points (n, 3) as a structured array (n,), read-only where they are rows of a file."""
    rows = np.column_stack([points, np.full((len(points), len(columns) - 3), 100.0, np.float32)])
    table = rows.view([(name, "<f4") for name in columns])[:, 0]
    return table if len(columns) == 3 else read_only(table)


def _drive(street_map: F64, turning: bool) -> Drive:
    """A drive along the street's middle; ``turning``: its points bring the times at which they were measured."""
    scans = WARMUP_STREET.scans
    x_m = WARMUP_STREET.step_m * (np.arange(scans) - scans / 2)
    poses = np.array([from_xyz_rpy(x, 0.3, 1.8, 0.0, 0.0, 0.01 * i) for i, x in enumerate(x_m)])
    stamps_ns = 10**9 + np.arange(scans, dtype=np.int64) * 10**8

    sensor = SENSORS["vlp16"]

    def read_scan(i: int) -> Scan:
        points = transform(inverse(poses[i]), street_map).astype(np.float32)
        points = points[np.hypot(points[:, 0], points[:, 1]) > 1.5]
        table = _table(points, _FIELDS_OF_TABLES[i % 2])
        scan = PointReader("warmup").scan("warmup", i, int(stamps_ns[i]), table, sensor)
        return replace(scan, time_s=np.zeros(len(scan.points), dtype=np.float32)) if turning else scan

    return Drive(Path("warmup"), "warmup", "warmup", sensor, stamps_ns, read_scan, poses, 0.02, 0.1)
