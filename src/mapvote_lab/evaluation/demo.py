"""``mapvote demo``: a simulated street becomes an updated map and a report, with a first picture within seconds.

``mapvote demo DRIVE``: a recorded street, mapped from some of its scans and voted on by the others. Nothing changes on
a street within one drive. So new bodies are cast into the scans of the vehicles that vote, as in ``mapvote evaluate
real``: the vote has to find them, and has to leave the rest of the street as it is.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb

from mapvote.codec.ballot import Ballot
from mapvote.config import Settings
from mapvote.core.geometry import transform
from mapvote.core.grid import CELL_SIZE
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.process_memory import give_back_free_pages
from mapvote.core.record import record
from mapvote.core.types import F64, Bool, CellState, Drive, MapvoteError
from mapvote.formats import open_drive, write_map
from mapvote.formats.atomic import whole_file, write_whole
from mapvote.formats.drives.trajectory import read_poses
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.pcd import write_pcd
from mapvote.matching.localiser import GivenPoses
from mapvote.plots import Colour, save
from mapvote.shapes.cutout import Cutout, fragment
from mapvote.survey.build import build_map
from mapvote.warmup import compile_for_maps, compile_for_votes, compiled_mark, leave_mark
from mapvote_lab.evaluation import figures, real_bench
from mapvote_lab.evaluation.cases import Case, Progress, choose_cases, untold
from mapvote_lab.evaluation.evaluate import Evaluation, PublishedRound, evaluate, vote_by_http
from mapvote_lab.evaluation.gallery import ChangedArea, areas_of, gallery
from mapvote_lab.evaluation.real_report import draw_things
from mapvote_lab.evaluation.real_street import RealRun, Street, lay_street
from mapvote_lab.evaluation.scene import Pass, Scene
from mapvote_lab.evaluation.scores import PAPER_F1, EvaluationResult, ObjectScores, same_rows, to_json
from mapvote_lab.evaluation.tables import ReportSection, as_text, case_name, page, tables
from mapvote_lab.evaluation.truths import read_moving
from mapvote_lab.processes import load_in, processes

CASE = "surfaces"


@record()
@dataclass(frozen=True, slots=True)
class DemoPlan:
    """Size of the demonstration."""

    scans: int = 120
    """Most scans of a drive that are used: the demo is to take a minute."""
    each: int = 2
    """New bodies of each kind."""
    seed: int = 2
    """Seed of the simulated street and of the places of new bodies; the method was developed on another (1)."""


DEMO_PLAN = DemoPlan()
"""Whose updated map the demo shows: the product's own rule; the paper's cases stand beside it in the tables."""
Picture = tuple[Path, str]
"""A file and its caption."""


@dataclass(frozen=True, slots=True)
class Story:
    """Results of the demo, for the last lines on the terminal and the first on the page."""

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
    old = all_points(evaluation.first_map)
    new = all_points(evaluation.outcomes[CASE].updated)
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
    held = story.published.held
    sections = [
        _what_happened(evaluation, [drawn["scans"], drawn["street"]]),
        ReportSection(
            "The changed areas",
            ["Drag to turn the cloud; what went are blue crosses, what came red diamonds."] if cutouts else [],
            markup=fragment(cutouts) if cutouts else "",
            pictures=[drawn[area.name.replace(" ", "_")] for area, _, _ in story.areas],
        ),
        ReportSection(
            "View and votes of one vehicle",
            [
                "A scan falls onto a grid of 0.3 m cells, 80 m wide. Each cell is unchanged, changed or "
                "undetermined; an occupied cell's vote weighs more the more points it holds. Over the drive the "
                "majority decides each cell."
            ],
            [drawn["scan"], drawn["local_grid"], drawn["vote_curve"]],
        ),
        ReportSection(
            "Decisions of the server",
            [
                "A mapvote server in a process of its own took the ballots by HTTP, decided every cell and published "
                f"version {story.published.version} of the map, which the vehicles then download. Undetermined and "
                "never seen cells keep what the map has.",
                *([f"It held the version first, for an operator to look: {held}"] if held else []),
            ],
            [drawn["states"]],
        ),
        _how_good(evaluation.result, drawn),
        beside_the_paper(evaluation.result),
        ReportSection(
            "Next steps",
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
    error = np.median([place.median_m for place in evaluation.result.localisation.values()])
    sent = np.mean(evaluation.result.cases[CASE].bytes_per_vehicle)
    facts = [
        (story.found, "changed objects found"),
        (str(len(story.objects.false_m2)), "changes of 1 m² or more where nothing changed"),
        *_rest_facts(evaluation.result),
        (f"{story.deleted:,}", "points deleted from the map"),
        (f"{story.added:,}", "points added to it"),
        (f"{100 * error:.1f} cm", "median localisation error"),
        (f"{sent / 1000:.0f} kB", "sent by each vehicle"),
    ]
    return page(title, lead, facts, sections)


def _rest_facts(result: EvaluationResult) -> list[tuple[str, str]]:
    """How many demolished objects are still to be seen in the map."""
    rests = result.cases[CASE].rests
    if rests is None or not rests.left:
        return []
    return [(f"{rests.visible} of {len(rests.left)}", "demolished objects with a visible rest (> 5 %, > 20 points)")]


def _what_happened(evaluation: Evaluation, pictures: list[Picture]) -> ReportSection:
    scans = sum(place.scans for place in evaluation.result.localisation.values())
    return ReportSection(
        "Results",
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
    """Where the drives are, or that they were deleted."""
    size = f"{story.drives_bytes / 1e6:.0f} MB of drives, ballots and server data"
    return f"{size} are in {folder.parent}." if story.kept else f"{size} were written and deleted; --keep keeps them."


def draw_scans(folder: Path, survey: str, vehicle: str, path: Path) -> Picture:
    """Draw what a survey and a vehicle of a simulated scene measured, at the true poses: what a vote compares."""
    panels = []
    for name, title in ((survey, "(a) The survey"), (vehicle, "(b) Later")):
        points, moving, ground_z = _measured(folder, name)
        colours = figures.shades(points[:, 2] - ground_z)
        colours[moving] = to_rgb(Colour.MOVING)
        panels.append((f"{title}: {len(points):,} returns", points, colours))
    middle = read_poses(folder / "truth" / vehicle / "poses.txt")[:, :3, 3].mean(axis=0)
    camera = figures.Camera((float(middle[0]), float(middle[1]), 0.0), 62.0, 205.0, 40.0)
    save(figures.draw(panels, camera, legend=[("moving", Colour.MOVING)], size_m=0.12), path)
    return path, "Points of the LiDARs before and after the change, at the true poses; bodies that move in orange."


def _measured(folder: Path, name: str, step: int = 4) -> tuple[F64, Bool, float]:
    """(points (n, 3) in map metres, whether each is on a moving body (n,), height of the road) of every ``step``-th
    scan of a drive."""
    drive = open_drive(folder / name)
    poses = read_poses(folder / "truth" / name / "poses.txt")
    localise = GivenPoses(drive.stamps_ns, poses)
    points = []
    moving = []
    for i in range(0, len(drive), step):
        [fix] = localise.push(drive.read_scan(i), None)
        points.append(transform(fix.registration.T_map_lidar, fix.points))
        moving.append(read_moving(folder / "truth", name, i))
    road_z = float(np.median(poses[:, 2, 3]) - drive.T_base_lidar[2, 3])
    return np.concatenate(points), np.concatenate(moving), road_z


def commands(evaluation: Evaluation, out: Path, kept: bool) -> str:
    """Commands to type next, on this demo's files and on one's own."""
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


def demo_drive(folder: Path, out: Path, progress: Progress, show: Callable[[Path], None]) -> list[str]:
    """Map a recorded drive, vote on it, draw and report; returns the lines that sum it up.

    Blocks of 12 scans are the map, the blocks between them three vehicles. ``show(path)`` is called with the first
    picture. MapvoteError if the drive cannot be read, is too short, or does not fit on itself.
    """
    settings = Settings()
    cases, _ = choose_cases(settings, CASE)
    with processes(2) as helpers:
        compiling = _compile_in(helpers)
        length = len(open_drive(folder))
        recording = open_drive(folder, scans=f"0:{min(DEMO_PLAN.scans, length)}")
        scan = draw_scan(recording, out / "pictures" / "scan.png")
        show(scan)
        _wait_for(compiling, progress)
    progress("mapping", 0, 2)
    reference = build_map([recording], settings)[1].tracks[0].T_map_lidar
    progress("mapping", 1, 2)
    street = lay_street(recording, settings, reference)
    write_map(street.point_map, out / "map")
    progress("mapping", 2, 2)
    progress("voting", 0, 1)
    run, bodies, things = real_bench.new_things(
        street, real_bench.survey_site(street), cases, DEMO_PLAN.seed, DEMO_PLAN.each
    )
    progress("voting", 1, 1)
    scores = real_bench.score(bodies, run.states[CASE])
    pictures = [
        (scan, "One scan of the drive, coloured by height."),
        (out / "pictures" / "street.png", "The map. Red: returns of new bodies in cells that the vote calls changed "
         "(occupied). Yellow: returns of new bodies that the vote missed."),
        (out / "pictures" / "from_above.png", "Every cell, and each new body from near. Red: new and found. Yellow: "
         "missed. Black: called changed where nothing changed."),
    ]  # fmt: skip
    draw_street(run, [np.concatenate(thing.met) for thing in things if thing.met], pictures[1][0])
    draw_things(run, CASE, bodies, pictures[2][0])
    facts = [
        (
            f"{sum(f.half for f in scores)} of {sum(f.things for f in scores)}",
            "new bodies found by half of their cells",
        ),
        (
            f"{100 * run.changed_share(CASE, with_movers=False):.2f} %",
            "of the decided cells called changed",
        ),
        (f"{100 * run.lost_share:.0f} %", "of the scans abstained"),
        (f"{100 * float(np.median(run.error_m)):.1f} cm", "median distance from the SLAM trajectory"),
    ]
    lead = (
        "A street is mapped from a part of a recording and driven by the rest. Bodies that never stood there are cast "
        "into the scans of the vehicles, so that the vote has something to find."
    )
    text = page(f"Three vehicles voted on {folder.name}", lead, facts, _sections(folder, street, length, pictures))
    write_whole(out / "report.html", text)
    lines = [f"{meaning}: {figure}" for figure, meaning in facts]
    return [*lines, f"{out / 'report.html'}: the story with pictures", f"{out / 'map'}: the map"]


def _compile_in(helpers: Executor) -> list[Future[None]]:
    """Let two processes compile the kernels; nothing where an earlier run has left all of them."""
    if compiled_mark().exists():
        return []
    return [helpers.submit(compile_kernels) for compile_kernels in (compile_for_maps, compile_for_votes)]


def _wait_for(compiling: Sequence[Future[None]], progress: Progress) -> None:
    """Wait for the kernels, and leave word that they are there."""
    if not compiling:
        return
    progress("compiling kernels, once", 0, len(compiling))
    for done, compiled in enumerate(as_completed(compiling), start=1):
        compiled.result()
        progress("compiling kernels, once", done, len(compiling))
    leave_mark()


def draw_scan(recording: Drive, path: Path) -> Path:
    """Draw the middle scan of a drive in its own frame."""
    scan = recording.read_scan(len(recording) // 2)
    points = scan.points[np.linalg.norm(scan.points, axis=1) < 45.0].astype(np.float64)
    if len(points) == 0:
        raise MapvoteError(f"{recording.path}: the middle scan has no return within 45 m; mapvote doctor looks at it")
    ground_z = float(np.percentile(points[:, 2], 5))
    panel = (f"{recording.path.name}: {len(points):,} returns", points, figures.shades(points[:, 2] - ground_z))
    save(figures.draw([panel], figures.Camera((0.0, 0.0, ground_z), 62.0, 205.0, 38.0), size_m=0.1), path)
    return path


def draw_street(run: RealRun, cast: Sequence[F64], path: Path) -> None:
    """Draw the map and the returns (n, 3) of each new body, by whether the vote found their cells."""
    street = run.street
    points = all_points(run.street.point_map)
    positions = street.T_map_lidar[:, :3, 3]
    middle = positions[len(positions) // 2]
    along = positions[-1] - positions[0]
    road_z = float(np.median(positions[:, 2])) - float(street.built.tracks[0].heights.median_m)
    near = np.linalg.norm(points[:, :2] - middle[:2], axis=1) < 70.0
    clouds = [points[near]]
    colours = [figures.shades(points[near, 2] - road_z)]
    for returns in cast:
        is_new = street.grid.value_at(run.states[CASE] == CellState.CHANGED_OCCUPIED, returns)
        clouds.append(returns)
        colours.append(np.where(is_new[:, None], to_rgb(Colour.NEW), to_rgb(Colour.UNSURE)).astype(np.float32))
    behind = float(np.degrees(np.arctan2(-along[1], -along[0]))) + 25.0
    camera = figures.Camera((float(middle[0]), float(middle[1]), road_z), 75.0, behind, 38.0)
    panel = (f"{len(points):,} map points", np.concatenate(clouds), np.concatenate(colours))
    save(figures.draw([panel], camera, legend=[("new, found", Colour.NEW), ("new, missed", Colour.UNSURE)]), path)


def _sections(folder: Path, street: Street, length: int, pictures: Sequence[tuple[Path, str]]) -> list[ReportSection]:
    used = len(street.recording)
    return [
        ReportSection(
            "Results",
            [
                f"{used} of the {length} scans were read. Blocks of 12 scans became the map; the blocks between them "
                "are three vehicles, every third scan each.",
                "All scans come from one drive. So this report says less than a second drive on another day would.",
            ],
            pictures,
        ),
        ReportSection(
            "Next steps",
            commands=(
                f"mapvote doctor {folder}\n"
                f"mapvote evaluate real {folder} --out bench    # more bodies, wrong priors, rain; takes minutes\n"
                f"mapvote build {folder} --out my_map\n"
                "mapvote vote ANOTHER_DRIVE --map my_map --vehicle car_1 --out car_1.ballot\n"
            ),
        ),
    ]


def demo(
    out: Path,
    helpers: Executor,
    *,
    full: bool = False,
    keep: bool = False,
    progress: Progress = untold,
    show: Callable[[Path], None] | None = None,
) -> tuple[Evaluation, Story]:
    """Simulate, build, let three vehicles vote, update, evaluate; everything into ``out``.

    ``show(path)`` is called with the first picture, as soon as two drives are simulated. ``keep``: the drives, the
    server's store and the vehicles' folders stay in ``out/work``; otherwise they are deleted at the end. A run that
    was interrupted is continued by the next one. Two processes, ``helpers``, compile the kernels while this one
    simulates, or simulate where a run before has compiled them. Two of the three vehicles drive in them, and they save
    the pictures; then they are told to end. MapvoteError if ``out`` cannot be written.
    """
    settings = Settings()
    work = out / "work"
    scene = Scene("street" if full else "corner", DEMO_PLAN.seed, settings, work)
    cases, _ = choose_cases(settings, f"1,2,3,4,5,{CASE}")
    pictures: list[Picture] = []

    def begun(folder: Path, survey: str, vehicle: str) -> None:
        pictures.append(draw_scans(folder, survey, vehicle, out / "pictures" / "scans.png"))
        if show:
            show(pictures[0][0])

    compiling = _compile_in(helpers)
    scene.simulate(progress, None if compiling else helpers.map, begun)
    _wait_for(compiling, progress)
    load_in(helpers, 2, "mapvote.plots")  # while this process maps
    evaluation, drawn, done, areas = _voted(scene, cases, helpers, progress, out)
    pictures += drawn
    helpers.shutdown(wait=False)  # they end, .4 s, while this process writes
    if not follows(evaluation.first_map, done.updated, evaluation.outcomes[CASE].updated):
        raise MapvoteError("the server's map is not the one that the offline rule makes; please report this bug")
    for name, point_map in (("map_before", evaluation.first_map), ("map_after", done.updated)):
        with whole_file(out / f"{name}.pcd") as partial:
            write_pcd(partial, Cloud(all_points(point_map)))
    write_whole(out / "tables.txt", as_text(evaluation.result))
    write_whole(out / "results.json", to_json(evaluation.result))
    write_map(done.updated, out / "map_after")
    story = tell(
        evaluation, done, drives_bytes=sum(f.stat().st_size for f in work.rglob("*") if f.is_file()), kept=keep
    )
    write_whole(out / "report.html", report_page(evaluation, story, pictures, out, areas))
    if not keep:
        shutil.rmtree(work)
    progress("server and pictures", 1, 1)
    return evaluation, story


def _voted(
    scene: Scene, cases: Sequence[Case], helpers: Executor, progress: Progress, out: Path
) -> tuple[Evaluation, list[Picture], PublishedRound, list[Cutout]]:
    """The evaluation, its pictures, and the round of a server that takes the ballots while this process scores them,
    with what it changed."""
    serving: list[Future[tuple[PublishedRound, list[Cutout]]]] = []
    with ThreadPoolExecutor(1) as waiting:

        def send(drives: Sequence[Pass]) -> None:
            ballots = [drive.ballots[CASE] for drive in drives]
            serving.append(waiting.submit(_served, ballots, scene.work / "map", out / "work" / "server"))

        evaluation = evaluate(scene, cases, progress=progress, helpers=helpers, voted=send)
        give_back_free_pages()
        progress("server and pictures", 0, 1)
        write_map(evaluation.first_map, out / "map_before")
        pictures = gallery(evaluation, CASE, out / "pictures", helpers=helpers)
        return evaluation, pictures, *serving[0].result()


def _served(ballots: Sequence[Ballot], first_map: Path, folder: Path) -> tuple[PublishedRound, list[Cutout]]:
    done = vote_by_http(ballots, first_map, folder)
    return done, changed_areas(folder / "store.db", done.version)


def follows(first: PointMap, served: PointMap, offline: PointMap) -> bool:
    """Whether the server's map is the offline rule's but for new points that it leaves out: of what comes and goes it
    also asks who looked last (fusion/change_time.py)."""
    old = all_points(first)
    by_server = all_points(served)
    by_rule = all_points(offline)
    agreed, left_out = same_rows(by_server, by_rule)
    return bool(agreed.all()) and not same_rows(left_out, old)[0].any()


def changed_areas(store: Path, version: int) -> list[Cutout]:
    """Changes of the server's round, cut out of the map."""
    from mapvote_server.questions.changes import changes_between, cutouts_between  # SQLAlchemy: while others draw
    from mapvote_server.store.store import Store, url_of

    opened = Store.open(url_of(str(store)))
    try:
        return cutouts_between(opened, 1, version, changes_between(opened, 1, version)) if version > 1 else []
    finally:
        opened.close()
