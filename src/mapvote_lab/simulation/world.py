"""The street before and after: the ground, and every body that stands still, laid out by a seed (paper V, Figure 6)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from mapvote.core.record import record
from mapvote.core.types import F32, F64, I32, MapvoteError
from mapvote_lab.simulation import overhead, shapes
from mapvote_lab.simulation.scenario import Scenario
from mapvote_lab.simulation.shapes import FOOT_M, box, building, car, hedge, join, place, van


@record()
@dataclass(frozen=True, slots=True)
class CrossSection:
    """Measures of every simulated street."""

    kerb_m: float = 9.2
    """Distance from the road's axis to the kerb, metres: two lanes of 3.5 m and a parking strip of 2.2 m."""
    sidewalk_m: float = 12.4
    """Distance from the road's axis to the outer edge of the sidewalk, metres."""
    kerb_height_m: float = 0.15
    """Height of the kerb over the gutter, metres."""
    margin_m: float = 80.0
    """Length by which the world goes on beyond the scored window, metres: rays must not fall off its edge."""
    stop_line_m: float = 4.0
    """Distance of the crossing street's stop lines from the kerb, metres."""


STREET = CrossSection()


@dataclass(frozen=True)
class Terrain:
    """Height over map coordinates: z in metres, smooth apart from the kerbs."""

    axis_y: float
    crossing_x: float | None
    length: float
    crown: float
    waves: F64
    """(k, 4) amplitude (m), wave numbers along x and y (1/m), phase."""

    def road_distance(self, x: ArrayLike, y: ArrayLike) -> F64:
        """Distance from the nearest road axis, metres."""
        across = np.abs(np.asarray(y, dtype=np.float64) - self.axis_y)
        if self.crossing_x is None:
            return across + 0.0 * np.asarray(x)
        return np.minimum(across, np.abs(np.asarray(x, dtype=np.float64) - self.crossing_x))

    def height(self, x: ArrayLike, y: ArrayLike) -> F64:
        """z of the ground at map (x, y), broadcast."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        distance = self.road_distance(x, y)
        z = np.where(
            distance < STREET.kerb_m, -self.crown * distance, -self.crown * STREET.kerb_m + STREET.kerb_height_m
        )
        z = z + 0.015 * np.clip(distance - STREET.kerb_m, 0.0, 25.0)
        for amplitude, kx, ky, phase in self.waves:
            z = z + amplitude * np.sin(kx * x + ky * y + phase)
        return z

    def triangles(self) -> F64:
        """The ground as a mesh that follows :meth:`height`, kerbs included."""
        xs = np.arange(-STREET.margin_m, self.length + STREET.margin_m + 1.0, 2.0)
        # The gutter is just within the kerb: on it, rounding would decide whether the road or the sidewalk is there.
        side = np.array([3.5, STREET.kerb_m - 0.005, STREET.kerb_m + 0.005, STREET.sidewalk_m])
        kerb = np.concatenate([-side[::-1], [0.0], side])
        plots = np.array([18.0, 25.0, 34.2, 45.0, 60.0, 80.0])
        ys = self.axis_y + np.concatenate([-plots, kerb, plots])
        if self.crossing_x is not None:
            xs = np.unique(np.concatenate([xs, self.crossing_x + kerb]))
            ys = np.concatenate([ys, self.axis_y + np.arange(-78.0, 79.0, 4.0)])
        ys = np.unique(ys)
        gx, gy = np.meshgrid(xs, ys)
        grid = np.stack([gx, gy, self.height(gx, gy)], axis=-1)
        a = grid[:-1, :-1]
        b = grid[:-1, 1:]
        c = grid[1:, 1:]
        d = grid[1:, :-1]
        return np.concatenate([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)


def make_terrain(scenario: Scenario, rng: np.random.Generator) -> Terrain:
    """Seeded waves whose grades add up to at most ``scenario.max_grade`` along the road."""
    lengths = np.array([rng.uniform(250, 400), rng.uniform(90, 150)])
    shares = np.array([0.7, 0.3])
    kx = 2 * np.pi / lengths
    waves = np.column_stack([scenario.max_grade * shares / kx, kx, 0.1 * kx, rng.uniform(0, 2 * np.pi, 2)])
    return Terrain(0.5 * scenario.width_m, scenario.crossing_m, scenario.length_m, scenario.crown, waves)


class Role(IntEnum):
    """Role of a body in the truth (docs/decisions/truth.md)."""

    KEPT = 0
    ADDED = 1
    REMOVED = 2
    PASSING = 3
    """Not surveyed, and there during less than half of the passes: no change of the map."""
    UNCLEAR = 4
    """There during some passes only, so that a majority contradicts the survey: cells it touches are unscored."""


@dataclass(frozen=True)
class Body:
    """A body that stands still. ``triangles`` (n, 3, 3) float64 in map metres."""

    kind: str
    triangles: F64
    before: bool = True
    """Whether it stood there when the first map was surveyed (both surveys ran within the same hour)."""
    in_pass: tuple[bool, ...] | None = None
    """Whether it stood there when vehicle i passed; None: during all passes."""

    @property
    def role(self) -> Role:
        share = 1.0 if self.in_pass is None else sum(self.in_pass) / len(self.in_pass)
        if self.before:
            return Role.REMOVED if share == 0 else Role.KEPT if share > 0.5 else Role.UNCLEAR
        return Role.ADDED if share == 1 else Role.PASSING if share < 0.5 else Role.UNCLEAR

    def stands(self, vehicle: int | None) -> bool:
        """Whether it is there for vehicle ``vehicle`` (from 0), or for the surveys (None)."""
        if vehicle is None:
            return self.before
        return self.in_pass is None or self.in_pass[vehicle]


@dataclass(frozen=True)
class World:
    """``bodies[0]`` is the ground; a body's index is its object id."""

    terrain: Terrain
    bodies: tuple[Body, ...]

    def mesh(self, ids: list[int]) -> tuple[F32, I32]:
        """Triangles (n, 3, 3) float32 of these bodies and the object id of each triangle (n,)."""
        owners = np.repeat(ids, [len(self.bodies[i].triangles) for i in ids]).astype(np.int32)
        return join([self.bodies[i].triangles for i in ids]).astype(np.float32), owners

    def standing(self, vehicle: int | None) -> list[int]:
        """Object ids there for vehicle ``vehicle``, or for the surveys (None)."""
        return [i for i, body in enumerate(self.bodies) if body.stands(vehicle)]

    def roles(self) -> I32:
        """(objects,) the role of each object."""
        return np.array([body.role for body in self.bodies], dtype=np.int32)


