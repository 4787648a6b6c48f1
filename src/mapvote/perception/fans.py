"""Rays gathered into fans of about a beam's width in azimuth, and the cells that a fan crosses.

A fan is walked once over the cells, from where it marks; each of its rays that comes so far then marks the voxels
between its height on entering and on leaving each of them. One walk thus serves all beams of a firing, and the loop
along a ray runs over vectors of cells, in halves of a column's word: numbers of 32 bits make vectors twice as long.
The work for each ray is inlined: a call would pass five arrays, member by member, 20,000 times a scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapvote.core.geometry import turn
from mapvote.core.grid import CELL_SIZE
from mapvote.core.kernel import disjoint, inlined, kernel, one_bit, whole_along
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I32, I64, U32, U64


@record(votes=True)
@dataclass(frozen=True, slots=True)
class FanRule:
    """Fans of rays in the plane."""

    fans: int = 2048
    """Fans in a turn (0.18 deg, a firing or two): two cross every cell at 40 m. A fan's direction is its rays' mean."""
    full_range_m: float = 25.0
    """Range, metres, within which every second fan suffices for two to a cell; within half of it every fourth, and so
    on."""


FAN_RULE = FanRule()
# Kernels take no records: they read these names.
FANS = FAN_RULE.fans
FULL_RANGE_M = FAN_RULE.full_range_m
_LANES = 16
"""Cells that a ray is entered into at once. If the ray ends within them, the rest is masked."""
_HALF_COLUMN = 32
"""Voxels of half a column."""


class Rays(NamedTuple):
    """Where rays go, (n,) each."""

    reach: F32
    """Horizontal metres to the return."""
    x: F32
    """Horizontal direction, of length 1."""
    y: F32
    slope: F32
    """Voxels of height per metre of horizontal way."""
    stop: F32
    """Horizontal metres to the end of what the ray proves."""
    fan: I32


class Fans(NamedTuple):
    """Rays by fan: those that come to where their fan marks."""

    first: I32
    """(FANS,) first ray of each fan, and ..."""
    last: I32
    """... the one after its last."""
    slope: F32
    """Voxels of height per metre of horizontal way, of every ray; one place behind each fan is left free."""
    stop: F32
    """Horizontal metres to the end of what the ray proves."""
    end: F32
    """(FANS,) the largest of them in each fan; 0 without rays."""
    direction: F64
    """(FANS, 2) mean direction of these rays, of length 1; without any, the middle of the fan."""


def follow_rays(rows: F32, clearance: float) -> Rays:
    """The rays that end ``rows`` (3, n) metres from the sensor, and prove nothing from ``clearance`` before that on."""
    n = rows.shape[1]
    reach, x, y, slope, stop = np.empty((5, n), np.float32)
    rays = Rays(reach, x, y, slope, stop, np.empty(n, np.int32))
    _follow(rows, clearance, rays)
    return rays


@kernel
def _follow(rows: F32, clearance: float, rays: Rays) -> None:
    """Without a branch, in float32 alone and by an index that cannot be negative, so that it vectorises."""
    across = rows[0]
    along = rows[1]
    up = rows[2]
    reach, x, y, slope, stop, fan = rays
    n = len(across)
    clear = np.float32(clearance)
    layer = np.float32(CELL_SIZE)
    for i in range(np.uint64(0), np.uint64(n)):
        dx = across[i]
        dy = along[i]
        dz = up[i]
        h = np.sqrt(dx * dx + dy * dy)
        reach[i] = h
        x[i] = dx / h
        y[i] = dy / h
        slope[i] = dz / (layer * h)
        stop[i] = h - clear * h / np.sqrt(h * h + dz * dz)
        fan[i] = min(np.int32(turn(dx, dy) * np.float32(FANS)), np.int32(FANS - 1))


_HALVED = FULL_RANGE_M * 0.5 ** np.array([(f & -f).bit_length() - 1 if f else 64 for f in range(FANS)])
_MARKS_FROM = np.where(_HALVED <= CELL_SIZE, 0.0, _HALVED).astype(np.float32)
"""(FANS,) horizontal metres from which each fan marks what it passes."""
_TOO_SHORT = (_MARKS_FROM - 1.5 * CELL_SIZE).astype(np.float32)
"""A ray that ends before this comes to no cell that its fan marks: a cell is 1.42 sides across."""


def gather_rays(rays: Rays, more: Rays | None = None) -> Fans:
    """Sort ``rays`` and ``more`` into fans. A ray that ends in the sensor's own cell proves nothing."""
    every = rays, more or Rays._make(values[:0] for values in rays)
    n = sum(len(part.reach) for part in every)
    first = np.zeros(FANS, np.int32)
    last = np.empty(FANS, np.int32)
    slope, stop = np.empty((2, n + FANS), np.float32)
    end = np.zeros(FANS, np.float32)
    fans = Fans(first, last, slope, stop, end, np.zeros((FANS, 2)))
    _gather(every, fans, np.empty(n, np.int32), np.empty(2, np.int64))
    return fans


