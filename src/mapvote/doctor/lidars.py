"""Do the LiDARs of one vehicle see the same street where /tf_static, or drive.toml, says that they sit?

The points of each other LiDAR are matched with those of the first in the same sweep: as stated, and with the places of
two LiDARs exchanged, which is what exchanged frame ids do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import scipy

from mapvote.core.geometry import exp, inverse, log, transform
from mapvote.core.record import record
from mapvote.core.sampling import evenly
from mapvote.core.types import F32, F64, Drive
from mapvote.doctor import Finding
from mapvote.matching.matcher import likelihood_at
from mapvote.matching.ndt_map import NDT_WINDOW, NdtMap
from mapvote.matching.prepare import thin_for_levels


@record()
@dataclass(frozen=True, slots=True)
class SweepRules:
    """Numbers of the check that several LiDARs sit as stated."""

    sweeps: int = 5
    """Number of sweeps that are compared, spread over the drive."""
    window_m: float = 60.0
    """Half the side of the map of the first LiDAR's points, metres."""
    better: float = 1.25
    """Least ratio of the fit of exchanged places to that of the stated ones that shows an exchange."""
    least_fit: float = 0.3
    """Mean likelihood below which a LiDAR sees too little of what the first one sees."""
    off_m: float = 0.15
    """Greatest distance of a LiDAR from its stated place that is not reported, metres."""
    off_deg: float = 1.5
    """Greatest rotation of a LiDAR from its stated attitude that is not reported, degrees."""


RULES = SweepRules()


def check_lidars(
    drive: Drive, topics: Sequence[str], T_base_lidars: F64, rules: SweepRules = RULES
) -> Iterator[Finding]:
    """Findings on a drive of several LiDARs: ``topics``, and their stated mounts (n, 4, 4) on the vehicle."""
    sweeps = list(_sweeps(drive, T_base_lidars, rules))
    if not sweeps:
        return
    stated = _places(T_base_lidars)
    fits: dict[tuple[int, ...], float] = {(): float(np.median([_fit(one, stated, rules) for one in sweeps]))}
    for pair in combinations(range(len(topics)), 2):
        exchanged = _places(_exchanged(T_base_lidars, pair))
        fits[pair] = float(np.median([_fit(one, exchanged, rules) for one in sweeps]))
    best = max(fits, key=lambda pair: fits[pair])
    if best and fits[best] > rules.better * fits[()] and fits[best] > rules.least_fit:
        a, b = (topics[k] for k in best)
        problem = (
            f"the frames of {a} and {b} are swapped: with their places exchanged the LiDARs see the same street to "
        )
        problem += f"{fits[best]:.0%}, as stated to {fits[()]:.0%}"
        mend = f"exchange the frame_ids in the drivers, or {_line(topics, _exchanged(T_base_lidars, best))}"
        yield Finding("error", problem, mend)
    elif fits[()] < rules.least_fit:
        problem = (
            f"the LiDARs see too little in common to say whether they sit as stated ({fits[()]:.0%} of the points)"
        )
        yield Finding("note", problem)
    else:
        yield from _measured(sweeps, topics, T_base_lidars, rules)


def _line(topics: Sequence[str], T_base_lidars: F64) -> str:
    """The line of drive.toml that states where the LiDARs sit."""
    lines = []
    for topic, T in zip(topics, T_base_lidars, strict=True):
        rpy_deg = scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)
        lines.append(f'"{topic}" = [{", ".join(f"{v:.4f}" for v in (*T[:3, 3], *rpy_deg))}]')
    return f"write into drive.toml: mounts = {{{', '.join(lines)}}}"


def _exchanged(T: F64, pair: tuple[int, ...]) -> F64:
    out = T.copy()
    out[list(pair)] = T[list(reversed(pair))]
    return out


def _places(T_base_lidars: F64) -> F64:
    """(n - 1, 4, 4) T_first_other."""
    return np.asarray(inverse(T_base_lidars[0]) @ T_base_lidars[1:])


def _sweeps(drive: Drive, T_base_lidars: F64, rules: SweepRules) -> Iterator[list[F32]]:
    """The points of each LiDAR, in its own axes, of sweeps in which all took part."""
    stated = _places(T_base_lidars)
    for i in evenly(0, len(drive) - 1, rules.sweeps).tolist():
        parts = [part.points for _, part in drive.read_scan(i).by_lidar()]
        if len(parts) == len(T_base_lidars):
            own = [transform(inverse(T), p).astype(np.float32) for T, p in zip(stated, parts[1:], strict=True)]
            yield [parts[0], *own]


def _map_of(points: F32, rules: SweepRules) -> NdtMap:
    ndt_map = NdtMap(np.zeros(3), numbers=replace(NDT_WINDOW, half_window_m=rules.window_m))
    ndt_map.enter(points.astype(np.float64))
    return ndt_map


def _fit(sweep: list[F32], T_first_others: F64, rules: SweepRules) -> float:
    """Mean likelihood of the other LiDARs' points among those of the first."""
    ndt_map = _map_of(sweep[0], rules)
    pairs = zip(sweep[1:], T_first_others, strict=True)
    return float(np.mean([likelihood_at(ndt_map, thin_for_levels(points)[0], T) for points, T in pairs]))


def _measured(
    sweeps: list[list[F32]], topics: Sequence[str], T_base_lidars: F64, rules: SweepRules
) -> Iterator[Finding]:
    """Where the points lay each other LiDAR, if that is elsewhere by more than matching errs."""
    stated = _places(T_base_lidars)
    maps = [_map_of(sweep[0], rules) for sweep in sweeps]
    for k, T in enumerate(stated):
        clouds = [thin_for_levels(sweep[k + 1]) for sweep in sweeps]
        registered = [one.refine(cloud, T).T_map_lidar for one, cloud in zip(maps, clouds, strict=True)]
        off = np.median([log(inverse(T) @ T_found) for T_found in registered], axis=0)
        spread = np.median([np.abs(log(inverse(T) @ T_found) - off) for T_found in registered], axis=0)
        off_m = float(np.linalg.norm(off[:3]))
        off_deg = float(np.degrees(np.linalg.norm(off[3:])))
        steady = np.linalg.norm(spread[:3]) < 0.3 * off_m or np.degrees(np.linalg.norm(spread[3:])) < 0.3 * off_deg
        if steady and (off_m > rules.off_m or off_deg > rules.off_deg):
            problem = f"the points of {topics[k + 1]} show it {off_m:.2f} m and {off_deg:.1f} deg off its stated place"
            measured = T_base_lidars.copy()
            measured[k + 1] = T_base_lidars[0] @ T @ exp(off)
            yield Finding("warning", problem, f"{_line(topics, measured)}; or leave it out with --topic")
