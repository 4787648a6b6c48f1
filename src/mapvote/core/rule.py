"""The table of vote rules. A rule is a row: how a vehicle counts its scans, and how a server counts its ballot.

Settings, vehicles, fusion, a server's policy, clouds that vote, warm-up and the laboratory read this table. Another
distribution adds a row by an entry point of the group ``mapvote.rules``, whose name is the rule's name and which loads
a :class:`Rule` (docs/extending.md). This module imports no voter: a server fuses ballots without one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from mapvote.core.types import MapvoteError


@dataclass(frozen=True, slots=True)
class Rule:
    """One rule by which vehicles vote."""

    voter: str
    """``module:function`` of ``(settings, sensor, point_map) -> Voter`` (rules/voter.py), imported at the first use."""
    undetermined_competes: bool = False
    """Fusion: undetermined wins a cell by plurality, as paper IV says. False: a vehicle that could not determine a cell
    abstains, and the order of time settles a tie of what was determined."""
    min_votes: int | None = None
    """Vehicles that a change needs unless the settings say otherwise; None: ``fuse.min_votes``."""
    needs_sight: bool = False
    """The voter asks for the hits of each scan, and how far it could see each cell (perception/raycast.py)."""
    needs_heights: bool = True
    """The voter reads how many obstacle points the map has in each cell and between which heights. False: these planes
    of :class:`mapvote.core.types.Reference` say none, and a drive takes 15 MB less."""
    takes_points_beyond: bool = True
    """New points are also taken outside the local grid; the voter then requires more of a new voxel than one hit."""
    takes_clouds: bool = False
    """Ballots name the voxels that go, so a session's cloud can vote by it although it has no scans."""
    version: str = ""
    """Any text, changed whenever the rule's code would vote otherwise. Ballots of two versions never share a round."""

    def load_voter(self) -> Any:
        """The function that ``voter`` names. MapvoteError if it cannot be imported."""
        module, _, name = self.voter.partition(":")
        try:
            return getattr(import_module(module), name)
        except (ImportError, AttributeError) as error:
            raise MapvoteError(f"vote rule: its voter {self.voter!r} cannot be imported ({error})") from error


PAPER = Rule(
    voter="mapvote.rules.paper:paper_voter",
    undetermined_competes=True,
    min_votes=1,
    needs_sight=True,
    takes_points_beyond=False,
    version="2",
)
"""Paper III and IV."""
SURFACES = Rule(voter="mapvote.rules.surfaces:surface_voter", needs_heights=False, takes_clouds=True, version="2")
"""Height at the cost of a 2D grid: a word of 0.3 m voxels a cell (docs/method.md)."""
RULES: dict[str, Rule] = {"paper": PAPER, "surfaces": SURFACES}
"""The rules of this package. :func:`rule_names` and :func:`rule_named` know those of other distributions too."""


@cache
def plugged_in() -> dict[str, Any]:
    """The entry points of other distributions, by the rule's name."""
    return {entry.name: entry for entry in entry_points(group="mapvote.rules")}


def rule_names() -> list[str]:
    """The names of all rules, those of this package first."""
    return list(dict.fromkeys([*RULES, *plugged_in()]))


def rule_named(method: str) -> Rule:
    """The rule of a ballot's or a setting's ``method``. MapvoteError if no installed distribution has it."""
    rule = RULES.get(method)
    if rule is None and method in plugged_in():
        try:
            rule = plugged_in()[method].load()
        except Exception as error:  # another distribution's module: anything can be wrong with it
            raise MapvoteError(f"vote rule {method!r}: its entry point cannot be loaded ({error})") from error
        if not isinstance(rule, Rule):
            raise MapvoteError(f"vote rule {method!r}: its entry point loads no mapvote.core.rule.Rule")
        RULES[method] = rule
    if rule is None:
        mend = "install the distribution that brings it"
        raise MapvoteError(f"vote rule {method!r} is unknown; known are {', '.join(rule_names())}; or {mend}")
    return rule