@dataclass(frozen=True)
class Side:
    """One side of a street: s runs along it, v away from the kerb side; both from the axis."""

    x0: float
    y0: float
    yaw: float
    sign: int
    spans: tuple[tuple[float, float], ...]
    """Stretches of s with a frontage: where no other street crosses."""

    def put(self, local: F64, s: float, v: float, terrain: Terrain, turn: float = 0.0) -> F64:
        """Triangles of a frame (along, away, up) at (s, v), on the ground there."""
        turned = place(local, s, v, 0, turn) * [1, self.sign, 1]
        x, y = self.at(s, v)
        return place(turned, self.x0, self.y0, float(terrain.height(x, y)), self.yaw)

    def at(self, s: float, v: float) -> tuple[float, float]:
        """Map (x, y) of (s, v)."""
        c = np.cos(self.yaw)
        sn = np.sin(self.yaw)
        o = self.sign * v
        return float(self.x0 + c * s - sn * o), float(self.y0 + sn * s + c * o)


def make_world(scenario: Scenario, seed: int) -> World:
    """The street of ``scenario`` laid out by ``seed``. MapvoteError if the changes do not fit on it."""
    rng = np.random.default_rng([seed, 1])
    terrain = make_terrain(scenario, rng)
    bodies = [Body("ground", terrain.triangles())]
    for side in _sides(scenario):
        bodies += (_blocks if scenario.blocks else _frontage)(scenario, side, terrain, rng)
        bodies += _kerbside(scenario, side, terrain, rng)
    middle = Side(0.0, terrain.axis_y, 0.0, 1, ())
    for s in scenario.clutter.gantry_m:
        bodies.append(Body("gantry", middle.put(shapes.gantry(STREET.kerb_m + 0.6), s, 0.0, terrain)))
    bodies += _overhead(scenario, bodies, terrain, np.random.default_rng([seed, 8]))
    bodies += _parked_cars(scenario, terrain, np.random.default_rng([seed, 2]))
    return World(terrain, tuple(bodies))


