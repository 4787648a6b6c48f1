"""The bench of a recorded drive: decisions where nothing changed, and the share of cast objects that are found."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from mapvote.config import Settings
from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.geometry import inverse, transform
from mapvote.core.grid import Grid
from mapvote.core.record import record
from mapvote.core.reference import LocalMap, reference_window
from mapvote.core.sensor_height import check_heights
from mapvote.core.types import F64, U8, Bool, CellState, Drive, MapvoteError
from mapvote.core.voxels import VoxelCloud
from mapvote.matching.localiser import GivenPoses
from mapvote.perception.placement import find_obstacles
from mapvote_lab.evaluation.cases import Case, Progress
from mapvote_lab.evaluation.cast_things import Site, Thing, with_things
from mapvote_lab.evaluation.real_street import (
    STREET_RULE,
    Edit,
    RealRun,
    Street,
    biased,
    disturbed,
    drifting,
    every_other_beam,
    in_rain,
    is_changed,
    late,
    lay_street,
    met_cells,
    of_another_street,
    open_recording,
    unedited,
    vote_on,
    with_fewer_points,
    without_prior,
)
from mapvote_lab.evaluation.scores import NEIGHBOURS, ratio


@record()
@dataclass(frozen=True, slots=True)
class BenchRule:
    """How the bench on a recorded street is laid out."""

    near_cells: int = 5
    """Precision is counted this close to the things, cells: over a whole street it depends on their number."""
    blocks: tuple[int, ...] = (12, 25)
    """Lengths of the blocks that make map and votes in turn, scans."""


BENCH_RULE = BenchRule()


@dataclass(frozen=True)
class Asked:
    """One thing in the cells of a run."""

    kind: str
    state: CellState
    cells: Bool
    """(rows, cols) that must be decided so: rays met it there, or had met it in the map's scans."""
    rays: float = 0.0
    """That met it, in the mean of the scans in which any did."""


Changed = tuple[RealRun, list[Asked]]
"""A run, and what it had to find."""


@dataclass(frozen=True, slots=True)
class FoundThings:
    """How much of one kind was found."""

    kind: str
    things: int
    """That a ray met in at least one cell."""
    half: int
    """Things at least half of whose cells were decided rightly."""
    touched: int
    """Things at or next to which a cell was decided rightly."""
    cell_recall: float
    """Share of all their cells."""
    rays: float
    """That met one of them in a scan, in the median."""


def survey_site(street: Street) -> Site:
    """The street as all scans of the recording show it, in the frame of the street's map."""
    drive = street.recording
    localise = GivenPoses(drive.stamps_ns, street.T_map_lidar)
    around = LocalMap(street.point_map, street.settings.voting.window_m)
    cloud = VoxelCloud(street.point_map.lattice)
    for scan in drive:
        [fix] = localise.push(scan, None)
        T = fix.registration.T_map_lidar
        points = transform(T, fix.points)
        cloud.enter(points, ~find_obstacles(points, around.at(T[:3, 3])[0])[0])
    reference = reference_window(street.point_map, street.grid)

    def ground(xy: F64) -> F64:
        return street.grid.value_at(reference.ground_z, xy, np.nan).astype(np.float64)

    return Site(cloud.points()[0], ground, street.T_map_lidar[:, :3, 3])


def among(things: Sequence[Thing], street: Street) -> Edit:
    """Scans recorded among ``things``, which lie in the frame of the street's map."""
    return lambda recording: with_things(recording, things, street.T_map_lidar)


def new_things(
    street: Street, site: Site, cases: Sequence[Case], seed: int, each: int
) -> tuple[RealRun, list[Asked], list[Thing]]:
    """The vehicles find ``each`` new things of every kind that needs no hedge, and nothing else has changed."""
    things = [thing for thing in site.placed(seed, each)[0] if thing.kind != "wall behind a hedge"]
    run = vote_on(street, cases, edit=among(things, street))
    return run, [_new(street, thing) for thing in things], things


def built(street: Street, site: Site, cases: Sequence[Case], seed: int, each: int) -> Iterator[Changed]:
    """The vehicles find new things, walls moved by half a metre, and parked cars gone; hedges stood before, too.

    Then the same vehicles in rain. They are asked for the same cells, those that dry scans show.
    """
    things, hedges = site.placed(seed, each)
    standing = [Thing("hedge", triangles) for triangles in hedges]
    moved = site.moved_walls(seed, 2 * each)
    gone = site.gone_cars(each)
    if hedges:
        street = lay_street(
            street.recording, street.settings, street.T_map_lidar, block=street.block,
            survey_edit=among(standing, street),
        )  # fmt: skip
    after = among([*standing, *things, *moved, *gone], street)
    dry = vote_on(street, cases, edit=after)
    bodies = [_new(street, thing) for thing in [*things, *moved]]
    still = met_cells(street, after)
    left = [thing for thing in [*moved, *gone] if thing.kind != "wall set forward"]
    bodies += [_gone(street, thing, thing.left, still) for thing in left]
    yield dry, bodies
    rain = in_rain(STREET_RULE.rain_share)  # over the cast things too: drops hide them as they hide the street
    yield vote_on(street, cases, edit=lambda recording: rain(after(recording))), bodies


