"""Changes cast into the scans of a real drive: what was asked, and how much of it was found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.geometry import inverse, transform
from mapvote.core.grid import Grid
from mapvote.core.reference import LocalMap, reference_window
from mapvote.core.types import F64, U8, Bool, CellState
from mapvote.core.voxels import VoxelCloud
from mapvote.localisation.localiser import GivenPoses
from mapvote.perception.raycast import find_obstacles
from mapvote_lab.evaluation.experiments.cases import Case
from mapvote_lab.evaluation.experiments.real import sensing
from mapvote_lab.evaluation.experiments.real.raycast import Thing, with_things
from mapvote_lab.evaluation.experiments.real.street import (
    Edit,
    RealRun,
    Street,
    changed,
    lay_street,
    met_cells,
    vote_on,
)
from mapvote_lab.evaluation.experiments.real.things import Site
from mapvote_lab.evaluation.scoring.cells import ratio

NEAR_CELLS = 5
"""1.5 m: precision is counted this close to the things, because over a street it depends on their number."""


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
    """Of them: at least half of their cells were decided rightly."""
    touched: int
    """Of them: a cell at the thing, or next to one, was."""
    cell_recall: float
    """Share of all their cells."""
    rays: float
    """That met one of them in a scan, in the median."""


def survey_site(street: Street) -> Site:
    """What all scans of the recording show, in the frame of the street's map."""
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
        rows, cols, inside = street.grid.indices_of(xy)
        out = np.full(len(xy), np.nan)
        out[inside] = reference.ground_z[rows[inside], cols[inside]]
        return out

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
    asked = [_new(street, thing) for thing in [*things, *moved]]
    still = met_cells(street, after)
    left = [thing for thing in [*moved, *gone] if thing.kind != "wall set forward"]
    asked += [_gone(street, thing, thing.left, still) for thing in left]
    yield dry, asked
    rain = sensing.in_rain(sensing.RAIN)  # over what was cast: drops hide the things as they hide the street
    yield vote_on(street, cases, edit=lambda recording: rain(after(recording))), asked


def demolished(street: Street, site: Site, cases: Sequence[Case], seed: int, each: int) -> Iterator[Changed]:
    """The map was made among things that the vehicles do not find any more."""
    things = [thing for thing in site.placed(seed + 100, each)[0] if thing.kind != "wall behind a hedge"]
    before = lay_street(
        street.recording, street.settings, street.T_map_lidar, block=street.block, survey_edit=among(things, street)
    )
    T_map_old = before.T_map_lidar[0] @ inverse(street.T_map_lidar[0])
    still = met_cells(before)
    asked = [_gone(before, thing, [transform(T_map_old, p) for p in thing.met], still) for thing in things]
    yield vote_on(before, cases), asked


def _new(street: Street, thing: Thing) -> Asked:
    kind = f"{thing.kind}, new side" if thing.goes is not None else f"{thing.kind} built"
    return Asked(kind, CellState.CHANGED_OCCUPIED, _cells(street, thing.met) & ~street.mapped, _rays(thing.met))


def _gone(street: Street, thing: Thing, points: Sequence[F64], still: Bool) -> Asked:
    """What had stood at ``points``, but for the cells in which something stands ``still`` (rows, cols)."""
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
        rows, cols, z = rows[inside], cols[inside], points[inside, 2]
        high = z - reference.ground_z[rows, cols] >= GROUND_MARGIN_M
        out[rows[high], cols[high]] = True
    return out


def score(asked: Sequence[Asked], states: U8) -> list[FoundThings]:
    """What ``states`` (rows, cols) say of the things, by kind in the order in which they were asked."""
    out = []
    for kind in dict.fromkeys(a.kind for a in asked):
        these = [a for a in asked if a.kind == kind and a.cells.any()]
        right = [np.count_nonzero((states == a.state) & a.cells) for a in these]
        size = [np.count_nonzero(a.cells) for a in these]
        near = [ndimage.binary_dilation(a.cells, np.ones((3, 3))) & (states == a.state) for a in these]
        half = sum(bool(2 * r >= n) for r, n in zip(right, size, strict=True))
        touched = sum(bool(n.any()) for n in near)
        rays = float(np.median([a.rays for a in these] or [0]))
        out.append(FoundThings(kind, len(these), half, touched, ratio(sum(right), sum(size)), rays))
    return out


def precision_near(asked: Sequence[Asked], states: U8, grid: Grid) -> float:
    """Share of the cells decided changed within 1.5 m of the things that are, or lie next to, cells so changed."""
    near, right = np.zeros(grid.shape, dtype=np.bool_), np.zeros(grid.shape, dtype=np.bool_)
    for a in asked:
        near |= ndimage.binary_dilation(a.cells, np.ones((3, 3)), iterations=NEAR_CELLS)
        right |= ndimage.binary_dilation(a.cells, np.ones((3, 3))) & (states == a.state)
    return ratio(np.count_nonzero(right), np.count_nonzero(changed(states) & near))
