"""Overlapping maps become one: registered to each other, adjusted together, one point a voxel.

The paper's first map is made so ([9]: mapping, then merging of several maps). Every pair that overlaps gives one link
of a pose graph over the maps. The first map stays where it is, unless all of them state one frame. Maps that contradict
each other after that are refused. Built maps carry how many scans hit each voxel: noise is judged by the scans of all
surveys together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.compare.free_space import with_free_space_of
from mapvote.compare.register import Registered, register_maps
from mapvote.core.geometry import inverse, inverses, poses_at, transform
from mapvote.core.grid import Lattice
from mapvote.core.point_map import SCANS, SOURCES, PointMap, all_fields, all_points, map_from_points
from mapvote.core.record import record
from mapvote.core.types import F64, MapvoteError
from mapvote.core.voxels import VoxelCloud, voxel_keys
from mapvote.formats.maps.tiling import GPS_TIMES, UNCHECKED
from mapvote.survey.clean_map import specks, strays
from mapvote.survey.driven_road import road_under
from mapvote.survey.pose_graph import Anchors, Links, optimise


@record()
@dataclass(frozen=True, slots=True)
class Merging:
    """Numbers of the adjustment of several maps."""

    most_apart_m: float = 0.1
    """Greatest distance of the patches of a pair (median), after the adjustment, unless another bound is given."""
    held: float = 1e-4
    """Sigma, metres and radians, that holds the first map in its place."""
    same_frame_m: float = 0.5
    """Shift up to which maps that were registered lie in one stated frame."""
    same_frame_rad: float = float(np.radians(0.5))
    """Sigma of the attitude of a map that states this frame."""


MERGING = Merging()


@dataclass(frozen=True, slots=True)
class Merged:
    """One map of several."""

    point_map: PointMap
    T_first_each: F64
    """(k, 4, 4) where each map lies in the frame of the first."""
    apart_m: dict[tuple[int, int], float]
    """Median distance of the patches of each pair that overlaps, after the adjustment."""


def merge_maps(maps: Sequence[PointMap], *, most_apart_m: float = MERGING.most_apart_m) -> Merged:
    """One map on the lattice and in the frame of the first, or in the mean of their frames if all state one.

    The ground is computed anew, from the driven paths where the maps carry them; the paths stay. A voxel is free if its
    middle lies in one that a map knows to be free, and no map has a point in it. Each point's field SOURCES has bit k
    set where map k has a point in its voxel.

    MapvoteError, with figures, if a map overlaps no other one, is bent, or lies more than ``most_apart_m`` off another
    (median of the patches).
    """
    most = 64  # bits of a point's sources
    if not 2 <= len(maps) <= most:
        raise MapvoteError(f"merge: give 2 to {most} maps, not {len(maps)}; merge more in steps")
    clouds = [all_points(one) for one in maps]
    pairs = {}
    reasons = {}
    for i, j in combinations(range(len(maps)), 2):
        try:
            pairs[i, j] = register_maps(maps[i], maps[j])
        except MapvoteError as error:
            reasons[i, j] = str(error)
    T = _adjusted(maps, pairs, reasons, np.array([np.median(cloud, axis=0) for cloud in clouds]))
    apart_m = {(i, j): float(np.median(one.patches.apart_m(inverse(T[i]) @ T[j]))) for (i, j), one in pairs.items()}
    _refuse_contradictions(pairs, apart_m, most_apart_m)
    return Merged(_laid(maps, clouds, T), T, apart_m)


def _adjusted(
    maps: Sequence[PointMap],
    pairs: dict[tuple[int, int], Registered],
    reasons: dict[tuple[int, int], str],
    middles: F64,
    numbers: Merging = MERGING,
) -> F64:
    """(n, 4, 4) where the maps lie in the first one's frame: along the pairs, then all links together.

    Surveys of one lattice that lie within ``same_frame_m`` of where they say, at their ``middles`` (n, 3), state one
    frame, each with the error of its own prior: then no map is right alone, and the adjusted frame is the mean of
    theirs."""
    T = _along_the_pairs(len(maps), pairs, reasons)
    # The graph holds each map's middle in a frame about the first one's middle: in the coordinates of a country the
    # error of a turn would be multiplied by the distance from their origin.
    about = poses_at(middles)
    nodes = inverse(about[0]) @ T @ about
    links = [
        Links(
            np.array([i]),
            np.array([j]),
            (inverse(about[i]) @ one.T_a_b @ about[j])[None],
            one.fit.sigma_m,
            float(np.radians(one.fit.sigma_deg)),
        )
        for (i, j), one in pairs.items()
    ]
    # One stated frame, or that of the first map.
    moved_m = [np.linalg.norm(transform(T[k], middles[k][None])[0] - middles[k]) for k in range(len(maps))]
    apart = any(one.lattice != maps[0].lattice or _place(one) != _place(maps[0]) for one in maps)
    if apart or any(far_m > numbers.same_frame_m for far_m in moved_m):
        anchors = Anchors(np.array([0]), np.eye(4)[None], numbers.held, numbers.held)
    else:
        anchors = Anchors(np.arange(len(T)), inverse(about[0]) @ about, numbers.same_frame_m, numbers.same_frame_rad)
    return np.asarray(about[0] @ optimise(nodes, links, [anchors], iterations=10) @ inverses(about))


def _place(one: PointMap) -> dict[str, str]:
    """The frame that a map states; the times of its points are no part of it."""
    return {name: text for name, text in one.georeference.items() if name not in (GPS_TIMES, UNCHECKED)}


def _along_the_pairs(n: int, pairs: dict[tuple[int, int], Registered], reasons: dict[tuple[int, int], str]) -> F64:
    """(n, 4, 4) where the maps lie in the first one's frame, each by one pair. MapvoteError where no pair leads."""
    T = np.tile(np.eye(4), (n, 1, 1))
    placed = {0}
    while len(placed) < n:
        step = next(((i, j) for i, j in pairs if (i in placed) != (j in placed)), None)
        if step is None:
            lost = min(set(range(n)) - placed)
            listed = "; ".join(f"with map {min(p) + 1}: {text}" for p, text in reasons.items() if lost in p)
            raise MapvoteError(f"map {lost + 1} cannot be registered to any of the others ({listed})")
        i, j = step
        if i in placed:
            T[j] = T[i] @ pairs[step].T_a_b
        else:
            T[i] = T[j] @ inverse(pairs[step].T_a_b)
        placed |= {i, j}
    return T


