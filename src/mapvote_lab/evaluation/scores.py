"""Scores against the truth: cells (paper V, Tables II-IV), points of the map, objects, probabilities.

Every ratio is 0.0 where nothing is counted (0/0 = 0), so that no score is ever NaN.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import F64, I64, NO_VOTE, U8, Bool, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.core.voxels import found_among
from mapvote.fusion.fuse import Decision
from mapvote.fusion.loss_budget import alike_beside, change_probability
from mapvote_lab.simulation.truth import Label

NEIGHBOURS = np.ones((3, 3), dtype=np.bool_)
"""A cell and the eight around it."""


@record()
@dataclass(frozen=True, slots=True)
class ScoreRule:
    """Limits of an object, of a found one, and of a visible one."""

    least_object_m2: float = 1.0
    """Area from which a group of changed cells is an object, square metres."""
    beside_cells: int = 2
    """A decided object is no invention if a true cell of its class lies this near, cells."""
    found_share: float = 0.5
    """A true object is found if this share of its changed cells was decided so."""
    visible_share: float = 0.05
    """A demolished object has a visible rest if more than this share of its points is left."""
    visible_points: int = 20
    """A visible rest has more points than this."""
    bins: int = 10
    """Bins of equal width, from 0 to 1, in which probabilities are held against the truth."""


SCORE_RULE = ScoreRule()


def ratio(part: float | np.integer, whole: float | np.integer) -> float:
    """part / whole, 0.0 where whole is 0."""
    return float(part / whole) if whole else 0.0


class ByClass(msgspec.Struct, frozen=True):
    """A number for each of the paper's three scored classes; iterates in the order of ``Label``."""

    unchanged: float
    changed_occupied: float
    changed_empty: float

    def __iter__(self) -> Iterator[float]:
        return iter((self.unchanged, self.changed_occupied, self.changed_empty))

    @property
    def mean(self) -> float:
        """Unweighted."""
        return sum(self) / 3.0


class Scores(msgspec.Struct, frozen=True):
    """Precision and recall of the three classes, and what follows from them; made by :meth:`of`."""

    precision: ByClass
    recall: ByClass
    f1: ByClass
    macro_f1: float
    """Unweighted mean of the three F1: what Table IV holds (docs/method.md)."""
    kim_f1: float
    """Harmonic mean of mean precision and mean recall, as Kim et al. [15] report it."""

    @classmethod
    def of(cls, precision: ByClass, recall: ByClass) -> Scores:
        """All scores from the two."""

        def harmonic_mean(p: float, r: float) -> float:
            return ratio(2.0 * p * r, p + r)

        f1 = ByClass(*map(harmonic_mean, precision, recall))
        return cls(precision, recall, f1, f1.mean, harmonic_mean(precision.mean, recall.mean))


def classes_of(states: U8) -> U8:
    """Five states to the three scored classes: undetermined and never seen count as unchanged."""
    out = np.zeros(states.shape, dtype=np.uint8)
    out[states == CellState.CHANGED_OCCUPIED] = 1
    out[states == CellState.CHANGED_EMPTY] = 2
    return out


def score_cells(states: U8, truth: U8) -> Scores:
    """Precision and recall of decided ``states`` (CellState or NO_VOTE) against ``truth`` (0, 1, 2 or 255)."""
    scored = truth != Label.UNSCORED
    pairs = truth[scored].astype(np.int64) * 3 + classes_of(states)[scored]
    table = np.bincount(pairs, minlength=9).reshape(3, 3)
    right = np.diag(table)
    decided = table.sum(axis=0)
    true = table.sum(axis=1)
    precision = ByClass(*(ratio(right[k], decided[k]) for k in range(3)))
    return Scores.of(precision, ByClass(*(ratio(right[k], true[k]) for k in range(3))))


