"""The demo's report: what was changed, what the vote found, how good that is, what to type next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb

from mapvote.core.geometry import transform
from mapvote.core.grid import CELL_SIZE
from mapvote.core.point_map import all_points
from mapvote.core.types import F64, Bool
from mapvote.localisation.localiser import GivenPoses
from mapvote.plots import save
from mapvote.server.views.cutout import Cutout, fragment
from mapvote_lab.evaluation import figures
from mapvote_lab.evaluation.evaluate import Evaluation, PublishedRound
from mapvote_lab.evaluation.gallery import MOVER, ChangedArea, areas_of
from mapvote_lab.evaluation.results import EvaluationResult
from mapvote_lab.evaluation.scene import Scene
from mapvote_lab.evaluation.scores import PAPER_F1, ObjectScores, same_rows
from mapvote_lab.evaluation.tables import ReportSection, case_name, page, tables

CASE = "surfaces"
"""Whose updated map the demo shows: the product's own rule; the paper's cases stand beside it in the tables."""
Picture = tuple[Path, str]
"""A file and its caption."""


@dataclass(frozen=True, slots=True)
class Story:
    """What the demo found, for the last lines on the terminal and the first on the page."""

    deleted: int
    added: int
    areas: list[tuple[ChangedArea, int, int]]
    """Area, points deleted, points added there."""
    objects: ObjectScores
    published: PublishedRound
    drives_bytes: int
    """Bytes of the drives, ballots and the server's store."""
    kept: bool
    """Whether they stay on disk."""

    @property
    def found(self) -> str:
        """How many of the changed objects."""
        return f"{sum(self.objects.found)} of {len(self.objects.found)}"


def tell(evaluation: Evaluation, done: PublishedRound, *, drives_bytes: int, kept: bool) -> Story:
    """Count what the vote changed, area by area."""
    old, new = all_points(evaluation.first_map), all_points(evaluation.outcomes[CASE].updated)
    survived, added = same_rows(old, new)
    deleted = old[~survived]

    def inside(points: np.ndarray, area: ChangedArea) -> int:
        return int(((points[:, :2] > area.box[0]) & (points[:, :2] < area.box[1])).all(axis=1).sum())

    areas = [(area, inside(deleted, area), inside(added, area)) for area in areas_of(evaluation)]
    objects = evaluation.result.cases[CASE].objects
    return Story(len(deleted), len(added), areas, objects, done, drives_bytes, kept)


def report_page(
    evaluation: Evaluation, story: Story, pictures: list[tuple[Path, str]], out: Path, cutouts: Sequence[Cutout] = ()
) -> str:
    """report.html's text: what happened, in the order in which it happened."""
    drawn = {path.stem: (path, caption) for path, caption in pictures}
    sections = [
        _what_happened(evaluation, [drawn["scans"], drawn["street"]]),
        ReportSection(
            "The changed areas",
            ["Drag to turn the cloud; what went are blue crosses, what came red diamonds."] if cutouts else [],
            markup=fragment(cutouts) if cutouts else "",
            pictures=[drawn[area.name.replace(" ", "_")] for area, _, _ in story.areas],
        ),
        ReportSection(
            "What a vehicle sees and how it votes",
            [
                "A scan falls onto a grid of 0.3 m cells, 80 m wide. Each cell is unchanged, changed or "
                "undetermined; an occupied cell's vote weighs more the more points it holds. Over the drive the "
                "majority decides each cell."
            ],
            [drawn["scan"], drawn["local_grid"], drawn["vote_curve"]],
        ),
        _what_the_server_decided(story, [drawn["states"]]),
        _how_good(evaluation.result, drawn),
        beside_the_paper(evaluation.result),
        ReportSection(
            "What to try next",
            [f"Maps, tables and pictures are beside this page. {drives_sentence(story, evaluation.scene.folder)}"],
            commands=commands(evaluation, out, story.kept),
        ),
    ]
    title = "Three vehicles voted on a street" if len(evaluation.drives) == 3 else "The vehicles voted on a street"
    built = sum(area.objects for area, _, _ in story.areas if area.kind == "built")
    lead = (
        f"{built} built and {sum(a.objects for a, _, _ in story.areas) - built} demolished buildings; "
        f"the vote found {story.found} changed objects that its vehicles could see."
    )
    return page(title, lead, _facts(evaluation.result, story), sections)


def _facts(result: EvaluationResult, story: Story) -> list[tuple[str, str]]:
    error = np.median([place.median_m for place in result.localisation.values()])
    return [
        (story.found, "changed objects found"),
        (str(len(story.objects.false_m2)), "changes of 1 m² or more where nothing changed"),
        (f"{story.deleted:,}", "points deleted from the map"),
        (f"{story.added:,}", "points added to it"),
        (f"{100 * error:.1f} cm", "median localisation error"),
        (f"{np.mean(result.cases[CASE].bytes_per_vehicle) / 1000:.0f} kB", "sent by each vehicle"),
    ]


def _what_happened(evaluation: Evaluation, pictures: list[Picture]) -> ReportSection:
    scans = sum(place.scans for place in evaluation.result.localisation.values())
    return ReportSection(
        "What happened",
        [
            f"A survey vehicle mapped {evaluation.window.cols * CELL_SIZE:.0f} m of a simulated street. Then buildings "
            f"were built and demolished. {len(evaluation.drives)} vehicles drove by, {scans} scans in all; each found "
            "its place in the old map, compared what it saw with it cell by cell, and sent its decisions. The server "
            "counted one vote a vehicle and edited the map.",
            f"Blue points were deleted and red ones added by that vote ({case_name(CASE)}: the paper's two votes "
            "on its 2D grid, with evidence by height). Dashed outlines are the truth, which no vehicle saw.",
        ],
        pictures,
    )