@kernel
def _gather(every: tuple[Rays, Rays], fans: Fans, kept: I32, counts: I64) -> None:
    """``kept`` (n,), of all rays: scratch, first whether each marks anything, in a loop that vectorises, then which do:
    a third. Told in one loop, LLVM made branches of it, which nothing could predict. ``counts`` (2,): scratch, how many
    rays are kept of each part."""
    own = np.float32(CELL_SIZE)
    first, last, slope, stop, end, direction = fans
    # Which rays are kept.
    begin = np.uint64(0)
    for part in range(2):
        rays = every[part]
        here = kept[begin:]
        n = np.uint64(len(rays.reach))
        for i in range(n):
            here[i] = np.int32((rays.reach[i] >= own) & (rays.stop[i] > _TOO_SHORT[np.uint64(rays.fan[i])]))
        count = np.uint64(0)
        for i in range(n):
            keep = here[i]
            here[count] = i  # a ray that is not kept is overwritten
            count += np.uint64(keep)
        counts[part] = count
        begin += n
    # How many each fan has of them.
    begin = np.uint64(0)
    for part in range(2):
        rays = every[part]
        here = kept[begin:]
        for j in range(np.uint64(counts[part])):
            first[np.uint64(rays.fan[np.uint64(here[j])])] += 1
        begin += np.uint64(len(rays.reach))
    # Room for each fan.
    room = 0
    for f in range(FANS):
        room, first[f], last[f] = room + first[f] + 1, room, room
    # Its rays, each behind the last one, and where they go together.
    begin = np.uint64(0)
    for part in range(2):
        rays = every[part]
        here = kept[begin:]
        for j in range(np.uint64(counts[part])):
            ray = np.uint64(here[j])
            fan = np.uint64(rays.fan[ray])
            k = np.uint64(last[fan])
            slope[k] = rays.slope[ray]
            stop[k] = rays.stop[ray]
            last[fan] += 1
            end[fan] = max(end[fan], rays.stop[ray])
            direction[fan, 0] += rays.x[ray]
            direction[fan, 1] += rays.y[ray]
        begin += np.uint64(len(rays.reach))
    for f in range(FANS):
        if first[f] == last[f]:
            direction[f, 0] = np.cos((f + 0.5) * (2.0 * np.pi / FANS))
            direction[f, 1] = np.sin((f + 0.5) * (2.0 * np.pi / FANS))
        norm = np.sqrt(direction[f, 0] ** 2 + direction[f, 1] ** 2)
        direction[f, 0] /= norm
        direction[f, 1] /= norm


class Way(NamedTuple):
    """A fan's way over the cells (Amanatides and Woo 1987), at one of them. Distances are horizontal metres."""

    r: int
    c: int
    entered: float
    """Where it comes into the cell ..."""
    next_r: float
    """... where it leaves its row ..."""
    next_c: float
    """... and its column."""
    width_r: float
    """From row to row."""
    width_c: float


@inlined
def set_out(x: float, y: float, dx: float, dy: float, at: float) -> Way:
    """The way from (x, y), in cells, in direction (dx, dy), where it has come ``at`` metres."""
    far = 1e18
    along = 1e-9  # a fan along an axis never comes to the next row or column
    per_cell = at * (1.0 / CELL_SIZE)
    c = int(np.floor(x + dx * per_cell))
    r = int(np.floor(y + dy * per_cell))
    across_c = CELL_SIZE / dx
    across_r = CELL_SIZE / dy
    next_c = far if abs(dx) < along else ((c + (dx > 0)) - x) * across_c
    next_r = far if abs(dy) < along else ((r + (dy > 0)) - y) * across_r
    width_c = far if abs(dx) < along else abs(across_c)
    width_r = far if abs(dy) < along else abs(across_r)
    return Way(r, c, max(0.0, next_c - width_c, next_r - width_r), next_r, next_c, width_r, width_c)


class Crossed(NamedTuple):
    """The cells that a fan crosses, in order, and _LANES more that hold nothing."""

    cell: I32
    """row * cols + col."""
    entered: F32
    """Horizontal metres at which the fan comes into each, and behind the last one at which it leaves."""
    bottom: I32
    """Bit 0 of each column, as a layer counted from the sensor's."""
    low: U32
    """Voxels of the lower half of each column that the fan's rays pass ..."""
    high: U32
    """... and of the upper."""
    left: F32
    """Scratch: horizontal metres at which the fan leaves each of the lines of cells that it runs across, ..."""
    steps: I32
    """... how many steps to the side it has taken by then, ..."""
    beside: F32
    """... and the horizontal metres to the next of them."""


