"""The paper's own results, as printed (paper V): Tables II, III and IV. For comparison; nothing is tuned to them."""

from __future__ import annotations

from mapvote_lab.evaluation.scoring.cells import ByClass, Scores

PRECISION: dict[str, tuple[float, float, float]] = {
    "1": (0.996, 0.748, 0.550),
    "2": (0.996, 0.787, 0.536),
    "3": (0.996, 0.663, 0.556),
    "4": (0.995, 0.768, 0.499),
    "5": (0.996, 0.748, 0.645),
}
"""Table II: unchanged, changed (occupied), changed (empty)."""
RECALL: dict[str, tuple[float, float, float]] = {
    "1": (0.994, 0.998, 0.767),
    "2": (0.994, 0.954, 0.767),
    "3": (0.994, 0.987, 0.767),
    "4": (0.993, 0.882, 0.767),
    "5": (0.996, 0.998, 0.767),
}
"""Table III."""
F1 = {"1": 0.830, "2": 0.829, "3": 0.811, "4": 0.807, "5": 0.850}
"""Table IV: the unweighted mean of the three classes' F1 (docs/method.md)."""
SCORES = {case: Scores.of(ByClass(*PRECISION[case]), ByClass(*RECALL[case])) for case in PRECISION}
