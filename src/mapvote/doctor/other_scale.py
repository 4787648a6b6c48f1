"""Is the map in another scale than the scans? Scans made larger and smaller are registered to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mapvote.core.types import F64, Scan
from mapvote.doctor.finding import Progress
from mapvote.doctor.places import Place, register_all, total_fit
from mapvote.localisation.map_window import MapWindow

_SCALES = (0.92, 0.94, 0.96, 0.98, 1.02, 1.04, 1.06, 1.08)
"""A fit shows up to 1.5 % beside the right one."""
_FINER = 0.01
_LOOKED_AT = 3


def _scaled_guess(T: F64, scale: float, centre: F64) -> F64:
    """The pose (4, 4) in a map that is ``scale`` times as large about ``centre`` (3,)."""
    out = T.copy()
    out[:3, 3] = centre + scale * (T[:3, 3] - centre)
    return out


def in_another_scale(
    around: MapWindow,
    scans: Mapping[int, Scan],
    T: F64,
    range_sigma_m: float,
    tell: Progress | None,
) -> tuple[float, list[Place]]:
    """(the scale under which most scans fit, their places so); (1, []) if none does.

    Scans and the prior's positions T (n, 4, 4) are scaled together, about the middle of the drive.
    """
    some = list(scans)[:: max(1, len(scans) // _LOOKED_AT)][:_LOOKED_AT]
    middle = T[:, :3, 3].mean(axis=0)

    def places(scale: float, index: Sequence[int]) -> list[Place]:
        scaled = {i: Scan(scans[i].stamp_ns, np.asarray(scale * scans[i].points, dtype=np.float32)) for i in index}
        guesses = {i: [_scaled_guess(T[i], scale, middle)] for i in index}
        return register_all(around, scaled, guesses, range_sigma_m, None)

    tried: list[tuple[float, float]] = []
    for k, scale in enumerate(_SCALES):
        tried.append((total_fit(places(scale, some)), scale))
        if tell is not None:
            tell("trying other scales", k + 1, len(_SCALES))
    best, scale = max(tried, key=lambda one: one[0])
    if best == 0.0:
        return 1.0, []
    beside = [total_fit(places(scale * (1.0 + step), some)) for step in (-_FINER, _FINER)]
    scale *= 1.0 + _FINER * _peak(beside[0], best, beside[1])
    return scale, places(scale, list(scans))


def _peak(before: float, at: float, after: float) -> float:
    """Where the parabola through three values one step apart is highest, in steps, at most one."""
    bend = before - 2.0 * at + after
    return float(np.clip(0.5 * (before - after) / bend, -1.0, 1.0)) if bend < 0 else float(np.sign(after - before))