def cells_with(points: NDArray[np.floating], grid: Grid) -> Bool:
    """(rows, cols) cells of ``grid`` that hold one of ``points`` (n, 2+), map metres."""
    rows, cols, inside = grid.indices_of(points)
    cells = np.zeros(grid.shape, dtype=np.bool_)
    cells[rows[inside], cols[inside]] = True
    return cells


def pieces(cells: Bool) -> Iterator[tuple[I64, I64]]:
    """(rows, cols) of the cells of each 8-connected group."""
    label, _ = ndimage.label(cells, NEIGHBOURS)
    for number, (rows, cols) in enumerate(ndimage.find_objects(label), 1):
        r, c = np.nonzero(label[rows, cols] == number)
        yield r + rows.start, c + cols.start


def determined(states: U8) -> Bool:
    """Cells with one of the four states that say something: neither undetermined nor never seen."""
    return (states != CellState.UNDETERMINED) & (states != NO_VOTE)


def determined_share(vehicle_states: Sequence[U8], truth: U8) -> float:
    """Share of the scored truth cells that at least one vehicle determined."""
    seen = np.zeros(truth.shape, dtype=np.bool_)
    for states in vehicle_states:
        seen |= determined(states)
    scored = truth != Label.UNSCORED
    return ratio(np.count_nonzero(seen & scored), np.count_nonzero(scored))


class ObjectScores(msgspec.Struct, frozen=True):
    """Connected changes against the truth."""

    found: tuple[bool, ...]
    """Per true object: at least half of its changed truth cells were decided so."""
    recall: tuple[float, ...]
    """Per true object: share of its changed truth cells decided so."""
    false_m2: tuple[float, ...]
    """Area of each decided object that touches no truth of its class, largest first."""


def score_objects(
    states: U8, truth: U8, objects: Sequence[Mapping[str, object]], rule: ScoreRule = SCORE_RULE
) -> ObjectScores:
    """``objects`` give ``cells`` (rows, cols) bool over the window and ``kind``: "built" or "demolished".

    A decided object is an 8-connected group of cells of one changed class of at least ``rule.least_object_m2``; it is
    false if no truth cell of its class, nor an unscored one, lies within ``rule.beside_cells`` of it (a wall one cell
    off is no invention). Objects with no truth cell (never reachable by a ray) are not asked for.
    """
    decided = classes_of(states)
    recalls = []
    for item in objects:
        kind = 1 if item["kind"] == "built" else 2
        wanted = np.asarray(item["cells"], dtype=np.bool_) & (truth == kind)
        if wanted.any():
            recalls.append(ratio(np.count_nonzero(wanted & (decided == kind)), np.count_nonzero(wanted)))
    false = []
    for kind in (1, 2):
        near = ndimage.binary_dilation(
            (truth == kind) | (truth == Label.UNSCORED), NEIGHBOURS, iterations=rule.beside_cells
        )
        for cells in pieces(decided == kind):
            area = len(cells[0]) * CELL_SIZE**2
            if area >= rule.least_object_m2 and not near[cells].any():
                false.append(area)
    are_found = tuple(share >= rule.found_share for share in recalls)
    return ObjectScores(are_found, tuple(recalls), tuple(round(area, 2) for area in sorted(false, reverse=True)))


class MapScores(msgspec.Struct, frozen=True, kw_only=True):
    """Effect of the update on the points (shares of points, or of surface samples for ``new_added``)."""

    stale_deleted: float
    """Old map points of removed surfaces that are gone."""
    valid_deleted: float
    """Old map points of standing surfaces that are gone: the damage done."""
    new_added: float
    """Samples of reachable new surface with a point of the updated map within reach."""
    added_false: float
    """Added points that lie on no surface of the new world."""
    added_false_scored: float
    """Those of them in cells that the truth scores: a car that was parked in some passes only is neither right nor
    wrong."""
    stale_points: int
    valid_points: int
    new_samples: int
    added_points: int


