"""``mapvote demo``: the main job in one command, from a street that never existed to an updated map and its report."""

from __future__ import annotations

from pathlib import Path

from mapvote.config import Settings
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.types import MapvoteError
from mapvote.formats import write_map
from mapvote.formats.atomic import whole_file
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.pcd import write_pcd
from mapvote.server.store.store import Store, url_of
from mapvote.server.views.cutout import Cutout
from mapvote.server.views.history import changes_between, cutouts_between
from mapvote_lab.evaluation.demo_report import CASE, Story, report_page, tell
from mapvote_lab.evaluation.evaluate import Evaluation, evaluate
from mapvote_lab.evaluation.experiments.cases import choose_cases
from mapvote_lab.evaluation.experiments.scene import Progress, Scene
from mapvote_lab.evaluation.loopback import vote_by_http
from mapvote_lab.evaluation.reporting.gallery import gallery
from mapvote_lab.evaluation.reporting.tables import as_text, result_csv, result_json, write_text
from mapvote_lab.evaluation.scoring.map_points import same_rows

SCENARIO, FULL_SCENARIO = "corner", "street"
SEED = 2
"""Not the seed that the method was developed on (1)."""


def demo(out: Path, full: bool = False, progress: Progress | None = None) -> tuple[Evaluation, Story]:
    """Simulate, build, let three vehicles vote, update, evaluate; everything into ``out``.

    A second run goes on from the first. MapvoteError if ``out`` cannot be written.
    """
    settings = Settings()
    scene = Scene(FULL_SCENARIO if full else SCENARIO, SEED, settings, out / "work")
    cases, _ = choose_cases(settings, f"1,2,3,4,5,{CASE}")
    evaluation = evaluate(scene, cases, progress=progress, readings="occluded")
    write_map(evaluation.first_map, out / "map_before")
    if progress:
        progress("a server's round", 0, 1)
    done = vote_by_http(
        [drive.ballots[CASE] for drive in evaluation.drives], out / "map_before", out / "work" / "server"
    )
    updated = done.updated
    if not follows(evaluation.first_map, updated, evaluation.outcomes[CASE].updated):
        raise MapvoteError("the server's map is not the one that the offline rule makes; please report this bug")
    if progress:
        progress("a server's round", 1, 1)
        progress("drawing", 0, 1)
    for name, point_map in (("map_before", evaluation.first_map), ("map_after", updated)):
        with whole_file(out / f"{name}.pcd") as partial:
            write_pcd(partial, Cloud(all_points(point_map)))
    pictures = gallery(evaluation, CASE, out / "pictures")
    write_text(as_text(evaluation.result), out / "tables.txt")
    write_text(result_json(evaluation.result), out / "results.json")
    write_text(result_csv(evaluation.result), out / "results.csv")
    write_map(updated, out / "map_after")
    story = tell(evaluation, done)
    write_text(
        report_page(
            evaluation, story, pictures, out, changed_areas(out / "work" / "server" / "store.db", done.version)
        ),
        out / "report.html",
    )
    if progress:
        progress("drawing", 1, 1)
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