def _what_the_server_decided(story: Story, pictures: list[Picture]) -> ReportSection:
    held = story.published.held
    return ReportSection(
        "What the server decided",
        [
            "A mapvote server in a process of its own took the ballots by HTTP, decided every cell and published "
            f"version {story.published.version} of the map, which the vehicles then download. Undetermined and never "
            "seen cells keep what the map has.",
            *([f"It held the version first, for an operator to look: {held}"] if held else []),
        ],
        pictures,
    )


def _how_good(result: EvaluationResult, drawn: Mapping[str, Picture]) -> ReportSection:
    return ReportSection(
        "How good that is",
        [
            f"F1 is the mean over unchanged, changed (occupied) and changed (empty), as in the paper's Table IV: "
            f"{result.cases['1'].strict.macro_f1:.3f} for case 1 and {result.cases[CASE].strict.macro_f1:.3f} for "
            f"{case_name(CASE)} here (strict truth). The paper's street is not public: its figures stand "
            "beside ours for orientation, not as a race.",
            f"The first map lies {100 * result.map_shift.mean_m:.1f} cm from the truth on average; "
            "the scores include what that costs at the borders of cells.",
        ],
        [drawn[name] for name in ("table_iv", "reliability") if name in drawn],
        list(tables(result)),
    )


def beside_the_paper(result: EvaluationResult) -> ReportSection:
    """Why this street is harder for the paper's cases than the paper's own street."""
    ours = {case: result.cases[case].provenance.macro_f1 for case in PAPER_F1}
    return ReportSection(
        "Beside the paper's own table",
        [
            f"Case 1 reaches {ours['1']:.3f} on this street (provenance truth); the paper prints "
            f"{PAPER_F1['1']:.3f} for its own.",
            *WHY_HARDER,
            "mapvote evaluate as_published repeats the paper's experiment on a street like the paper's. mapvote "
            "evaluate corner --readings compares every reading of the paper's open sentences.",
        ],
    )


WHY_HARDER = (
    "Trees, poles, parked cars and traffic stand between the vehicles and the facades here, and the paper's 2D rule "
    "takes every cell behind the first return above the ground as occluded, so many scans of a changed cell abstain.",
    "A cell is one vote for all heights in the paper's method, so a demolished facade behind or under something that "
    "still stands does not look empty; on the paper's street nothing stands before its buildings.",
)
"""Two sentences, as the report prints them."""


def drives_sentence(story: Story, folder: Path) -> str:
    """What became of the drives."""
    size = f"{story.drives_bytes / 1e6:.0f} MB of drives, ballots and server data"
    return f"{size} are in {folder.parent}." if story.kept else f"{size} were written and deleted; --keep keeps them."


def draw_scans(scene: Scene, path: Path) -> Picture:
    """Draw what the survey and the first vehicle measured, at the true poses of the simulator: what a vote compares."""
    panels = []
    for name, title in ((scene.drive_names("survey_")[0], "(a) The survey"), (scene.drive_names("v")[0], "(b) Later")):
        points, moving, ground_z = _measured(scene, name)
        colours = figures.shades(points[:, 2] - ground_z)
        colours[moving] = to_rgb(MOVER)
        panels.append((f"{title}: {len(points):,} returns", points, colours))
    middle = scene.true_poses(scene.drive_names("v")[0])[:, :3, 3].mean(axis=0)
    camera = figures.Camera((float(middle[0]), float(middle[1]), 0.0), 62.0, 205.0, 40.0)
    save(figures.draw(panels, camera, legend=[("moving", MOVER)], size_m=0.12), path)
    return path, "What the LiDARs measured before and after the change, at the true poses; bodies that move in orange."


def _measured(scene: Scene, name: str, step: int = 4) -> tuple[F64, Bool, float]:
    """(points (n, 3) in map metres, whether each is on a moving body (n,), height of the road) of every ``step``-th
    scan of a drive."""
    drive, poses = scene.drive(name), scene.true_poses(name)
    localise = GivenPoses(drive.stamps_ns, poses)
    points, moving = [], []
    for i in range(0, len(drive), step):
        [fix] = localise.push(drive.read_scan(i), None)
        points.append(transform(fix.registration.T_map_lidar, fix.points))
        moving.append(scene.truth.moving(name, i))
    road_z = float(np.median(poses[:, 2, 3]) - drive.T_base_lidar[2, 3])
    return np.concatenate(points), np.concatenate(moving), road_z


def commands(evaluation: Evaluation, out: Path, kept: bool) -> str:
    """What to type next, on this demo's files and on one's own."""
    own = (
        "# your own: KITTI folders, PCD folders or ROS 2 bags\n"
        "mapvote demo MY_DRIVE                   # this report, of a street that you recorded\n"
        "mapvote doctor MY_DRIVE\n"
        "mapvote build MY_DRIVE --out my_map\n"
        "mapvote vote ANOTHER_DRIVE --map my_map --vehicle car_1 --out car_1.ballot\n"
        "mapvote update my_map car_1.ballot car_2.ballot --out my_map_updated\n"
        "mapvote serve store.db --map my_map    # the server that vehicles talk to\n"
    )
    if not kept:
        return own
    drives = evaluation.scene.folder
    vehicles = [drive.vehicle for drive in evaluation.drives]
    ballots = " ".join(f"{v}.ballot" for v in vehicles)
    before = out / "map_before"
    votes = "\n".join(f"mapvote vote {drives / v} --map {before} --vehicle {v} --out {v}.ballot" for v in vehicles)
    return (
        f"# the same steps by hand, on the drives of this demo\n{votes}\n"
        f"mapvote update {before} {ballots} --out updated\n\n" + own
    )