def _room_for(cells: int) -> Crossed:
    room = cells + _LANES
    low, high = np.zeros((2, room), np.uint32)
    cell, bottom, steps = np.zeros((3, room), np.int32)
    entered, left, beside = np.zeros((3, room + 1), np.float32)
    return Crossed(cell, entered, bottom, low, high, left, steps, beside)


@inlined
def _cross_cells(
    way: Way, ahead: tuple[int, int], end: float, base: I32, shape: tuple[int, int], layer: int, out: Crossed
) -> np.int64:
    """Fill ``out`` with the cells of a way that steps ``ahead`` rows and columns, up to ``end`` metres or the window's
    edge. Returns how many there are. Lines are rows or columns, whichever the way crosses more of: between two of
    their borders it takes one step to the side or none. Where it takes them needs no branch, which nothing could
    predict: the cell beside is always written, and overwritten if the way does not come there."""
    rows, cols = shape
    over = way.width_c <= way.width_r  # lines are columns
    lines = (cols - way.c if ahead[1] > 0 else way.c + 1) if over else (rows - way.r if ahead[0] > 0 else way.r + 1)
    most = (rows - way.r if ahead[0] > 0 else way.r + 1) if over else (cols - way.c if ahead[1] > 0 else way.c + 1)
    on = np.int32(ahead[1] if over else ahead[0] * cols)
    aside = np.int32(ahead[0] * cols if over else ahead[1])
    next_line, next_side = (way.next_c, way.next_r) if over else (way.next_r, way.next_c)
    width, width_side = (way.width_c, way.width_r) if over else (way.width_r, way.width_c)
    edge = next_side + (most - 1) * width_side  # where the way leaves the window to the side
    until = min(np.float64(end), edge)
    inside = (0 <= way.r < rows) & (0 <= way.c < cols) & (way.entered < until)
    count = np.uint64(min(lines, max(int(np.ceil((until - next_line) / width)), 0) + 1) if inside else 0)
    per_side = 1.0 / width_side
    for i in range(np.uint64(0), count):
        at = next_line + np.float64(np.int32(i)) * width
        steps = min(max(np.int32(np.ceil((at - next_side) * per_side)), np.int32(0)), np.int32(most))
        out.left[i] = at
        out.steps[i] = steps
        out.beside[i] = next_side + np.float64(steps) * width_side
    n = np.uint64(0)
    k = np.int32(way.r * cols + way.c)
    steps = np.int32(0)
    t = np.float32(way.entered)
    beside = np.float32(next_side)
    for i in range(np.uint64(0), count):
        out.cell[n] = k
        out.entered[n] = t
        n += np.uint64(1)
        out.cell[n] = np.int32(k + aside)
        out.entered[n] = beside
        taken = out.steps[i] != steps
        steps = out.steps[i]
        n += np.uint64(taken & (steps < np.int32(most)))
        k += np.int32(on + (aside if taken else np.int32(0)))
        t = out.left[i]
        beside = out.beside[i]
    for j in range(np.uint64(0), n):
        out.bottom[j] = base[np.uint64(out.cell[j])] - np.int32(layer)
    for j in range(n, n + np.uint64(_LANES)):
        out.entered[j] = min(t, np.float32(edge))
        out.bottom[j] = 0
    return np.int64(n)


