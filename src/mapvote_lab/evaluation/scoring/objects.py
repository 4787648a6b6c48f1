"""Changed objects found, missed and made up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from scipy import ndimage

from mapvote.core.types import U8
from mapvote_lab.evaluation.scoring.cells import UNSCORED, classes_of, ratio


class ObjectScores(msgspec.Struct, frozen=True):
    """Connected changes against the truth."""

    found: tuple[bool, ...]
    """Per true object: at least half of its changed truth cells were decided so."""
    met: tuple[bool, ...]
    """Per true object: a connected change of ``min_m2`` was decided on its truth cells (all of them, if less)."""
    recall: tuple[float, ...]
    """Per true object: share of its changed truth cells decided so."""
    false_m2: tuple[float, ...]
    """Area of each decided object that touches no truth of its class, largest first."""


def score_objects(
    states: U8, truth: U8, objects: Sequence[Mapping[str, object]], cell_size: float, *, min_m2: float = 1.0
) -> ObjectScores:
    """``objects`` give ``cells`` (rows, cols) bool over the window and ``kind``: "built" or "demolished".

    A decided object is an 8-connected group of cells of one changed class of at least ``min_m2``; it is false if
    no truth cell of its class, nor an unscored one, lies within two cells of it (a wall one cell off is no invention).
    Objects with no truth cell (never reachable by a ray) are not asked for.
    """
    decided = classes_of(states)
    neighbours = np.ones((3, 3), dtype=np.bool_)
    recalls, met = [], []
    for item in objects:
        kind = 1 if item["kind"] == "built" else 2
        wanted = np.asarray(item["cells"], dtype=np.bool_) & (truth == kind)
        if wanted.any():
            right = wanted & (decided == kind)
            recalls.append(ratio(np.count_nonzero(right), np.count_nonzero(wanted)))
            pieces = np.bincount(ndimage.label(right, structure=neighbours)[0].ravel())[1:]
            least = min(min_m2, np.count_nonzero(wanted) * cell_size**2)
            met.append(bool(max(pieces, default=0) * cell_size**2 >= least))
    false = []
    for kind in (1, 2):
        labels, count = ndimage.label(decided == kind, structure=neighbours)
        near = ndimage.binary_dilation((truth == kind) | (truth == UNSCORED), structure=neighbours, iterations=2)
        sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:] * cell_size**2
        touched = np.bincount(labels[near], minlength=count + 1)[1:] > 0
        false += [float(size) for size, real in zip(sizes, touched, strict=True) if size >= min_m2 and not real]
    found = tuple(share >= 0.5 for share in recalls)
    return ObjectScores(
        found, tuple(met), tuple(recalls), tuple(round(area, 2) for area in sorted(false, reverse=True))
    )