class ObjectRests(msgspec.Struct, frozen=True):
    """Points left and added of each true object, in the order of the truth."""

    left: tuple[float, ...]
    """Per demolished object of which the map held a point: share of its points left."""
    added: tuple[float, ...]
    """Per built object of which a ray could reach something: share of its reachable surface added."""
    visible: int
    """Demolished objects with a visible rest."""


class MapJudge:
    """Compares maps with noise-free surface samples of the two worlds; the old map is judged once.

    ``old_points`` (n, 3) are the obstacle points of the map before the update. ``kept``, ``added`` and ``removed``
    (m, 3) are surface samples, map metres: standing in both worlds, only in the new one, only in the old one. An old
    point is stale if a removed sample lies within ``reach_m`` and no kept or added one nearer; valid if the nearest
    sample within reach is a kept one. Points near no surface (trails, noise) are neither. ``scored``: which of points
    (n, 3) lie in cells that the truth scores; None: all.
    """

    def __init__(
        self,
        old_points: F64,
        kept: F64,
        added: F64,
        removed: F64,
        scored: Callable[[F64], Bool] | None = None,
        *,
        reach_m: float = 0.3,
        rule: ScoreRule = SCORE_RULE,
    ) -> None:
        self._rule = rule
        self._old = old_points
        self._added = added
        self._scored = scored
        self._reach_m = reach_m
        self._now = cKDTree(np.concatenate([kept, added]))
        to_removed = _distance(old_points, cKDTree(removed))
        to_kept = _distance(old_points, cKDTree(kept))
        to_now = _distance(old_points, self._now)
        self.stale = (to_removed <= reach_m) & (to_removed < to_now)
        self.valid = (to_kept <= reach_m) & (to_kept <= to_removed)

    def score(self, new_points: F64) -> MapScores:
        """``new_points`` (n, 3): the obstacle points of the updated map; an old one survives if found bit for bit."""
        survived, fresh = same_rows(self._old, new_points)
        reached = _distance(self._added, cKDTree(new_points)) <= self._reach_m
        false = fresh[_distance(fresh, self._now) > self._reach_m]
        scored = len(false) if self._scored is None else np.count_nonzero(self._scored(false))
        return MapScores(
            stale_deleted=ratio(np.count_nonzero(self.stale & ~survived), np.count_nonzero(self.stale)),
            valid_deleted=ratio(np.count_nonzero(self.valid & ~survived), np.count_nonzero(self.valid)),
            new_added=ratio(np.count_nonzero(reached), len(self._added)),
            added_false=ratio(len(false), len(fresh)),
            added_false_scored=ratio(scored, len(fresh)),
            stale_points=int(np.count_nonzero(self.stale)),
            valid_points=int(np.count_nonzero(self.valid)),
            new_samples=len(self._added),
            added_points=len(fresh),
        )

    def rests(self, new_points: F64, objects: Sequence[tuple[str, Callable[[F64], Bool]]]) -> ObjectRests:
        """``new_points`` as for :meth:`score`; ``objects``: ("built" or "demolished", which of points (n, 3) lie in
        it)."""
        survived, _ = same_rows(self._old, new_points)
        reached = _distance(self._added, cKDTree(new_points)) <= self._reach_m
        left = []
        added = []
        visible = 0
        for kind, inside in objects:
            if kind == "demolished":
                own = survived[self.stale & inside(self._old)]
                share = ratio(np.count_nonzero(own), len(own))
                left += [share] * bool(len(own))
                visible += int(share > self._rule.visible_share and np.count_nonzero(own) > self._rule.visible_points)
            else:
                own = reached[inside(self._added)]
                added += [ratio(np.count_nonzero(own), len(own))] * bool(len(own))
        return ObjectRests(tuple(left), tuple(added), visible)


def _distance(points: F64, surface: cKDTree) -> F64:
    """(n,) metres from each point to the nearest sample; inf beyond a metre or where there is none."""
    if not len(points) or not surface.n:
        return np.full(len(points), np.inf)
    distance: F64 = surface.query(points, distance_upper_bound=1.0)[0]
    return distance


