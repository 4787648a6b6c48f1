"""A map that came without known-free columns, and what the fleet teaches it (docs/columns-v1.md, rule D).

Rounds are held in turn: what one round of ballots makes of the map, its points and its known-free columns, is what
the next one votes on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from mapvote.core.grid import Grid
from mapvote.core.point_map import all_points, map_from_points
from mapvote.core.types import U8, CellState
from mapvote.formats import write_map
from mapvote_lab.evaluation.experiments.cases import Case, fuse_case
from mapvote_lab.evaluation.experiments.passes import have_voted, passes
from mapvote_lab.evaluation.experiments.scene import BALLOTS_FROM, Progress, Scene, key_of, sources_digest
from mapvote_lab.evaluation.scoring.jury import Outcome

TAUGHT = "columns_v1, imported, taught on the old street"
CHAINS: Mapping[str, Sequence[str]] = {
    "columns_v1, imported": ("v",),
    "columns_v1, imported, the same vehicles again": ("v", "v"),
    TAUGHT: ("survey_", "v"),
}
"""Who votes in turn, by the first letters of the drives' names. The simulated vehicles all drive in the changed street;
only the survey's drives know the old one, so they stand for a fleet that votes before anything changes."""


def in_turn(
    scene: Scene, case: Case, voters: Sequence[str], window: Grid, workers: int, progress: Progress | None = None
) -> Outcome:
    """The last round's outcome, its states over ``window`` those of all rounds together (:func:`over_both_rounds`).

    The first round votes on nothing but the points of the scene's map, as a PCD file would have brought them.
    """
    made_by = sources_digest((*BALLOTS_FROM, "fusion")), case, scene.settings.fuse.model_dump_json()
    here = replace(scene, map_name=f"imported-{key_of(*made_by)}")
    outcome = None
    for who in voters:
        if not have_voted(here, [case], who):
            here.prepare(progress)
        if not (here.work / here.map_name).exists():
            points_only = map_from_points(all_points(scene.point_map), lattice=scene.point_map.lattice)
            write_map(points_only if outcome is None else outcome.updated, here.work / here.map_name)
        drives = passes(here, [case], workers, progress, who)
        ballots = [drive.ballots[case.name] for drive in drives]
        before = outcome
        outcome = fuse_case(here.point_map, ballots, case.min_votes, scene.settings.fuse, window)
        if before is not None:
            outcome = replace(outcome, states=over_both_rounds(before.states, outcome.states))
        here = replace(here, map_name=f"{here.map_name}-{who}")
    if outcome is None:
        raise ValueError("a chain of rounds needs someone who votes")
    return outcome


def over_both_rounds(first: U8, second: U8) -> U8:
    """What two rounds say of each cell of the map before the first: a change of either, unless one undid the other."""
    occupied, empty = CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY
    states = second.copy()
    for change, back, same in (
        (occupied, empty, CellState.UNCHANGED_EMPTY),
        (empty, occupied, CellState.UNCHANGED_OCCUPIED),
    ):
        states[first == change] = change
        states[(first == change) & (second == back)] = same
    return states
