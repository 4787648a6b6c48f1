"""``mapvote demo``: a simulated street becomes an updated map and a report, with a first picture within seconds."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mapvote.config import Settings
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.process_memory import give_back_free_pages
from mapvote.core.types import MapvoteError
from mapvote.formats import write_map
from mapvote.formats.atomic import whole_file
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.pcd import write_pcd
from mapvote.server.store.store import Store, url_of
from mapvote.server.views.cutout import Cutout
from mapvote.server.views.history import changes_between, cutouts_between
from mapvote.warmup import compile_for_maps, compile_for_votes
from mapvote_lab.evaluation.demo_report import CASE, Story, draw_scans, report_page, tell
from mapvote_lab.evaluation.evaluate import Evaluation, evaluate
from mapvote_lab.evaluation.experiments.cases import choose_cases
from mapvote_lab.evaluation.experiments.scene import Progress, Scene
from mapvote_lab.evaluation.loopback import vote_by_http
from mapvote_lab.evaluation.reporting.gallery import gallery
from mapvote_lab.evaluation.reporting.tables import as_text, result_csv, result_json, write_text
from mapvote_lab.evaluation.scoring.map_points import same_rows
from mapvote_lab.simulation.processes import processes

SCENARIO, FULL_SCENARIO = "corner", "street"
SEED = 2
"""Not the seed that the method was developed on (1)."""


def demo(
    out: Path,
    *,
    full: bool = False,
    keep: bool = False,
    progress: Progress | None = None,
    show: Callable[[Path], None] | None = None,
) -> tuple[Evaluation, Story]:
    """Simulate, build, let three vehicles vote, update, evaluate; everything into ``out``.

    ``show(path)`` is called with the first picture, as soon as the drives are simulated. ``keep``: the drives, the
    server's store and the vehicles' folders stay in ``out/work``; otherwise they are deleted at the end. A run that
    was interrupted is continued by the next one. Two processes compile the kernels while this one simulates; the memory
    that a compiler takes ends with them. MapvoteError if ``out`` cannot be written.
    """
    settings, work = Settings(), out / "work"
    scene = Scene(FULL_SCENARIO if full else SCENARIO, SEED, settings, work)
    cases, _ = choose_cases(settings, f"1,2,3,4,5,{CASE}")
    with processes(2) as compilers:
        compiling = [compilers.submit(compile_kernels) for compile_kernels in (compile_for_maps, compile_for_votes)]
        scene.simulate(progress)
        first = draw_scans(scene, out / "pictures" / "scans.png")
        if show:
            show(first[0])
        for compiled in compiling:
            compiled.result()
    evaluation = evaluate(scene, cases, progress=progress)
    give_back_free_pages()
    if progress:
        progress("server and pictures", 0, 1)
    write_map(evaluation.first_map, out / "map_before")
    ballots = [drive.ballots[CASE] for drive in evaluation.drives]
    with ThreadPoolExecutor(1) as waiting:
        serving = waiting.submit(vote_by_http, ballots, out / "map_before", work / "server")
        pictures = [first, *gallery(evaluation, CASE, out / "pictures")]
        done = serving.result()
    if not follows(evaluation.first_map, done.updated, evaluation.outcomes[CASE].updated):
        raise MapvoteError("the server's map is not the one that the offline rule makes; please report this bug")
    for name, point_map in (("map_before", evaluation.first_map), ("map_after", done.updated)):
        with whole_file(out / f"{name}.pcd") as partial:
            write_pcd(partial, Cloud(all_points(point_map)))
    write_text(as_text(evaluation.result), out / "tables.txt")
    write_text(result_json(evaluation.result), out / "results.json")
    write_text(result_csv(evaluation.result), out / "results.csv")
    write_map(done.updated, out / "map_after")
    areas = changed_areas(work / "server" / "store.db", done.version)
    story = tell(evaluation, done, drives_bytes=size_of(work), kept=keep)
    write_text(report_page(evaluation, story, pictures, out, areas), out / "report.html")
    if not keep:
        shutil.rmtree(work)
    if progress:
        progress("server and pictures", 1, 1)
    return evaluation, story


def follows(first: PointMap, served: PointMap, offline: PointMap) -> bool:
    """Whether the server's map is the offline rule's but for new points that it leaves out: of what comes and goes it
    also asks who looked last (fusion/persistence.py)."""
    old, by_server, by_rule = all_points(first), all_points(served), all_points(offline)
    agreed, left_out = same_rows(by_server, by_rule)
    return bool(agreed.all()) and not same_rows(left_out, old)[0].any()


def changed_areas(store: Path, version: int) -> list[Cutout]:
    """What the server's round changed, cut out of the map."""
    opened = Store.open(url_of(str(store)))
    try:
        return cutouts_between(opened, 1, version, changes_between(opened, 1, version)) if version > 1 else []
    finally:
        opened.close()


def size_of(folder: Path) -> int:
    """Bytes of all files in a folder."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