def same_rows(old: F64, new: F64) -> tuple[Bool, F64]:
    """(which rows of ``old`` are in ``new``, the rows of ``new`` that are not in ``old``), compared bit for bit."""
    a, b = (np.asarray(points, dtype=np.float64) for points in (old, new))
    return found_among(a, b), new[~found_among(b, a)]


def map_obstacles(point_map: PointMap) -> F64:
    """The map's points (n, 3) at least GROUND_MARGIN_M above its ground, map metres, tile by tile."""
    clouds = []
    for tile in sorted(point_map.tiles):
        content = point_map.tiles[tile]
        clouds.append(content.points_map[content.columns[1]])
    return np.concatenate(clouds) if clouds else np.zeros((0, 3))


@dataclass(frozen=True, slots=True)
class Reliability:
    """Probabilities of the scored cells that were decided as one kind of change. Bins without a cell have NaN."""

    predicted: F64
    """(bins,) mean probability."""
    true: F64
    """(bins,) share of the cells that did change so."""
    cells: I64
    """(bins,)."""
    calibration_error: float
    """Mean distance of the two over the bins, weighed by their cells (ECE)."""
    brier: float
    """Mean square error of the probability, cell by cell."""


def reliability(
    decisions: Mapping[TileIndex, Decision],
    lattice: Lattice,
    truth: U8,
    window: Grid,
    state: CellState,
    rule: ScoreRule = SCORE_RULE,
) -> Reliability:
    """Hold the probabilities of the cells decided as ``state``, a changed one, against ``truth`` over ``window``.

    The probabilities are the server's (:func:`mapvote.fusion.loss_budget.change_probability`); votes are of vehicles,
    so ``decisions`` are two-stage ones.
    """
    # Every cell decided as ``state``: its place, and the votes for and against.
    parts = [np.zeros((5, 0), dtype=np.int64)]
    for index, decision in decisions.items():
        tile = lattice.tile(index)
        r, c = np.nonzero(decision.states == state)
        counts = decision.tally[r, c].astype(np.int64) // VOTE_UNIT
        votes = counts[:, state]
        against = counts[:, : CellState.UNDETERMINED].sum(axis=1) - votes  # undetermined ones say nothing
        parts.append(np.stack([tile.row0 + r, tile.col0 + c, votes, against, decision.odds.at(r * TILE_CELLS + c)]))
    rows, cols, votes, against, odds = np.concatenate(parts, axis=1)
    beside = alike_beside(rows, cols, np.zeros(len(rows), dtype=np.int64))
    states = np.full(len(rows), state, dtype=np.uint8)
    # The probability of each, and whether the truth agrees, where the truth is scored.
    probability = change_probability(states, votes, against, beside, odds.astype(np.int8))
    r = rows - window.row0
    c = cols - window.col0
    inside = (r >= 0) & (r < window.rows) & (c >= 0) & (c < window.cols)
    labels = truth[r[inside], c[inside]]
    scored = labels != Label.UNSCORED
    true = labels[scored] == (1 if state == CellState.CHANGED_OCCUPIED else 2)
    probability = probability[inside][scored]
    # Mean probability and share of true changes, bin by bin.
    bin_of = np.minimum((probability * rule.bins).astype(np.int64), rule.bins - 1)
    cells = np.bincount(bin_of, minlength=rule.bins)
    with np.errstate(invalid="ignore"):
        predicted = np.bincount(bin_of, weights=probability, minlength=rule.bins) / cells
        share = np.bincount(bin_of, weights=true, minlength=rule.bins) / cells
    apart = np.where(cells > 0, np.abs(np.nan_to_num(predicted) - np.nan_to_num(share)), 0.0)
    off = float((apart * cells).sum()), float(((probability - true) ** 2).sum())
    return Reliability(predicted, share, cells, ratio(off[0], len(probability)), ratio(off[1], len(probability)))


