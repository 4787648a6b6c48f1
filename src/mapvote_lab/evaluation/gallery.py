"""The pictures of one evaluation, in the manner of the paper's Figures 2-8, into a folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from mapvote import plots as style
from mapvote.core.geometry import transform
from mapvote.core.grid import window_around
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.types import F32, F64, Bool, CellState
from mapvote.matching.localiser import GivenPoses
from mapvote.vehicle import Vehicle
from mapvote_lab.evaluation import figures
from mapvote_lab.evaluation.baselines import heights_above_ground
from mapvote_lab.evaluation.cases import ballot_states, paper_cases
from mapvote_lab.evaluation.evaluate import Evaluation
from mapvote_lab.evaluation.scores import reliability, same_rows
from mapvote_lab.evaluation.tables import case_name
from mapvote_lab.evaluation.truths import lay_on
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.truth import Label


@dataclass(frozen=True, slots=True)
class ChangedArea:
    """A place where the world changed."""

    name: str
    kind: str
    box: F64
    """(2, 2) corner to corner, x and y, map metres."""
    objects: int


def areas_of(evaluation: Evaluation) -> list[ChangedArea]:
    """The scenario's changed areas, numbered in its order (the paper's Figure 6), by the footprints built there."""
    out = []
    scene = evaluation.scene
    for i, change in enumerate(load_scenario(scene.scenario, scene.overrides).changes):
        corners = [np.asarray(o["footprint"]) for o in evaluation.truth.objects if o["kind"] == change.kind]
        inside = [c for c in corners if change.from_m - 2 <= c[:, 0].mean() <= change.to_m + 2]
        if inside:
            every = np.concatenate(inside)
            box = np.array([every.min(axis=0) - 4.0, every.max(axis=0) + 4.0])
            out.append(ChangedArea(f"area {i + 1}", change.kind, box, len(inside)))
    return out


def gallery(
    evaluation: Evaluation,
    case: str,
    folder: Path,
    formats: Sequence[style.Format] = ("png",),
    helpers: Executor | None = None,
) -> list[tuple[Path, str]]:
    """Draw everything; ``case`` is the one whose updated map is shown. Returns (picture, caption). ``helpers`` save the
    pictures, which takes three times as long as to lay them out."""
    folder.mkdir(parents=True, exist_ok=True)
    out = []
    saving = []
    for name, picture, caption in drawn(evaluation, case):
        for format in formats:
            task = picture, folder / f"{name}.{format}", format
            if helpers is None:
                style.save(*task)
            else:
                saving.append(helpers.submit(style.save, *task))
        out.append((folder / f"{name}.{formats[0]}", caption))
    for saved in saving:
        saved.result()
    return out


def drawn(evaluation: Evaluation, case: str) -> Iterator[tuple[str, Figure, str]]:
    """(name, figure, caption) of every picture, one after the other: a figure takes tens of megabytes."""
    old = all_points(evaluation.first_map)
    new = all_points(evaluation.outcomes[case].updated)
    survived, added = same_rows(old, new)
    deleted = old[~survived]
    paths = _paths(evaluation)
    areas = areas_of(evaluation)
    outlines = [(o["kind"], np.asarray(o["footprint"])) for o in evaluation.truth.objects]
    boxes = [(area.name, area.box) for area in areas]
    yield "street", figures.street(
        (old, heights_above_ground(evaluation.first_map, old)), (new, heights_above_ground(evaluation.first_map, new)),
        added, deleted,
        evaluation.window, outlines=outlines, areas=boxes, paths=paths,
    ), f"The street from above before and after the vote ({case_name(case)}): Figure 6."  # fmt: skip
    for area in areas:
        verb, figure = ("added in red", 7) if area.kind == "built" else ("deleted in blue", 8)
        caption = f"{area.name.capitalize()} in bird's-eye view, points {verb}: Figure {figure}."
        yield area.name.replace(" ", "_"), _area(evaluation.first_map, area, old, survived, added, paths), caption
    nearest = _scan_near(evaluation, areas)
    v = evaluation.scene.settings.voting
    n_min = evaluation.scene.settings.paper.n_min
    decided = {n: evaluation.outcomes[n].states for n in ("1", "5", "surfaces") if n in evaluation.outcomes}
    truth = np.full(256, CellState.UNCHANGED_EMPTY, dtype=np.uint8)
    truth[[1, 2, Label.UNSCORED]] = CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY, CellState.UNDETERMINED
    panels = [("Truth (strict)", truth[evaluation.truth.strict])]
    panels += [(case_name(n).capitalize(), states) for n, states in decided.items()]
    shown = {n: e for n, e in evaluation.result.cases.items() if " " not in n}
    names = {n: case_name(n) for n in shown}
    yield "scan", _scan(evaluation, nearest), "One scan of a vehicle, bodies that move in orange: Figure 5."
    yield "local_grid", _local_grid(evaluation, nearest), "The 80 m local grid of one vehicle: Figures 2 and 3."
    yield "vote_curve", figures.vote_curve(v.a, v.b, v.k, n_min), "Votes of an occupied cell, Eq. (1): Figure 4."
    caption = "Decisions of the server, cell by cell; yellow in the truth: unscored."
    yield "states", figures.cell_states(panels, evaluation.window, outlines=outlines), caption
    yield "table_iv", figures.score_bars(shown, names), "Table IV as bars, the paper's figures beside ours."
    if evaluation.best == "surfaces":
        decisions = evaluation.outcomes["surfaces"].decisions
        lattice = evaluation.first_map.lattice
        by_state = {
            state: reliability(decisions, lattice, evaluation.truth.strict, evaluation.window, state)
            for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY)
        }
        caption = "Share of the cells that really changed, by the probability they were decided with (strict truth)."
        yield "reliability", figures.reliability_diagram(by_state), caption


def _paths(evaluation: Evaluation) -> list[tuple[str, F64]]:
    """Where each vehicle believed to drive, on the road below its sensor."""
    out = []
    for drive in evaluation.drives:
        position = drive.T_map_lidar[np.isfinite(drive.T_map_lidar).all(axis=(1, 2)), :3, 3]
        height = evaluation.scene.drive(drive.vehicle).T_base_lidar[2, 3]
        out.append((drive.vehicle.replace("v", "vehicle "), position - [0.0, 0.0, height]))
    return out


def _area(
    first_map: PointMap, area: ChangedArea, old: F64, survived: Bool, added: F64, paths: list[tuple[str, F64]]
) -> Figure:
    """Before and after, from across the road; what stands on the near side of it is left out of the way."""
    road_y = float(np.mean(np.concatenate([path[:, 1] for _, path in paths])))
    middle = area.box.mean(axis=0)
    north = middle[1] > road_y
    low = area.box[0] - [22.0, 6.0]
    high = area.box[1] + [22.0, 6.0]
    low[1], high[1] = (road_y - 9.0, high[1]) if north else (low[1], road_y + 9.0)
    ground_z = float(np.median(np.concatenate([path[:, 2] for _, path in paths])))

    def inside(points: F64) -> Bool:
        return ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)

    def coloured(points: F64, marked: Bool, colour: str) -> tuple[F64, F32]:
        here = inside(points)
        colours = figures.shades(heights_above_ground(first_map, points[here]))
        colours[marked[here]] = to_rgb(colour)
        return points[here], colours

    kept_first = np.concatenate([old[survived], added])
    fresh = np.arange(len(kept_first)) >= int(survived.sum())
    width = float(area.box[1, 0] - area.box[0, 0])
    target = float(middle[0]), float(0.6 * middle[1] + 0.4 * road_y), ground_z + 2.0
    camera = figures.Camera(target, 30.0 + 0.85 * width, -72.0 if north else 72.0, 34.0)
    shown = [(name, path[inside(path)]) for name, path in paths]
    panels = [
        ("(a) First map", *coloured(old, ~survived, style.Colour.GONE)),
        ("(b) Updated map", *coloured(kept_first, fresh, style.Colour.NEW)),
    ]
    return figures.draw(
        panels, camera, paths=shown, legend=[("deleted", style.Colour.GONE), ("added", style.Colour.NEW)]
    )


def _scan_near(evaluation: Evaluation, areas: list[ChangedArea]) -> int:
    """The scan of the first vehicle nearest to the first demolition (or to the first area, or its middle scan)."""
    T = evaluation.drives[0].T_map_lidar
    chosen = [a for a in areas if a.kind == "demolished"] or areas
    if not chosen:
        return len(T) // 2
    distance = np.linalg.norm(T[:, :2, 3] - chosen[0].box.mean(axis=0), axis=1)
    return int(np.nanargmin(distance))


def _scan(evaluation: Evaluation, index: int) -> Figure:
    drive = evaluation.scene.drive(evaluation.drives[0].vehicle)
    T_map_lidar = evaluation.drives[0].T_map_lidar[index]
    scan = drive.read_scan(index)
    moving = evaluation.truth.moving(evaluation.drives[0].vehicle, index)
    points = transform(T_map_lidar, scan.points)
    ground_z = float(T_map_lidar[2, 3] - drive.T_base_lidar[2, 3])
    colours = figures.shades(heights_above_ground(evaluation.first_map, points))
    if len(moving) == len(points):
        colours[moving] = to_rgb(style.Colour.MOVING)
    near = np.linalg.norm(points[:, :2] - T_map_lidar[:2, 3], axis=1) < 45.0
    camera = figures.Camera((*T_map_lidar[:2, 3], ground_z), 62.0, 205.0, 38.0)
    title = f"{drive.vehicle}, scan {index}: {len(points):,} points, {100 * moving.mean():.0f} % on moving bodies"
    return figures.draw(
        [(title, points[near], colours[near])], camera, size_m=0.1, legend=[("moving", style.Colour.MOVING)]
    )


def _local_grid(evaluation: Evaluation, index: int) -> Figure:
    """The local grid by one scan alone under the paper's rule, and by the whole drive."""
    first = evaluation.drives[0]
    scene = evaluation.scene
    name = first.vehicle
    drive = scene.drive(name)
    voting = paper_cases(scene.settings)["1"].voting
    there = np.isfinite(first.T_map_lidar).all(axis=(1, 2))
    localise = GivenPoses(drive.stamps_ns[there], first.T_map_lidar[there])
    settings = scene.settings.model_copy(update={"voting": voting})
    vehicle = Vehicle(name, drive.sensor, evaluation.first_map, settings, localise=localise)
    vehicle.observe(drive.read_scan(index))
    vehicle.finish()
    once, grid = ballot_states(vehicle.ballot(), evaluation.first_map)
    x, y = first.T_map_lidar[index, :2, 3]
    window = window_around(evaluation.first_map.lattice, float(x), float(y), voting.window_m)
    panels = [("One scan, case 1", lay_on(once, grid, window))]
    panels += [
        (f"The whole drive, {case_name(n)}", lay_on(*ballot_states(first.ballots[n], evaluation.first_map), window))
        for n in dict.fromkeys(("1", evaluation.best))
        if n in first.ballots
    ]
    return figures.cell_states(panels, window)