def _sides(scenario: Scenario) -> list[Side]:
    """North and south of the main street, then both sides of the one that crosses it."""
    axis = 0.5 * scenario.width_m
    low = -STREET.margin_m
    high = scenario.length_m + STREET.margin_m
    cross = scenario.crossing_m
    if cross is None:
        return [Side(0.0, axis, 0.0, sign, ((low, high),)) for sign in (1, -1)]
    gap = STREET.sidewalk_m + 0.5
    main = [Side(0.0, axis, 0.0, sign, ((low, cross - gap), (cross + gap, high))) for sign in (1, -1)]
    first = STREET.sidewalk_m + 18.0  # behind the corner buildings of the main street
    return main + [
        Side(cross, axis, 0.5 * np.pi, sign, ((-STREET.margin_m, -first), (first, STREET.margin_m))) for sign in (1, -1)
    ]


def _plots(scenario: Scenario, side: Side, rng: np.random.Generator) -> Iterator[tuple[float, float, str]]:
    """(from, to, "kept" | "built" | "demolished") along the facade line, west to east."""
    name = "north" if side.sign > 0 else "south"
    changes = sorted((c for c in scenario.changes if c.side == name and side.yaw == 0.0), key=lambda c: c.from_m)
    for low, high in side.spans:
        start = low
        for change in changes:
            if not low <= change.from_m < high:
                continue
            if change.from_m < start or change.to_m - change.from_m < 6.0 * change.count or change.to_m > high:
                stretch = f"{change.count} building(s) from {change.from_m} to {change.to_m} m"
                raise MapvoteError(f"scenario {scenario.name}: {stretch} do not fit: 6 m each, in a free stretch")
            yield from _fill(start, change.from_m, rng, scenario.house_m)
            each = (change.to_m - change.from_m) / change.count
            for k in range(change.count):
                yield change.from_m + k * each + 0.5, change.from_m + (k + 1) * each - 0.5, change.kind
            start = change.to_m
        yield from _fill(start, high, rng, scenario.house_m)


def _fill(
    start: float, stop: float, rng: np.random.Generator, house_m: float | None = None
) -> Iterator[tuple[float, float, str]]:
    while house_m and stop - start >= house_m:
        yield start, start + house_m, "kept"
        start += house_m
    while stop - start > 7.0:
        end = min(start + rng.uniform(9.0, 22.0), stop)
        yield start, end, "kept"
        start = end + (rng.uniform(0.0, 0.3) if rng.uniform() < 0.55 else rng.uniform(1.0, 4.0))


def _frontage(scenario: Scenario, side: Side, terrain: Terrain, rng: np.random.Generator) -> list[Body]:
    """Buildings along the facade line, gardens and yards between, a second row behind."""
    bodies = []
    equal = int(rng.integers(1 << 32)) if scenario.house_m else None
    for low, high, change in _plots(scenario, side, rng):
        draw = rng if equal is None else np.random.default_rng(equal)  # the same draws make the same house
        width = high - low
        height = draw.uniform(4.0, 15.0)
        turn = draw.normal(0.0, 0.015)
        setback = STREET.sidewalk_m + draw.choice([draw.uniform(0.2, 0.9), draw.uniform(0.9, 3.0)], p=[0.65, 0.35])
        yards = change == "kept" and equal is None
        if yards and draw.uniform() < 0.09:  # a fence or hedge in front, a shed at the back
            front = hedge(draw, width, 0.6, 1.1) if draw.uniform() < 0.5 else box(0, width, -0.08, 0.08, -0.5, 1.6)
            bodies.append(Body("fence", side.put(front, low, STREET.sidewalk_m + 0.4, terrain)))
            bodies.append(
                Body("shed", side.put(box(0, 0.5 * width, 0, 3, -1, 2.6), low, STREET.sidewalk_m + 9.0, terrain))
            )
            continue
        house = side.put(building(draw, width, draw.uniform(8.0, 13.0), height), low, setback, terrain, turn)
        bodies.append(Body("building", house, change != "built", (change != "demolished",) * scenario.vehicles))
        if change == "kept" and setback > STREET.sidewalk_m + 1.4 and draw.uniform() < 0.5:
            bodies.append(Body("hedge", side.put(hedge(draw, width, 0.5, 0.9), low, STREET.sidewalk_m + 0.5, terrain)))
    for low, high in ((a, b) for span in side.spans for a, b, _ in _fill(span[0] - 3.0, span[1], rng)):
        back = building(rng, (high - low) * rng.uniform(0.75, 0.95), 10.0, rng.uniform(5.0, 15.0))
        bodies.append(Body("building", side.put(back, low, rng.uniform(29.0, 36.0), terrain)))
    return bodies


