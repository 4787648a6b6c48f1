"""The bench for anyone's drive: the ground, the unchanged street, wrong priors, and changes cast into the scans."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.config import Settings
from mapvote.core.heights import check_heights
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote_lab.evaluation.experiments.cases import Case
from mapvote_lab.evaluation.experiments.real import changes, sensing
from mapvote_lab.evaluation.experiments.real.street import (
    Edit,
    RealRun,
    Street,
    lay_street,
    open_recording,
    unedited,
    vote_on,
)
from mapvote_lab.evaluation.scoring.cells import determined, ratio

BLOCKS = (12, 25)
RAIN = f"rain, {100 * sensing.RAIN:g} % of the rays"
BUILT, BUILT_IN_RAIN, DEMOLISHED = "built", f"built in {RAIN}", "demolished"
CASTS = {(BUILT, BUILT_IN_RAIN): changes.built, (DEMOLISHED,): changes.demolished}
"""The runs that each yields in turn."""
PRIORS: Mapping[str, Edit] = {
    "disturbed by 0.5 m, 2 deg": sensing.disturbed(),
    **{f"late by {s:g} s": sensing.late(s) for s in (0.2, 0.5, 1.0, 2.0)},
    **{f"off by {m:g} m": sensing.biased(m) for m in (3.0, 10.0)},
    "drifting by 5 m": sensing.drifting(5.0),
    "of another street": sensing.of_another_street(),
}
Tell = Callable[[str, int, int], None]
"""Called with (stage, done, total)."""


@dataclass(frozen=True)
class Ground:
    """Path against ground in the map of every other block, under the whole recording."""

    sensor_height_m: float
    worst_off_m: float
    off_share: float
    occupied_share: float
    """Of the cells under the driven line: the map holds an obstacle there, at any height."""


@dataclass
class Bench:
    """Everything that was measured on one drive."""

    name: str
    scans: int
    ground: Ground
    runs: dict[str, RealRun] = field(default_factory=dict)
    """Nothing changed in any of them."""
    changed: dict[str, changes.Changed] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    """Run: why it could not be made on this drive."""

    def figures(self, case: str) -> dict[str, Any]:
        """All of it as numbers, by ``case``."""
        return {
            "drive": self.name,
            "scans": self.scans,
            "ground": {k: v if np.isfinite(v) else None for k, v in asdict(self.ground).items()},
            "unchanged": {name: unchanged_figures(run, case) for name, run in self.runs.items()},
            "changed": {
                name: {
                    "precision_near": changes.precision_near(asked, run.states[case], run.street.grid),
                    "found": [asdict(f) for f in changes.score(asked, run.states[case])],
                }
                for name, (run, asked) in self.changed.items()
            },
            "skipped": self.skipped,
        }


def unchanged_figures(run: RealRun, case: str) -> dict[str, float]:
    """Counts, shares of cells and scans, and errors in metres (0 where no scan was localised)."""
    return {
        "ballots": float(run.ballots),
        "determined_cells": float(np.count_nonzero(determined(run.states[case]))),
        "false_share": run.changed_share(case, with_movers=False),
        "false_share_with_movers": run.changed_share(case, with_movers=True),
        "false_share_of_mapped": run.changed_share(case, with_movers=False, of_mapped=True),
        "lost_share": run.lost_share,
        "wrong_share": run.wrong_share,
        "median_error_m": float(np.median(run.error_m)) if len(run.error_m) else 0.0,
        "max_error_m": float(run.error_m.max(initial=0.0)),
    }


def bench(
    folder: Path,
    settings: Settings,
    cases: Sequence[Case],
    tell: Tell,
    *,
    scans: str | None = None,
    seed: int = 1,
    each: int = 4,
) -> Bench:
    """Run all of it on the drive at ``folder`` (of its ``scans``), ``each`` things of a kind. What a drive is too short
    or too bare for is skipped and named. MapvoteError if it is too short for the smallest blocks.
    """
    recording, reference = open_recording(folder, settings, scans)
    street = lay_street(recording, settings, reference, block=BLOCKS[0])
    result = Bench(folder.resolve().name, len(recording), ground_of(street))
    jobs = _unchanged(recording, settings, reference, street, cases)
    total = len(jobs) + sum(map(len, CASTS))
    for k, (name, job) in enumerate(jobs.items()):
        tell("real street", k, total)
        try:
            result.runs[name] = job()
        except MapvoteError as error:
            result.skipped[name] = str(error)
    site = changes.survey_site(street)
    tell("real street", len(jobs), total)
    for names, cast in CASTS.items():
        try:
            for name, changed in zip(names, cast(street, site, cases, seed, each), strict=True):
                result.changed[name] = changed
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

    jobs = {f"blocks of {BLOCKS[0]} scans": on(lambda: street)}
    jobs |= {f"blocks of {block} scans": on(laid(block)) for block in BLOCKS[1:]}
    jobs["map ends half way"] = on(laid(-(-len(reference) // 2)))
    jobs["every other beam"] = on(lambda: street, sensing.every_other_beam)
    jobs["70 % of the points lost"] = on(lambda: street, sensing.with_fewer_points(0.7))
    jobs[RAIN] = on(lambda: street, sensing.in_rain(sensing.RAIN))
    if recording.T_map_lidar_prior is not None:
        jobs["first pose only"] = lambda: vote_on(street, cases, first_pose_only=True)
        jobs |= {f"prior {name}": on(lambda: street, edit) for name, edit in PRIORS.items()}
    jobs["no prior"] = on(lambda: street, sensing.without_prior)
    return jobs


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
