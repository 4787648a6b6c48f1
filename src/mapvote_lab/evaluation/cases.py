"""Cases of the comparison: the paper's five (paper V), the same under other rules of sight, and ``surfaces``.

All of them are settings of the one rule. A vehicle casts a ballot by each; the server's rule then decides, and the
decided cells are scored.

The other readings of the paper's open sentences (paper III-IV) need no drive again: the scans of a drive say one word a
cell (rules/paper.py), which is kept over each scan's window. Every reading is then a look-up, with the product's
own tables, votes and verdicts (core/voting.py).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path

import numpy as np

from mapvote.codec.ballot import Ballot, unpack_states, unpack_tally
from mapvote.codec.planes import pack_plane, unpack_bytes
from mapvote.config import CASES, FuseSettings, PaperSettings, Settings, VotingSettings
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.kernel import kernel
from mapvote.core.point_map import PointMap
from mapvote.core.rule import rule_named, rule_names
from mapvote.core.sensors import Sensor
from mapvote.core.types import I32, N_STATES, NO_VOTE, U8, U16, Bool, MapvoteError
from mapvote.core.voting import one_hot, plurality, to_wire
from mapvote.fusion.fuse import states_over, update_map
from mapvote.fusion.gravity import GRAVITY, Gravity
from mapvote.perception.frontend import Observation
from mapvote.rules.paper import read, reading_table, readings_of, sightings
from mapvote_lab.evaluation.scores import Scores, score_cells
from mapvote_lab.evaluation.truths import CaseOutcome, lay_on

Progress = Callable[[str, int, int], None]
"""Called with (name of the work, done, total)."""


def untold(stage: str, done: int, total: int) -> None:
    """A progress that is not reported."""


@dataclass(frozen=True, slots=True)
class Case:
    """One line of the tables: a vote and how it is fused."""

    name: str
    voting: VotingSettings
    min_votes: int
    paper: PaperSettings = field(default_factory=PaperSettings)
    """How the paper is read; only method "paper" uses it."""


def paper_cases(settings: Settings) -> dict[str, Case]:
    """Cases 1 to 5 as ``[paper]`` reads them, named "1".., and under the other rules of sight, named "1 column".. ."""
    cases = {}
    # Readings of sight beside the one that is set, by the suffix of a case's name.
    occlusions = {
        "": {},
        " farthest_return": {"line_of_sight": "farthest"},
        " column": {"line_of_sight": "column"},
    }
    for added, differently in occlusions.items():
        paper = settings.paper.model_copy(update=differently)
        for number, booleans in CASES.items():
            voting = settings.voting.model_copy(update={"method": "paper", **booleans})
            cases[number + added] = Case(number + added, voting, 1, paper)
    return cases


def rule_cases(settings: Settings) -> dict[str, Case]:
    """Every rule of the table but the paper's, by its name: the product's own and those of plug-ins."""
    cases = {}
    for name in rule_names():
        if name != "paper":
            voting = settings.voting.model_copy(update={"method": name})
            cases[name] = Case(name, voting, rule_named(name).min_votes or settings.fuse.min_votes)
    return cases


def choose_cases(settings: Settings, wanted: str | None = None) -> tuple[list[Case], bool]:
    """Cases by comma-separated names (1 to 5, "1 column" and its like, a rule's name, yardsticks, or "all"
    that there is), and whether the yardsticks are wanted.

    MapvoteError names one that there is not, or says that no vote is left.
    """
    wanted = wanted or "1,2,3,4,5,surfaces"
    every = {**paper_cases(settings), **rule_cases(settings)}
    names = [*every, "yardsticks"] if wanted == "all" else [name.strip() for name in wanted.split(",")]
    for name in names:
        if name not in every and name not in ("yardsticks", "nearest", "evidence"):
            raise MapvoteError(f"no case {name!r}: choose from all, yardsticks, {', '.join(every)}")
    chosen = [every[name] for name in names if name in every]
    if not chosen:
        raise MapvoteError("the yardsticks are measured beside a vote: name a case too, as in --case 1,yardsticks")
    return chosen, len(chosen) < len(names)


def fuse_case(
    point_map: PointMap,
    ballots: Sequence[Ballot],
    min_votes: int,
    fuse: FuseSettings,
    window: Grid,
    gravity: Gravity = GRAVITY,
) -> CaseOutcome:
    """The server's side of one case (paper IV): decide every cell, edit the map."""
    start = time.perf_counter()
    settings = fuse.model_copy(update={"min_votes": min_votes})
    updated, decisions = update_map(point_map, ballots, settings, gravity)
    seconds = time.perf_counter() - start
    states, grid = states_over(point_map.lattice, decisions)
    own = [lay_on(*ballot_states(ballot, point_map), window) for ballot in ballots]
    return CaseOutcome(updated, lay_on(states, grid, window), own, decisions, seconds)