@inlined
def _pass(
    slopes: tuple[np.float32, np.float32], stops: tuple[np.float32, np.float32], height: np.float32, up: int,
    n: np.int64, crossed: Crossed, words: U32,
) -> None:  # fmt: skip
    """Enter the voxels of the first ``n`` cells that two rays pass: in each cell those between a ray's heights on
    entering and on leaving. ``height``: of the sensor over its layer, in voxels. ``words`` begin ``up`` voxels above
    the columns. Cells behind a ray's stop are masked. Two rays share what is read, and the end of a loop, which no
    processor foresees."""
    t = crossed.entered
    bottom = crossed.bottom
    one = np.uint64(1)  # unsigned: an index that cannot be negative vectorises
    lanes = np.uint64((n + _LANES - 1) // _LANES * _LANES)
    middle = np.float32(height - np.float32(0.5))  # the voxel is the whole number nearest to this
    zero = np.float32(0.0)
    floor = np.int32(up + whole_along(zero, zero, zero))
    gentle = np.float32(0.999 / (np.sqrt(2.0) * CELL_SIZE))  # 35 deg: up to here a ray passes two voxels at most
    if max(abs(slopes[0]), abs(slopes[1])) <= gentle:
        for j in range(np.uint64(0), lanes):
            lowest = np.int32(bottom[j] + floor)
            enter_a = np.int32(whole_along(slopes[0], t[j], middle) - lowest)
            enter_b = np.int32(whole_along(slopes[1], t[j], middle) - lowest)
            leave_a = np.int32(whole_along(slopes[0], min(t[j + one], stops[0]), middle) - lowest)
            leave_b = np.int32(whole_along(slopes[1], min(t[j + one], stops[1]), middle) - lowest)
            bits_a = one_bit(enter_a) | one_bit(leave_a) if t[j] < stops[0] else np.uint32(0)
            bits_b = one_bit(enter_b) | one_bit(leave_b) if t[j] < stops[1] else np.uint32(0)
            words[j] |= bits_a | bits_b
        return
    least = np.int32(0)
    most = np.int32(_HALF_COLUMN - 1)
    for which in range(2):
        slope = slopes[which]
        stop = stops[which]
        for j in range(np.uint64(0), lanes):
            enter = whole_along(slope, t[j], middle)
            leave = whole_along(slope, min(t[j + one], stop), middle)
            from_ = np.int32(min(enter, leave) - np.int32(bottom[j] + floor))
            to = np.int32(max(enter, leave) - np.int32(bottom[j] + floor))
            here = (t[j] < stop) & (to >= least) & (from_ <= most)
            first = np.uint32(min(max(from_, least), most))
            last = np.uint32(min(max(to, least), most))
            bits = np.uint32(np.uint32(2) << last) - np.uint32(np.uint32(1) << first)
            words[j] |= np.uint32(bits) if here else np.uint32(0)


@inlined
def _enter(crossed: Crossed, n: np.int64, passed: U64) -> None:
    """Enter the voxels that a fan passed into the plane (flat), and clear the words. Bit 63, all above, is never
    passed."""
    for j in range(n):
        low = np.uint64(crossed.low[j])
        high = np.uint64(crossed.high[j] & np.uint32(0x7FFFFFFF))
        passed[np.uint64(crossed.cell[j])] |= low | high << np.uint64(_HALF_COLUMN)
    for j in range(n + _LANES):
        crossed.low[j] = crossed.high[j] = 0


def mark_passed(fans: Fans, origin: F64, corner: tuple[float, float], base: I32, passed: U64) -> None:
    """Take each fan from where it marks to the end of its rays, and enter what they pass into ``passed`` (flat)."""
    _mark_passed(fans, origin, corner, base.reshape(-1), base.shape, passed, _room_for(sum(base.shape) + 1))


@disjoint
def _mark_passed(
    fans: Fans, origin: F64, corner: tuple[float, float], base: I32, shape: tuple[int, int], passed: U64,
    crossed: Crossed,
) -> None:  # fmt: skip
    layer = int(np.floor(origin[2] / CELL_SIZE))
    height = np.float32(origin[2] / CELL_SIZE - layer)
    x = (origin[0] - corner[0]) / CELL_SIZE
    y = (origin[1] - corner[1]) / CELL_SIZE
    for f in range(FANS):
        if fans.end[f] <= _MARKS_FROM[f]:
            continue
        dx, dy = fans.direction[f]
        ahead = (1 if dy > 0 else -1), (1 if dx > 0 else -1)
        n = _cross_cells(set_out(x, y, dx, dy, _MARKS_FROM[f]), ahead, fans.end[f], base, shape, layer, crossed)
        lowest = crossed.bottom[0]
        for j in range(1, n):
            lowest = min(lowest, crossed.bottom[j])
        cells_a_metre = np.float32((abs(dx) + abs(dy)) / CELL_SIZE)
        # Rays by two: the place that is free behind the last one is a ray of length 0.
        fans.slope[fans.last[f]] = fans.stop[fans.last[f]] = np.float32(0.0)
        for k in range(fans.first[f], fans.last[f], 2):
            slopes = fans.slope[k], fans.slope[k + 1]
            stops = fans.stop[k], fans.stop[k + 1]
            # A ray that ends before the fan marks has a cell or none.
            way = max(max(stops[0], stops[1]) - crossed.entered[0], np.float32(0.0))
            reached = min(n, np.int64(way * cells_a_metre) + 3)
            top = max(max(slopes[0], np.float32(0.0)) * stops[0], max(slopes[1], np.float32(0.0)) * stops[1])
            halves = 2 if height + top >= lowest + _HALF_COLUMN else 1
            for half in range(halves):
                words = crossed.low if half == 0 else crossed.high
                _pass(slopes, stops, height, half * _HALF_COLUMN, reached, crossed, words)
        _enter(crossed, n, passed)
