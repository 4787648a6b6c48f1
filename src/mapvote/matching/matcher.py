"""The door of scan matching: what localisation asks of a matcher, and the table of matchers.

A matcher lays a finished map out around a vehicle (:class:`MapAround`) and answers four questions about a place in it
(:class:`LocalMatcher`). The tracker, the pose check and the search of a whole map ask nothing else. NDT is one
(matching/ndt_map.py), VGICP another (matching/vgicp.py). Another distribution adds one by an entry point of the group
``mapvote.matchers`` that loads a function ``point_map -> MapAround`` (docs/extending.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Protocol

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import F32, F64, Bool, MapvoteError, PosePrior, Registration


@record(votes=True)
@dataclass(frozen=True, slots=True)
class Convergence:
    """End of the steps at one level."""

    settled: tuple[float, float] = 0.05, 0.01
    """Steps, as shares of a level's floor, below which an alignment has converged: on the way, and at the finest
    level."""


CONVERGENCE = Convergence()


class LocalMatcher(Protocol):
    """A part of the map, ready to be matched with scans taken in its middle.

    Clouds are (3, n) float32 rows x, y, z of the lidar frame, de-skewed, one per level of
    :data:`mapvote.matching.ndt_voxels.LEVELS`, coarse to fine; a matcher of fewer levels takes the last ones, and those
    before the first level that is asked for may be missing. Poses are T_map_lidar (4, 4).
    """

    def refine(
        self,
        clouds: Sequence[F32],
        T_map_lidar_guess: F64,
        prior: PosePrior | None = None,
        first_level: int = 0,
        settled: tuple[float, float] = CONVERGENCE.settled,
    ) -> Registration:
        """The pose of a scan from a guess. ``first_level``: the coarsest level that the guess needs. ``settled``: see
        :class:`Convergence`; larger for a hurried look. Never raises for bad overlap: then score and inlier share are
        low, and the caller abstains."""
        ...

    def likelihood(self, cloud: F32, T_map_lidar: F64, level: int = 0) -> F64:
        """(m,) mean likelihood in [0, 1] of a cloud at each of the poses (m, 4, 4), to rank places. ``level`` -1 is the
        finest."""
        ...

    def expected(self, points_map: F64, noise_m: float) -> tuple[F64, Bool]:
        """The likelihoods (k,) that the finest level leads to expect of returns from the points (n, 3), map metres,
        with the sensor's noise, of those it knows; and which of the points (n,) lie where the map has been."""
        ...


class MapAround(Protocol):
    """A finished map of any size, laid out around a vehicle that moves."""

    def __call__(self, position: F64) -> LocalMatcher:
        """The part around a position (3,), map metres. A part that was returned earlier becomes invalid."""
        ...

    def prepare(self, position: F64) -> None:
        """A little of the work for places ahead: called for every scan but those at which a track is checked."""
        ...

    def go_on_in(self, point_map: PointMap) -> None:
        """The map is another version from here on."""
        ...


MATCHERS = {"ndt": "mapvote.matching.ndt_map:MapWindow", "vgicp": "mapvote.matching.vgicp:VgicpWindow"}
"""``module:function`` of ``point_map -> MapAround`` by the name that ``ndt.matcher`` of the settings gives."""


def map_around(matcher: str, point_map: PointMap) -> MapAround:
    """The map laid out by the ``matcher`` of this name. MapvoteError if no installed distribution has it."""
    there: MapAround = _loaded(matcher)(point_map)
    return there


def _loaded(name: str) -> Any:
    if name in MATCHERS:
        module, _, function = MATCHERS[name].partition(":")
        return getattr(import_module(module), function)
    plugins = {entry.name: entry for entry in entry_points(group="mapvote.matchers")}
    if name not in plugins:
        raise MapvoteError(f"no matcher {name!r}; known are {', '.join([*MATCHERS, *plugins])}")
    return plugins[name].load()


def likeliest(around: LocalMatcher, cloud: F32, guesses: Sequence[F64], most: int, points: int = 1 << 30) -> list[F64]:
    """The ``most`` of guessed poses (4, 4) at which a cloud (3, n) fits the coarsest level best, best first, by some
    ``points`` of it."""
    few = np.ascontiguousarray(cloud[:, :: max(1, cloud.shape[1] // points)])
    fits = around.likelihood(few, np.array(guesses))
    return [guesses[k] for k in np.argsort(-fits, kind="stable")[:most]]


def best_of(
    around: LocalMatcher, clouds: Sequence[F32], guesses: Sequence[F64], most: int, prior: PosePrior | None = None,
    points: int = 1 << 30,
) -> Registration:  # fmt: skip
    """The ``most`` likeliest of guessed poses (4, 4), see :func:`likeliest`, refined: the one with the best score."""
    chosen = likeliest(around, clouds[0], guesses, most, points)
    return max((around.refine(clouds, guess, prior) for guess in chosen), key=lambda found: found.score)


def likelihood_at(around: LocalMatcher, cloud: F32, T_map_lidar: F64, level: int = 0) -> float:
    """Mean likelihood of a cloud (3, n) at one pose (4, 4), at one level."""
    return float(around.likelihood(cloud, T_map_lidar[None], level)[0])