def ballot_states(ballot: Ballot, point_map: PointMap) -> tuple[U8, Grid]:
    """(rows, cols) decisions of the vehicle itself over the window of its tiles, two-stage or one-stage."""
    window = reduce(Grid.union, (point_map.lattice.tile(tile.tile) for tile in ballot.tiles))
    out = np.full(window.shape, NO_VOTE, dtype=np.uint8)
    for tile in ballot.tiles:
        if tile.states is not None:
            states = unpack_states(tile.states)
        else:
            states = plurality(unpack_tally(tile.tally or b"").astype(np.int32))
        out[point_map.lattice.tile(tile.tile).slices_in(window)] = states
    return out, window


class KeptDrive:
    """Sightings of the scans of one drive over the cells of ``window``, packed scan by scan."""

    def __init__(self, window: Grid, sensor: Sensor, n_min: int) -> None:
        self.window = window
        self.sensor = sensor
        self.n_min = n_min
        self._windows: list[tuple[int, int, int, int]] = []
        self._packed: list[bytes] = []

    def watch(self, observations: Sequence[Observation]) -> None:
        """Keep what these scans say."""
        for seen in observations:
            grid = seen.view.grid
            self._windows.append((grid.row0 - self.window.row0, grid.col0 - self.window.col0, *grid.shape))
            self._packed.append(
                pack_plane(sightings(seen, self.sensor, self.n_min), 1)
            )  # zstd level 1: written once, read for every reading

    def write(self, folder: Path) -> None:
        """Into a file of ``folder``."""
        words = np.frombuffer(b"".join(self._packed), dtype=np.uint8)
        windows = np.array(self._windows, dtype=np.int32).reshape(-1, 4)
        np.savez(folder / "kept.npz", windows=windows, sizes=list(map(len, self._packed)), words=words)


Words = Sequence[tuple[int, int, bytes, tuple[int, int]]]
"""For each scan of a drive: row and column of its local grid from the truth's corner, its words packed, their shape."""


def read_kept(folder: Path) -> Words:
    """Read the file that :meth:`KeptDrive.write` wrote."""
    with np.load(folder / "kept.npz") as file:
        ends = np.cumsum(file["sizes"])
        words = file["words"].tobytes()
        packed = [words[start:end] for start, end in zip([0, *ends], ends, strict=False)]
        return [(r, c, one, (h, w)) for (r, c, h, w), one in zip(file["windows"].tolist(), packed, strict=True)]


PUBLISHED = "as_published"
"""The scenario of the paper's street. Its first map keeps its strays: the paper's holds whatever stood still (II), and
its cases vote on that. Both readings of an occluded scan stand side by side in its tables."""


def as_paper(settings: Settings, scenario: str, stated: Collection[str] = (), reading: str | None = None) -> Settings:
    """``settings`` with the paper read as ``reading`` says, and with a map like the paper's on the paper's street.

    ``stated``: names ("mapping.drop_strays") of settings that the user set: they stay. MapvoteError for a reading that
    does not exist.
    """
    adapted = settings
    if reading:
        adapted = adapted.model_copy(update={"paper": read(adapted.paper, reading)})
    if scenario == PUBLISHED and "mapping.drop_strays" not in stated:
        adapted = adapted.model_copy(update={"mapping": adapted.mapping.model_copy(update={"drop_strays": False})})
    return adapted


