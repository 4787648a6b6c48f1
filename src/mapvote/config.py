"""Every setting of every module on one page. TOML in and out; an unknown key is an error.

Ratios, not scan counts: nothing here needs retuning for another scan rate or number of beams.
"""

from __future__ import annotations

import hashlib
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class NdtSettings(Section):
    """perception/ndt.py (METHOD 5)."""


class MovingSettings(Section):
    """perception/moving.py ([9])."""


class MappingSettings(Section):
    """mapping.py: NDT SLAM."""


Occlusion = Literal["first_hit", "farthest_return", "column"]


class VotingSettings(Section):
    """The paper's rule, and which of its cases (paper III, V). ``method = "columns"`` is METHOD 4."""

    method: Literal["paper", "columns"] = "paper"
    weighted: bool = Field(default=True, description="multiple votes per scan by Eq. (1); false: one vote per scan")
    two_stage: bool = Field(default=True, description="the vehicle decides its cells; false: it sends its tally")
    skip_tall_cells: bool = Field(default=True, description="case 5: no vote where the map begins above the view")
    occlusion: Occlusion = "first_hit"
    a: float = 2.0
    b: float = 3.0
    k: float = 0.5
    n_min: int = 5
    window_m: float = Field(default=80.0, description="side of the local grid (paper III-A)")


class FuseSettings(Section):
    """fleet/fuse.py: which votes count, how many are enough (DESIGN 4)."""

    min_votes: int = 2
    latest_vehicles: int = 9
    max_age_days: float = 30.0


class Settings(Section):
    """All of them. ``mapvote config`` prints this page."""

    ndt: NdtSettings = NdtSettings()
    moving: MovingSettings = MovingSettings()
    mapping: MappingSettings = MappingSettings()
    voting: VotingSettings = VotingSettings()
    fuse: FuseSettings = FuseSettings()

    def digest(self) -> str:
        """SHA-256 of the canonical JSON: ballots of one round must agree on it."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


CASES: dict[str, dict[str, bool]] = {
    "1": {"weighted": True, "two_stage": True, "skip_tall_cells": False},
    "2": {"weighted": False, "two_stage": True, "skip_tall_cells": False},
    "3": {"weighted": True, "two_stage": False, "skip_tall_cells": False},
    "4": {"weighted": False, "two_stage": False, "skip_tall_cells": False},
    "5": {"weighted": True, "two_stage": True, "skip_tall_cells": True},
}
"""The paper's five cases as settings of the one rule (paper V)."""
