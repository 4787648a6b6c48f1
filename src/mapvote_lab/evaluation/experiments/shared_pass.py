"""One pass over a drive that serves many voters: what a scan saw is worked out once, each voter counts by its rules.

Voters that count alike share their counters, and those of a method share the candidates for new points: a voxel's point
is the first that any of them asked for.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.codec.ballot import Ballot
from mapvote.config import PaperSettings, Settings, VotingSettings
from mapvote.core.point_map import PointMap
from mapvote.core.reference import LocalMap
from mapvote.core.types import Drive, Scan
from mapvote.detection.new_points import NewPoints
from mapvote.detection.voter import Voter
from mapvote.localisation.localiser import Localise, Localiser
from mapvote.localisation.ndt import PosePrior
from mapvote.perception.frontend import DriveReport, Frontend, Movers, Observation
from mapvote.perception.moving_objects import MovingFilter
from mapvote.vehicle import make_voter, write_ballot
from mapvote_lab.evaluation.experiments.cases import Case


class SharedPass:
    """A vehicle with a voter for every case. ``localise`` and ``movers``: as a vehicle's own, or an experiment's."""

    def __init__(
        self,
        drive: Drive,
        point_map: PointMap,
        settings: Settings,
        cases: Sequence[Case],
        *,
        localise: Localise | None = None,
        movers: Movers | None = None,
    ) -> None:
        self.drive, self.point_map, self.settings = drive, point_map, settings
        self._frontend = Frontend(
            localise or Localiser(point_map, settings, drive.sensor),
            movers or MovingFilter(drive.sensor, settings.moving),
            LocalMap(point_map, settings.voting.window_m),
            sensor=drive.sensor,
        )
        self._voters: dict[tuple[VotingSettings, PaperSettings], Voter] = {}
        self._observing: list[tuple[str, Voter]] = []
        """The same voters, each with its method."""
        for case in cases:
            self._enrol(case)
        self._new_points = {
            method: NewPoints(point_map.lattice, beyond=method != "paper")
            for method in {method for method, _ in self._observing}
        }

    def _enrol(self, case: Case) -> None:
        key = _counts_as(case)
        if key in self._voters:
            return
        settings = self.settings.model_copy(update=dict(zip(("voting", "paper"), key, strict=True)))
        self._voters[key] = make_voter(settings, self.drive.sensor, self.point_map)
        self._observing.append((case.voting.method, self._voters[key]))

    @property
    def report(self) -> DriveReport:
        """How the drive goes."""
        return self._frontend.report

    def observe(self, scan: Scan, prior: PosePrior | None = None) -> list[Observation]:
        """One scan for every voter; returns the observations that voted now, for whoever else wants to see them."""
        return self._vote(self._frontend.observe(scan, prior))

    def finish(self) -> list[Observation]:
        """The drive has ended: the observations that still waited."""
        return self._vote(self._frontend.finish())

    def _vote(self, observations: list[Observation]) -> list[Observation]:
        for seen in observations:
            with self.report.timed("vote"):
                may_be_new = {method: np.zeros(seen.view.grid.shape, dtype=np.uint64) for method in self._new_points}
                for method, voter in self._observing:
                    may_be_new[method] |= voter.observe(seen)
                for method, words in may_be_new.items():
                    self._new_points[method].gather(seen, words)
        return observations

    def ballot(self, case: Case) -> Ballot:
        """What the vehicle says by one of its cases. MapvoteError if no scan has voted."""
        settings = self.settings.model_copy(update={"voting": case.voting, "paper": case.paper})
        return write_ballot(
            self.drive.vehicle, self.drive.drive_id, self.point_map, settings, self.report,
            self._voters[_counts_as(case)], self._new_points[case.voting.method],
        )  # fmt: skip


def _counts_as(case: Case) -> tuple[VotingSettings, PaperSettings]:
    """Voters that differ only in who decides (one stage or two) count alike."""
    return case.voting.model_copy(update={"two_stage": True}), case.paper