PAPER_SCORES = {
    "1": Scores.of(ByClass(0.996, 0.748, 0.550), ByClass(0.994, 0.998, 0.767)),
    "2": Scores.of(ByClass(0.996, 0.787, 0.536), ByClass(0.994, 0.954, 0.767)),
    "3": Scores.of(ByClass(0.996, 0.663, 0.556), ByClass(0.994, 0.987, 0.767)),
    "4": Scores.of(ByClass(0.995, 0.768, 0.499), ByClass(0.993, 0.882, 0.767)),
    "5": Scores.of(ByClass(0.996, 0.748, 0.645), ByClass(0.996, 0.998, 0.767)),
}
"""By case: precision (Table II) and recall (Table III) as printed, and what follows from them."""
PAPER_F1 = {"1": 0.830, "2": 0.829, "3": 0.811, "4": 0.807, "5": 0.850}
"""Table IV: the unweighted mean of the three classes' F1 (docs/method.md)."""


class PoseErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Errors of a drive's scans, over those that were localised."""

    scans: int
    localised: int
    median_m: float
    p99_m: float
    max_m: float
    median_deg: float


class CaseResult(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One case of ``evaluate``, or a yardstick: how decided cells compare with the truth, and what became of the
    map."""

    strict: Scores
    """Against all that changed where a survey's or a vehicle's ray could reach."""
    provenance: Scores
    """Against what changed of the points that the first map holds."""
    coverage: float
    """Share of the scored cells that some vehicle determined."""
    objects: ObjectScores
    also: dict[str, Scores] = {}
    """By the further truths of ``evaluation/truths.py``."""
    map: MapScores | None = None
    """None (not in the JSON) where no map was edited: the yardsticks only decide cells."""
    rests: ObjectRests | None = None
    """As ``map``."""
    bytes_per_vehicle: list[int]
    """Size of each ballot; empty for a yardstick, which sends none."""
    state_bytes_per_vehicle: list[int] | None = None
    """Size of the votes alone, without new points and other planes."""


class MapShift(msgspec.Struct, frozen=True):
    """How far the first map lies from the truth."""

    mean_m: float
    x_m: float
    y_m: float
    z_m: float
    p95_m: float


class Cost(msgspec.Struct, frozen=True):
    """Run time of one method on a vehicle."""

    beams: int
    ms_per_scan: float
    """Median, milliseconds."""
    memory_bytes: float
    """Size of its grid."""


class Timings(msgspec.Struct, frozen=True, kw_only=True):
    """Wall time, the only number of a run that is not repeatable."""

    prepare_s: float
    vote_s: float
    score_s: float
    yardsticks_s: float
    methods: dict[str, Cost]
    stages_ms: dict[str, dict[str, float]]
    """By vehicle and stage: median milliseconds a scan."""
    fuse_s: dict[str, float]
    """By case."""


class EvaluationResult(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One scenario and seed: what ``evaluate --json`` writes."""

    scenario: str
    seed: int
    poses: str
    """"ndt" or "truth"."""
    cells: int
    """In the truth's window."""
    coverage: float
    """Coverage of the case whose updated map is shown."""
    settings: dict[str, Any]
    map_shift: MapShift
    localisation: dict[str, PoseErrors]
    """By vehicle."""
    changed_areas: dict[str, PoseErrors]
    """One vehicle's scans near changes, by map."""
    ceilings: dict[str, Scores]
    """By truth: what perfect labels on every measured point would score in cells."""
    cases: dict[str, CaseResult]
    readings: dict[str, dict[str, dict[str, Scores]]] = {}
    """By reading of the paper, case and truth, if asked for."""
    timings: Timings


def to_json(result: msgspec.Struct | Mapping[str, Any]) -> str:
    """Indented, keys sorted; ValueError if a number is NaN or infinite."""
    return json.dumps(msgspec.to_builtins(result), indent=1, sort_keys=True, allow_nan=False) + "\n"
