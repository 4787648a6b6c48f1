"""False and missing points of a real LiDAR: mirrors, mixed pixels, surfaces that send nothing back, rain, exhaust.

* A smooth surface (a puddle, a pane, a car's paint) sends the beam on. A return over it is reported where the beam
  would have been without the mirror: below the road, behind the glass, inside the car.
* A beam is a cone. At an edge it meets two surfaces less than a pulse's length apart, and reports a range between them.
* Wet asphalt under a flat angle, glass and dark paint return too little to be seen.
* Drops near the sensor return the beam before it arrives; so does the exhaust behind a car in the cold.

Where a surface is wet, glazed or dark is a property of the place: all drives of a seed agree on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.record import record
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, I64, Bool
from mapvote_lab.simulation.lidar import Caster, SlicedCaster, Sweep
from mapvote_lab.simulation.scenario import Flaws


@record()
@dataclass(frozen=True, slots=True)
class FlawSizes:
    """Sizes of what spoils the points of the simulated LiDAR."""

    pulse_m: float = 1.5
    """Surfaces less far apart along a ray come back as one, metres: half of a pulse of 10 ns."""
    edge_m: float = 0.15
    """Neighbouring rays that differ by more than this in range straddle an edge, metres."""
    patch_m: float = 2.0
    """Side of the patches of road that are wet or dry, metres."""
    pane_m: float = 1.5
    """Side of the panes of a facade that are glass or wall, metres."""
    grazing: float = 0.25
    """Cosine of incidence under which a wet road sends nothing back: 75 deg, 7 m before a car's sensor."""
    drops_m: float = 5.0
    """Mean range at which a drop of rain returns a ray, metres."""
    plume_m: float = 0.7
    """Radius of an exhaust plume, metres."""


FLAW_SIZES = FlawSizes()


@dataclass(frozen=True)
class Kinds:
    """Material of each object id, (objects,)."""

    glazed: Bool
    painted: Bool
    seed: int


@dataclass(frozen=True)
class Hits:
    """True hits of the rays of one revolution; arrays (rays,)."""

    ranges: F32
    objects: I32
    """Body id; of a moving body its number in the traffic."""
    cosine: F32
    moving: Bool


def chance_of(cells: F64, seed: int) -> F64:
    """(n,) a number in [0, 1) for each row of whole numbers, always the same for the same row and seed."""
    h = np.full(len(cells), seed & 0xFFFF_FFFF, dtype=np.uint64)
    for axis in cells.astype(np.int64).astype(np.uint64).T:
        h = (h ^ axis) * np.uint64(0x9E3779B97F4A7C15)
        h ^= h >> np.uint64(29)
        h *= np.uint64(0xBF58476D1CE4E5B9)
        h ^= h >> np.uint64(32)
    return (h >> np.uint64(11)).astype(np.float64) / float(1 << 53)


def surfaces(
    hits: Hits, points: F64, kinds: Kinds, flaws: Flaws, sizes: FlawSizes = FLAW_SIZES
) -> tuple[Bool, Bool, Bool, Bool]:
    """(wet road, glass, paint, dark paint), each (rays,): what the rays that ended at ``points`` (rays, 3) have met."""
    met = np.isfinite(hits.ranges)
    still = met & ~hits.moving
    body = np.where(still, hits.objects, 0)
    road = still & (hits.objects == 0)
    facade = still & kinds.glazed[body]
    paint = hits.moving | (still & kinds.painted[body])
    wet, glass, dark = (np.zeros(len(met), dtype=np.bool_) for _ in range(3))
    wet[road] = chance_of(np.floor(points[road, :2] / sizes.patch_m), kinds.seed) < flaws.wet_share
    glass[facade] = chance_of(np.floor(points[facade] / sizes.pane_m), kinds.seed + 1) < flaws.glass_share
    car = np.column_stack([hits.objects[paint], hits.moving[paint]])
    dark[paint] = chance_of(car, kinds.seed + 2) < flaws.dark_share
    return wet, glass, paint, dark


def swallowed(
    wet: Bool,
    glass: Bool,
    dark: Bool,
    hits: Hits,
    sensor: Sensor,
    rng: np.random.Generator,
    sizes: FlawSizes = FLAW_SIZES,
) -> Bool:
    """(rays,) which rays get nothing back: wet road under a flat angle, glass, dark paint the farther off it is."""
    chance = 0.9 * (wet & (hits.cosine < sizes.grazing)) + 0.8 * glass
    far = np.minimum(np.where(np.isfinite(hits.ranges), hits.ranges, 0.0) / (0.3 * sensor.max_range_m), 1.0)
    chance = chance + 0.9 * far * dark
    lost: Bool = rng.random(len(wet)) < chance
    return lost