def _refuse_contradictions(
    pairs: dict[tuple[int, int], Registered], apart_m: dict[tuple[int, int], float], most_apart_m: float
) -> None:
    bent = [f"maps {i + 1} and {j + 1}: {part.told()}" for (i, j), one in pairs.items() for part in one.bent]
    if bent:
        raise MapvoteError(
            f"the maps contradict each other: {'; '.join(bent)}. Build one map of all drives "
            "(mapvote build DRIVE DRIVE)"
        )
    apart = [
        f"maps {i + 1} and {j + 1} are {far:.2f} m apart (median of {int(pairs[i, j].patches.compared.sum())} patches)"
        for (i, j), far in apart_m.items()
        if far > most_apart_m
    ]
    if apart:
        raise MapvoteError(
            f"the maps contradict each other by more than {most_apart_m:g} m after adjustment: {'; '.join(apart)}. "
            "Build one map of all drives (mapvote build DRIVE DRIVE), or accept the difference by --apart M: walls "
            "then become as thick as the maps lie apart"
        )


def _laid(maps: Sequence[PointMap], clouds: Sequence[F64], T: F64) -> PointMap:
    first = maps[0]
    cloud = VoxelCloud(first.lattice)
    moved = [transform(T_first, points) for T_first, points in zip(T, clouds, strict=True)]
    for points in moved:
        cloud.enter(points)
    driven = [transform(T_first, path) for one, T_first in zip(maps, T, strict=True) for path in one.driven]
    points = cloud.points()[0]
    roads = [road_under(poses_at(path), np.ones(len(path), dtype=np.bool_), points) for path in driven]
    merged = map_from_points(
        points,
        lattice=first.lattice,
        georeference=first.georeference,
        road=np.concatenate(roads) if roads else None,
        fields=_joint_fields(points, maps, moved, first.lattice),
    )
    merged = _without_strays(merged, maps, T)
    ends = [one.surveyed_ns for one in maps]
    surveyed_ns = max(end for end in ends if end is not None) if all(end is not None for end in ends) else None
    merged = with_free_space_of(merged, maps, T)
    return replace(merged, driven=tuple(driven), surveyed_ns=surveyed_ns)


def _joint_fields(
    points: F64, maps: Sequence[PointMap], moved: Sequence[F64], lattice: Lattice
) -> dict[str, NDArray[Any]]:
    """SOURCES and SCANS (n,) of the merged points, one a voxel. SOURCES has bit k set where map k has a point in the
    voxel. SCANS is the sum over all maps; 0 if one of the points is not counted."""
    keys = voxel_keys(points, lattice.x0, lattice.y0)
    order = np.argsort(keys)
    sources = np.zeros(len(points), dtype=np.uint64)
    scans = np.zeros(len(points), dtype=np.int64)
    uncounted = np.zeros(len(points), dtype=np.bool_)
    for k, (one, cloud) in enumerate(zip(maps, moved, strict=True)):
        wanted = voxel_keys(cloud, lattice.x0, lattice.y0)
        at = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
        there = keys[at] == wanted  # but where a mean was rounded into the next voxel
        counts = all_fields(one).get(SCANS, np.zeros(len(cloud), dtype=np.uint8))
        sources[at[there]] |= np.uint64(1) << np.uint64(k)
        np.add.at(scans, at[there], counts[there])
        uncounted[at[there & (counts == 0)]] = True
    scans[uncounted] = 0
    return {SOURCES: sources, SCANS: np.minimum(scans, 255).astype(np.uint8)}


def _without_strays(merged: PointMap, maps: Sequence[PointMap], T: F64) -> PointMap:
    """The map without the points that all counted surveys together show to be noise, as `build` drops them: one survey
    hit them once, and the others passed as near and did not."""
    driven = [
        transform(T_first, path)
        for one, T_first in zip(maps, T, strict=True)
        if SCANS in one.field_names
        for path in one.driven
    ]
    if not driven:
        return merged
    points = all_points(merged)
    scans = all_fields(merged)[SCANS].astype(np.int32)
    indices = sorted(merged.tiles)
    standing = np.concatenate([merged.tiles[index].columns[1] for index in indices])
    counted = np.flatnonzero(standing & (scans > 0))
    dropped = np.zeros(len(points), dtype=np.bool_)
    dropped[counted] = strays(points[counted], scans[counted], np.concatenate(driven), merged.lattice)
    left = np.flatnonzero(standing & ~dropped)
    dropped[left] = specks(points[left], np.where(scans > 0, scans, 255)[left], merged.lattice)
    ends = np.cumsum([len(merged.tiles[index].points) for index in indices])
    parts = zip(indices, np.split(dropped, ends[:-1]), strict=True)
    return replace(merged, tiles={index: merged.tiles[index].without(part) for index, part in parts})