def demolished(street: Street, site: Site, cases: Sequence[Case], seed: int, each: int) -> Iterator[Changed]:
    """The map was made among things that the vehicles do not find any more."""
    things = [thing for thing in site.placed(seed + 100, each)[0] if thing.kind != "wall behind a hedge"]
    before = lay_street(
        street.recording, street.settings, street.T_map_lidar, block=street.block, survey_edit=among(things, street)
    )
    T_map_old = before.T_map_lidar[0] @ inverse(street.T_map_lidar[0])
    still = met_cells(before)
    bodies = [_gone(before, thing, [transform(T_map_old, p) for p in thing.met], still) for thing in things]
    yield vote_on(before, cases), bodies


def _new(street: Street, thing: Thing) -> Asked:
    kind = f"{thing.kind}, new side" if thing.goes is not None else f"{thing.kind} built"
    return Asked(kind, CellState.CHANGED_OCCUPIED, _cells(street, thing.met) & ~street.mapped, _rays(thing.met))


def _gone(street: Street, thing: Thing, points: Sequence[F64], still: Bool) -> Asked:
    """Cells of objects that stood at ``points``, without the cells in which something stands ``still`` (rows, cols)."""
    kind = thing.kind if thing.goes is not None else f"{thing.kind} gone"
    kind = f"{kind}, old side" if thing.goes is not None and len(thing.comes) else kind
    return Asked(kind, CellState.CHANGED_EMPTY, _cells(street, points) & street.mapped & ~still, _rays(points))


def _rays(clouds: Sequence[F64]) -> float:
    return float(np.mean([len(points) for points in clouds if len(points)] or [0]))


def _cells(street: Street, clouds: Sequence[F64]) -> Bool:
    """Cells with points (m, 3) above the street's ground."""
    out = np.zeros(street.grid.shape, dtype=np.bool_)
    reference = reference_window(street.point_map, street.grid)
    for points in clouds:
        rows, cols, inside = street.grid.indices_of(points)
        rows = rows[inside]
        cols = cols[inside]
        z = points[inside, 2]
        high = z - reference.ground_z[rows, cols] >= GROUND_MARGIN_M
        out[rows[high], cols[high]] = True
    return out


def score(bodies: Sequence[Asked], states: U8) -> list[FoundThings]:
    """Outcome of the ``states`` (rows, cols) for the objects, by kind in the order in which they were asked."""
    out = []
    for kind in dict.fromkeys(a.kind for a in bodies):
        these = [a for a in bodies if a.kind == kind and a.cells.any()]
        right = [np.count_nonzero((states == a.state) & a.cells) for a in these]
        size = [np.count_nonzero(a.cells) for a in these]
        near = [ndimage.binary_dilation(a.cells, NEIGHBOURS) & (states == a.state) for a in these]
        half = sum(bool(2 * r >= n) for r, n in zip(right, size, strict=True))
        touched = sum(bool(n.any()) for n in near)
        rays = float(np.median([a.rays for a in these] or [0]))
        out.append(FoundThings(kind, len(these), half, touched, ratio(sum(right), sum(size)), rays))
    return out


def precision_near(bodies: Sequence[Asked], states: U8, grid: Grid, near_cells: int = BENCH_RULE.near_cells) -> float:
    """Share of the cells decided changed within ``near_cells`` of the things that are, or lie next to, cells so
    changed."""
    near = np.zeros(grid.shape, dtype=np.bool_)
    right = np.zeros(grid.shape, dtype=np.bool_)
    for a in bodies:
        near |= ndimage.binary_dilation(a.cells, NEIGHBOURS, iterations=near_cells)
        right |= ndimage.binary_dilation(a.cells, NEIGHBOURS) & (states == a.state)
    return ratio(np.count_nonzero(right), np.count_nonzero(is_changed(states) & near))


def _rain() -> str:
    return f"rain, {100 * STREET_RULE.rain_share:g} % of the rays"


class ChangedRun(StrEnum):
    """Runs in which something changed."""

    BUILT = "built"
    BUILT_IN_RAIN = f"built in {_rain()}"
    DEMOLISHED = "demolished"


@dataclass(frozen=True)
class Ground:
    """Path against ground in the map of every other block, under the whole recording."""

    sensor_height_m: float
    worst_off_m: float
    off_share: float
    occupied_share: float
    """Share of the cells under the driven line in which the map holds an obstacle, at any height."""