def reflected(
    rays: Sweep, hits: Hits, smooth: Bool, casters: tuple[Caster, Caster | SlicedCaster], wanted: int, sensor: Sensor,
    rng: np.random.Generator,
) -> tuple[I64, F32]:  # fmt: skip
    """(indices, ranges) of at most ``wanted`` rays of those that met a ``smooth`` surface (rays,): the range over it.

    ``casters``: of static and of moving objects. A mirror shows static objects only.
    """
    chosen = rng.permutation(np.flatnonzero(smooth))[: 4 * wanted]
    indices = [np.zeros(0, dtype=np.int64)]
    ranges = [np.zeros(0, dtype=np.float32)]
    for caster, its_rays in zip(casters, (~hits.moving[chosen], hits.moving[chosen]), strict=True):
        met = chosen[its_rays]
        if len(met):
            normals = caster.normals(rays, met)
            away = rays.directions[met]
            bounced = away - 2.0 * np.einsum("ij,ij->i", away, normals)[:, None] * normals
            mirror = rays.origins[met] + hits.ranges[met, None] * away
            beyond, _, _ = casters[0].cast((mirror + 0.01 * bounced).astype(np.float32), bounced.astype(np.float32))
            indices.append(met)
            ranges.append((hits.ranges[met] + beyond).astype(np.float32))
    index = np.concatenate(indices)
    way = np.concatenate(ranges)
    seen = np.flatnonzero(way < sensor.max_range_m)[:wanted]
    return index[seen], way[seen]


def mixed(ranges: F32, together: int, share: float, rng: np.random.Generator, sizes: FlawSizes = FLAW_SIZES) -> Bool:
    """Mix ranges (rays,) in place where the beam beside meets something else within a pulse; which were, (rays,).

    Rays are in firing order, and so many leave ``together``: the neighbour of a ray is as many rays on.
    """
    beside = np.roll(ranges, -together)
    with np.errstate(invalid="ignore"):
        apart = np.abs(beside - ranges)
    edge: Bool = (apart > sizes.edge_m) & (apart < sizes.pulse_m) & (rng.random(len(ranges)) < share)
    part = rng.random(len(ranges), dtype=np.float32)[edge]
    ranges[edge] += part * (beside[edge] - ranges[edge])
    return edge


def shortened(
    rays: Sweep,
    ranges: F32,
    tails: F64,
    flaws: Flaws,
    rng: np.random.Generator,
    sizes: FlawSizes = FLAW_SIZES,
) -> Bool:
    """Let rays (in place) end on drops and in the exhaust behind ``tails`` (n, 3); which did, (rays,)."""
    short = np.zeros(len(ranges), dtype=np.bool_)
    if flaws.rain > 0:
        drop = rng.exponential(sizes.drops_m, len(ranges)).astype(np.float32)
        wet = (rng.random(len(ranges)) < flaws.rain) & (drop < ranges)
        ranges[wet] = drop[wet]
        short = short | wet
    for k in np.flatnonzero(rng.random(len(tails)) < flaws.exhaust):
        offset = tails[k] - rays.origins
        along = np.einsum("ij,ij->i", offset, rays.directions)
        miss = np.einsum("ij,ij->i", offset, offset) - along**2
        inside = (along > 0) & (miss < sizes.plume_m**2) & (rng.random(len(ranges)) < 0.3)
        half_way_through = np.sqrt(np.maximum(sizes.plume_m**2 - miss, 0.0))
        ends = (along + rng.uniform(-1.0, 1.0, len(ranges)) * half_way_through).astype(np.float32)
        inside &= ends < ranges
        ranges[inside] = ends[inside]
        short = short | inside
    return short


def spoil(
    rays: Sweep, hits: Hits, kinds: Kinds, casters: tuple[Caster, Caster | SlicedCaster], tails: F64, sensor: Sensor,
    flaws: Flaws, rng: np.random.Generator,
) -> tuple[F32, Bool, Bool]:  # fmt: skip
    """(ranges as reported, false, lost), each (rays,): what becomes of the true ``hits`` of one revolution.

    ``false``: the ray reports a place where nothing is, ``lost``: it reports nothing. ``casters``: of what stands, of
    what moves; ``tails`` (n, 3): where exhausts may be.
    """
    ranges = hits.ranges.copy()
    points = (rays.origins + np.where(np.isfinite(ranges), ranges, 0.0)[:, None] * rays.directions).astype(np.float64)
    wet, glass, paint, dark = surfaces(hits, points, kinds, flaws)
    lost = swallowed(wet, glass, dark, hits, sensor, rng)
    false = mixed(ranges, rays.together, flaws.mixed_share, rng)
    wanted = round(flaws.reflection_share * np.count_nonzero(hits.ranges < sensor.max_range_m))
    if wanted:
        index, way = reflected(rays, hits, wet | glass | paint, casters, wanted, sensor, rng)
        ranges[index] = way
        false[index] = True
        lost[index] = False
    short = shortened(rays, ranges, tails, flaws, rng)
    return ranges, false | short, lost & ~short