CountedBy = tuple[VotingSettings, PaperSettings]
"""By which a vehicle counts."""


@kernel
def _cast(
    words: U16, row0: int, col0: int, margin: int, mapped: Bool, states: U8, weights: I32, no_vote: int, tally: I32
) -> None:
    """Add one scan's ``words``, from (row0, col0) of the window, to ``tally`` (rows, cols, classes), in place.

    ``margin``: cells at the rim of the scan's window that do not vote.
    """
    rows, cols = mapped.shape
    for i in range(max(margin, -row0), min(words.shape[0] - margin, rows - row0)):
        for j in range(max(margin, -col0), min(words.shape[1] - margin, cols - col0)):
            r = row0 + i
            c = col0 + j
            word = words[i, j]
            state = states[np.int64(mapped[r, c]), word]
            if state != no_vote:
                tally[r, c, state] += weights[word]


def tallies(drive: Words, mapped: Bool, rules: Iterable[CountedBy]) -> dict[CountedBy, I32]:
    """(rows, cols, 5) votes in VOTE_UNITs of one drive by each rule, over the truth's window.

    ``mapped`` (rows, cols): where the map holds obstacle points.
    """
    tally_of = {rule: np.zeros((*mapped.shape, N_STATES), dtype=np.int32) for rule in rules}
    for row0, col0, packed, shape in drive:
        raw = unpack_bytes(packed, 2 * shape[0] * shape[1], "a kept scan")
        words = np.frombuffer(raw, dtype="<u2").reshape(shape)
        for rule, tally in tally_of.items():
            half = round(0.5 * rule[1].window_m / CELL_SIZE)
            margin = max(0, words.shape[0] // 2 - half)
            _cast(words, row0, col0, margin, mapped, *reading_table(*rule), NO_VOTE, tally)
    return tally_of


def counting_rule(case: Case) -> CountedBy:
    """Cases that differ only in the server's decision count alike."""
    return case.voting.model_copy(update={"two_stage": True}), case.paper


def decided(drives: Sequence[Words], mapped: Bool, cases: Sequence[Case]) -> dict[str, tuple[U8, list[U8]]]:
    """By case's name: (what the server decides, what each vehicle does), over the truth's window."""
    rules = list(dict.fromkeys(counting_rule(case) for case in cases))
    counted = [tallies(drive, mapped, rules) for drive in drives]
    own = {rule: [plurality(one[rule]) for one in counted] for rule in rules}
    out = {}
    for case in cases:
        rule = counting_rule(case)
        if case.voting.two_stage:
            votes = [one_hot(states) for states in own[rule]]
        else:
            votes = [to_wire(one[rule]).astype(np.int32) for one in counted]
        out[case.name] = plurality(np.stack(votes).sum(axis=0, dtype=np.int32)), own[rule]
    return out


def swept(
    drives: Sequence[Words], mapped: Bool, settings: Settings, truths: Mapping[str, U8],
    only: str | None = None, progress: Progress = untold,
) -> dict[str, dict[str, dict[str, Scores]]]:  # fmt: skip
    """Scores by reading, case and truth: as ``settings`` read the paper, and one sentence at a time read otherwise.

    ``only``: the sentence (a setting of ``[paper]``) whose readings are wanted; None: all.
    """
    readings = readings_of(settings.paper, only)
    out: dict[str, dict[str, dict[str, Scores]]] = {}
    for k, (name, paper) in enumerate(readings.items()):
        progress("reading the paper", k, len(readings))
        every = paper_cases(settings.model_copy(update={"paper": paper}))
        states = decided(drives, mapped, [every[number] for number in "12345"])
        out[name] = {
            number: {truth: score_cells(server, cells) for truth, cells in truths.items()}
            for number, (server, _) in states.items()
        }
    progress("reading the paper", len(readings), len(readings))
    return out
