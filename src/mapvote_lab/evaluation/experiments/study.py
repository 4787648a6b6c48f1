"""What the paper's tables rest on: its readings swept, and cases explained, on the drives that voted."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mapvote.config import Settings
from mapvote.core.types import MapvoteError
from mapvote.detection.readings import read
from mapvote_lab.evaluation.experiments.cases import Case
from mapvote_lab.evaluation.experiments.explain import witness
from mapvote_lab.evaluation.experiments.kept import KeptDrive, read_kept
from mapvote_lab.evaluation.experiments.passes import pass_folder
from mapvote_lab.evaluation.experiments.scene import Progress, Scene
from mapvote_lab.evaluation.experiments.sweep import swept
from mapvote_lab.evaluation.scoring.budget import Budget, Causes, budget, causes
from mapvote_lab.evaluation.scoring.cells import Scores
from mapvote_lab.evaluation.scoring.jury import Jury, Outcome
from mapvote_lab.evaluation.scoring.truths import SIDE_BY_SIDE

PUBLISHED = {"as_published": "occluded=abstains"}
"""How the paper is read on a scenario unless told otherwise; both readings of an occluded scan stand side by side.
There the first map keeps its strays too: the paper's holds whatever stood still (II), and its cases vote on that."""


def as_paper(settings: Settings, scenario: str, told: Collection[str] = (), reading: str | None = None) -> Settings:
    """``settings`` with the paper read as ``reading`` says, and what suits the scenario of the rest.

    ``told``: names ("mapping.drop_strays") of what the user set: that stays. MapvoteError for a reading there is not.
    """
    known, published = settings, scenario in PUBLISHED
    said = reading or ("" if any(key.startswith("paper.") for key in told) else PUBLISHED.get(scenario, ""))
    if said:
        known = known.model_copy(update={"paper": read(known.paper, said)})
    if published and "mapping.drop_strays" not in told:
        known = known.model_copy(update={"mapping": known.mapping.model_copy(update={"drop_strays": False})})
    return known


@dataclass(frozen=True, slots=True)
class Found:
    """What a study says; empty what was not asked."""

    readings: dict[str, dict[str, dict[str, Scores]]] = field(default_factory=dict)
    budgets: dict[str, dict[str, Budget]] = field(default_factory=dict)
    causes: dict[str, Causes] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Study:
    """What is asked besides the tables."""

    readings: bool = False
    """Every reading of the paper, one sentence at a time."""
    occluded: bool = False
    """Of them only both readings of an occluded scan."""
    explained: tuple[str, ...] = ()
    """Names of the paper's cases."""

    @property
    def wanted(self) -> bool:
        """Whether what the scans say has to be kept."""
        return self.readings or self.occluded or bool(self.explained)

    def of(
        self,
        scene: Scene,
        cases: Sequence[Case],
        jury: Jury,
        outcomes: Mapping[str, Outcome],
        progress: Progress | None,
    ) -> Found:
        """The answers. MapvoteError if a case is to be explained that is not the paper's, or did not vote."""
        found = Found()
        if not self.wanted:
            return found
        kept = [read_kept(pass_folder(scene, cases, name, True), jury.window) for name in scene.drive_names("v")]
        truths = {name: jury.truths[name] for name in SIDE_BY_SIDE}
        if self.readings or self.occluded:
            only = None if self.readings else "occluded"
            found.readings.update(swept(kept, jury.first_map.counts > 0, scene.settings, truths, only, progress))
        for name in self.explained:
            case = next((case for case in cases if case.name == name and case.voting.method == "paper"), None)
            if case is None:
                voted = ", ".join(case.name for case in cases if case.voting.method == "paper")
                raise MapvoteError(f"case {name!r} cannot be explained: choose one that votes by the paper: {voted}")
            self._explain(scene, jury, kept, case, outcomes[name], found)
        return found

    def _explain(
        self, scene: Scene, jury: Jury, kept: Sequence[KeptDrive], case: Case, outcome: Outcome, found: Found
    ) -> None:
        states, seen = witness(scene, jury.first_map, kept, case)
        if not np.array_equal(states, outcome.states):
            cells = np.count_nonzero(states != outcome.states)
            raise MapvoteError(
                f"case {case.name}: {cells} cells are explained otherwise than decided; please report this bug"
            )
        found.budgets[case.name] = {name: budget(states, jury.truths[name], seen) for name in SIDE_BY_SIDE}
        found.causes[case.name] = causes(states, jury.truths["provenance"], seen)


NOTHING_BESIDES = Study()