def _blocks(scenario: Scenario, side: Side, terrain: Terrain, rng: np.random.Generator) -> list[Body]:
    """Plain blocks with flat roofs along the sidewalk, and nothing behind them."""
    bodies = []
    for low, high, change in _plots(scenario, side, rng):
        block = box(0, high - low, 0, rng.uniform(8.0, 13.0), FOOT_M, rng.uniform(4.0, 15.0))
        placed = side.put(block, low, STREET.sidewalk_m + rng.uniform(0.2, 0.9), terrain, rng.normal(0.0, 0.005))
        bodies.append(Body("building", placed, change != "built", (change != "demolished",) * scenario.vehicles))
    return bodies


def _kerbside(scenario: Scenario, side: Side, terrain: Terrain, rng: np.random.Generator) -> list[Body]:
    """Trees, lamps, signs, furniture and guard rails on the sidewalk."""
    clutter = scenario.clutter
    rows = (
        ("tree", clutter.tree_spacing_m, STREET.kerb_m + 0.9, shapes.tree),
        ("pole", clutter.pole_spacing_m, STREET.kerb_m + 0.5, shapes.pole),
        ("sign", clutter.sign_spacing_m, STREET.kerb_m + 0.45, shapes.sign),
        ("furniture", clutter.furniture_spacing_m, STREET.kerb_m + 0.85, shapes.street_box),
    )
    bodies: list[Body] = []
    taken: list[float] = []
    for low, high in side.spans:
        for kind, spacing, v, make in rows:
            s = low + rng.uniform(0.2, 1.0) * spacing if spacing else high
            while s < high - 1.0:
                if all(abs(s - other) > 1.6 for other in taken):
                    bodies.append(Body(kind, side.put(make(rng), s, v, terrain)))
                    taken.append(s)
                s += spacing * rng.uniform(0.7, 1.3)
        s = low
        while s < high - 20.0:
            length = 2.0 * rng.integers(3, 9)
            if rng.uniform() < clutter.rail_share:
                bodies.append(Body("rail", side.put(shapes.rail(length), s, STREET.kerb_m + 0.25, terrain)))
            s += length + rng.uniform(1.0, 4.0)
    return bodies


def _overhead(scenario: Scenario, bodies: list[Body], terrain: Terrain, rng: np.random.Generator) -> list[Body]:
    """Objects over the street, and over those of its ``bodies`` that are removed."""
    hanging = []
    for kind, triangles, s, side in overhead.across(scenario.overhead):
        hanging.append(Body(kind, Side(0.0, terrain.axis_y, 0.0, side, ()).put(triangles, s, 0.0, terrain)))
    gone = [body for body in bodies if body.role == Role.REMOVED] if scenario.overhead.over_demolished else []
    for house in gone:
        hanging += [Body(kind, body) for kind, body in overhead.over_house(house.triangles, rng).items()]
    return hanging


def _parked_cars(scenario: Scenario, terrain: Terrain, rng: np.random.Generator) -> list[Body]:
    """Kerbside cars: some always there, some not, and the scenario's extra cars of single passes."""
    passes = scenario.vehicles
    bodies = []
    vacant = []
    for side in _sides(scenario):
        slots = [s for low, high in side.spans for s in np.arange(low + 4.0, high - 4.0, 6.2)]
        for s in slots:
            make = van if rng.uniform() < 0.12 else car
            jitter = rng.uniform(-0.4, 0.4)
            turn = rng.normal(0, 0.02)
            draw = rng.uniform()
            before = bool(rng.uniform() < 0.5)
            visits = tuple((rng.uniform(size=10) < 0.5).tolist())[:passes]
            triangles = side.put(make(), s + jitter, STREET.kerb_m - 1.15, terrain, turn)
            if draw < scenario.clutter.parked_share:
                bodies.append(Body("parked car", triangles))
            elif draw < scenario.clutter.parked_share + scenario.clutter.visitor_share:
                bodies.append(Body("parked car", triangles, before, visits))
            elif side.yaw == 0.0 and 3.0 < s < scenario.length_m - 3.0:
                vacant.append(triangles)
    extra = scenario.temporary_cars
    if extra > len(vacant):
        raise MapvoteError(f"scenario {scenario.name}: {extra} temporary cars, but only {len(vacant)} vacant places")
    order = rng.permutation(len(vacant))
    taken: dict[int, set[int]] = {}
    for vehicle in range(passes):
        for k in range(extra):
            taken.setdefault(int(order[(vehicle * extra + k) % len(vacant)]), set()).add(vehicle)
    for slot, guests in taken.items():
        bodies.append(Body("parked car", vacant[slot], False, tuple(v in guests for v in range(passes))))
    return bodies