@dataclass
class Bench:
    """Everything that was measured on one drive."""

    name: str
    scans: int
    ground: Ground
    runs: dict[str, RealRun] = field(default_factory=dict)
    """Nothing changed in any of them."""
    changed: dict[str, Changed] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    """Run: why it could not be made on this drive."""

    def figures(self, case: str) -> dict[str, Any]:
        """All of it as numbers, by ``case``."""
        return {
            "drive": self.name,
            "scans": self.scans,
            "ground": {k: v if np.isfinite(v) else None for k, v in asdict(self.ground).items()},
            "unchanged": {name: run.figures(case) for name, run in self.runs.items()},
            "changed": {
                name: {
                    "precision_near": precision_near(bodies, run.states[case], run.street.grid),
                    "found": [asdict(f) for f in score(bodies, run.states[case])],
                }
                for name, (run, bodies) in self.changed.items()
            },
            "skipped": self.skipped,
        }


def bench(
    folder: Path,
    settings: Settings,
    cases: Sequence[Case],
    tell: Progress,
    *,
    scans: str | None = None,
    seed: int = 1,
    each: int = 4,
) -> Bench:
    """Run all of it on the drive at ``folder`` (of its ``scans``), ``each`` things of a kind. Runs for which the drive
    is too short or too bare are skipped and named. MapvoteError if it is too short for the smallest blocks.
    """
    recording, reference = open_recording(folder, settings, scans)
    street = lay_street(recording, settings, reference, block=BENCH_RULE.blocks[0])
    result = Bench(folder.resolve().name, len(recording), ground_of(street))
    jobs = _unchanged(recording, settings, reference, street, cases)
    casts = {(ChangedRun.BUILT, ChangedRun.BUILT_IN_RAIN): built, (ChangedRun.DEMOLISHED,): demolished}
    total = len(jobs) + sum(map(len, casts))
    for k, (name, job) in enumerate(jobs.items()):
        tell("real street", k, total)
        try:
            result.runs[name] = job()
        except MapvoteError as error:
            result.skipped[name] = str(error)
    site = survey_site(street)
    tell("real street", len(jobs), total)
    for names, cast in casts.items():
        try:
            for name, run in zip(names, cast(street, site, cases, seed, each), strict=True):
                result.changed[name] = run
                tell("real street", len(jobs) + len(result.changed), total)
        except MapvoteError as error:
            result.skipped |= {name: str(error) for name in names if name not in result.changed}
    tell("real street", total, total)
    return result


def _unchanged(
    recording: Drive, settings: Settings, reference: F64, street: Street, cases: Sequence[Case]
) -> dict[str, Callable[[], RealRun]]:
    """Runs by name, each made when called."""

    def on(other: Callable[[], Street], edit: Edit = unedited) -> Callable[[], RealRun]:
        return lambda: vote_on(other(), cases, edit=edit)

    def laid(block: int) -> Callable[[], Street]:
        return lambda: lay_street(recording, settings, reference, block=block)

    jobs = {f"blocks of {BENCH_RULE.blocks[0]} scans": on(lambda: street)}
    jobs |= {f"blocks of {block} scans": on(laid(block)) for block in BENCH_RULE.blocks[1:]}
    jobs["map ends half way"] = on(laid(-(-len(reference) // 2)))
    jobs["every other beam"] = on(lambda: street, every_other_beam)
    jobs["70 % of the points lost"] = on(lambda: street, with_fewer_points(0.7))
    jobs[_rain()] = on(lambda: street, in_rain(STREET_RULE.rain_share))
    if recording.T_map_lidar_prior is not None:
        jobs["first pose only"] = lambda: vote_on(street, cases, first_pose_only=True)
        jobs |= {f"prior {name}": on(lambda: street, edit) for name, edit in _wrong_priors().items()}
    jobs["no prior"] = on(lambda: street, without_prior)
    return jobs


def _wrong_priors() -> dict[str, Edit]:
    return {
        "disturbed by 0.5 m, 2 deg": disturbed(),
        **{f"late by {s:g} s": late(s) for s in (0.2, 0.5, 1.0, 2.0)},
        **{f"off by {m:g} m": biased(m) for m in (3.0, 10.0)},
        "drifting by 5 m": drifting(5.0),
        "of another street": of_another_street(),
    }


def ground_of(street: Street) -> Ground:
    """Path against ground."""
    positions = street.T_map_lidar[:, :3, 3]
    heights = check_heights(street.point_map, positions)
    step = np.linspace(0.0, len(positions) - 1.0, 20 * len(positions))
    dense = np.column_stack([np.interp(step, np.arange(len(positions)), positions[:, k]) for k in range(2)])
    rows, cols, inside = street.grid.indices_of(dense)
    cells = np.unique(np.column_stack([rows[inside], cols[inside]]), axis=0)
    occupied = reference_window(street.point_map, street.grid).occupied[cells[:, 0], cells[:, 1]] != 0
    share = ratio(np.count_nonzero(occupied), len(cells))
    return Ground(heights.median_m, heights.worst_off_m, heights.off_share, share)
