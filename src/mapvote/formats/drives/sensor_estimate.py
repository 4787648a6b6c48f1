"""The LiDAR that took some scans, measured in them: elevations of its rings, azimuth step, spin, blind sectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapvote.core.mount import mount_of_prior
from mapvote.core.record import record
from mapvote.core.sensors import SENSORS, Sensor
from mapvote.core.types import F64, I64, Scan
from mapvote.formats.drives.ring_axis import level_by_axis, ring_axis

UNKNOWN_SENSOR = Sensor("unknown", (0.0,), 0.2, min_range_m=0.5)
"""Reads the scans that are used."""


@record()
@dataclass(frozen=True, slots=True)
class RingRule:
    """How a sensor is measured in its scans, and when a stated one is contradicted."""

    scans: int = 10
    """Scans at the beginning of a live drive in which its sensor is measured."""
    far_m: float = 8.0
    """Points nearer than this are left out, metres: the beams of large sensors do not start in one point."""
    sure: float = 0.7
    """Share of points that must lie on a ring for the rings to be believed."""
    edge_deg: float = 1.5
    """A stated sensor is another one if scans show beams this far beyond its own, degrees."""
    more: float = 1.3
    """A stated sensor is another one if scans show this many times as many beams."""
    upright_deg: float = 30.0
    """A sensor that leans less than this has beams of about one elevation each, degrees."""
    sector_deg: float = 2.0
    """Width of the sectors in which points are counted to find blind ones, degrees."""
    blind_deg: float = 10.0
    """Least width of a blind sector, degrees."""


RING_RULE = RingRule()


@dataclass(frozen=True, slots=True)
class Estimate:
    """A sensor and how sure it is."""

    sensor: Sensor
    on_rings: float
    """Share of far points within a third of the spacing of their ring's elevation."""
    told: str


def rate_of_first(stamps_ns: I64) -> float:
    """Revolutions per second by the stamps (n,), n > 1, of the first scans of a live drive, to a tenth."""
    return round(1e9 / float(np.median(np.diff(stamps_ns))), 1)


def estimate_sensor(scans: Sequence[Scan], rate_hz: float, rule: RingRule = RING_RULE) -> Estimate:
    """The sensor of some scans (one or more): a known model where the rings fit one, else a model of the seen rings.

    Rings come from the ring field, else from the order of the points (ring by ring), else from clusters of
    elevations. Where there are none (solid-state, non-repeating) the model is an even grid over the field of view.
    """
    # Elevation, azimuth, range and ring of every point.
    angles = [_angles(scan) for scan in scans]
    elevation, azimuth = (np.concatenate([a[k] for a in angles]) for k in (0, 1))
    rings = [_rings(scan, *pair) for scan, pair in zip(scans, angles, strict=True)]
    blind = _blind_sectors(azimuth, rule)
    # Without rings on which most points lie: a model of the field of view.
    on_rings = [ring for ring in rings if ring is not None]
    model_of_rings = _ring_model(angles, on_rings, rule.far_m) if len(on_rings) == len(rings) else None
    if model_of_rings is None or model_of_rings[2] < rule.sure:
        share = 0.0 if model_of_rings is None else model_of_rings[2]
        return _ringless(elevation, azimuth, rate_hz, blind, share)
    # With rings: a known model whose beams they are, else one of these rings.
    elevations, step, share = model_of_rings
    spin = _clockwise(scans, angles)
    name, model = _known(elevations)
    seen = f"{len(elevations)} rings, {elevations[0]:.1f} to {elevations[-1]:.1f} deg, {share:.0%} of points on them"
    if model is not None:
        return Estimate(replace(model, rate_hz=rate_hz, blind_sectors_deg=blind), share, f"measured: {name} ({seen})")
    sensor = Sensor(
        f"measured-{len(elevations)}",
        tuple(round(float(e), 3) for e in elevations),
        round(float(step), 4),
        rate_hz=rate_hz,
        max_range_m=_reach(scans),
        clockwise=spin,
        blind_sectors_deg=blind,
    )
    return Estimate(sensor, share, f"measured: {seen}, azimuth step {step:.3f} deg")


def contradiction(stated: Sensor, scan: Scan, rule: RingRule = RING_RULE) -> str:
    """How the rings that a scan surely shows contradict the ``stated`` sensor; "" if they do not, or are not sure.

    Beams that see nothing are missed in a scan, so fewer rings than stated are no contradiction.
    """
    if not stated.rings or stated.beams < 2:
        return ""
    shown = estimate_sensor([scan], stated.rate_hz, rule)
    if not shown.sensor.rings or shown.on_rings < rule.sure:
        return ""
    seen, beams = (np.sort(np.array(s.elevations_deg))[::-1] for s in (shown.sensor, stated))
    spacing = float(np.median(np.abs(np.diff(beams))))
    outside = seen[0] > beams[0] + rule.edge_deg or seen[-1] < beams[-1] - rule.edge_deg
    off_deg = float(np.median(np.abs(seen - _nearest(beams, seen))))
    if not outside and len(seen) <= rule.more * len(beams) and off_deg <= max(0.3 * spacing, 0.15):
        return ""
    name = f", as a {shown.sensor.name} has" if shown.sensor.name in SENSORS else ""
    return (
        f"the scans show {len(seen)} beams from {seen[-1]:.1f} to {seen[0]:.1f} deg{name}, but a {stated.name} has "
        f"{len(beams)} from {beams[-1]:.1f} to {beams[0]:.1f} deg"
    )


def sensor_upright(sensor: Sensor, measured: bool, scan: Scan, lean_deg: float, rule: RingRule = RING_RULE) -> Sensor:
    """The sensor of a drive that was turned to z up, from that of the drive before. ``scan`` is of the turned drive.

    Its rings may go round the vertical, whatever axes its points were recorded in (clouds in the axes of the vehicle),
    or round its own axis. Upside down the lowest beam is the highest. Beams of leaning rings have no elevation.
    """
    shown = estimate_sensor([scan], sensor.rate_hz, rule)
    if shown.sensor.rings and shown.on_rings >= rule.sure:
        if measured:
            return shown.sensor
        if not contradiction(sensor, scan, rule):
            return sensor
    if lean_deg > 180.0 - rule.upright_deg:
        return replace(sensor, elevations_deg=tuple(-e for e in reversed(sensor.elevations_deg)))
    return sensor if lean_deg < rule.upright_deg else replace(sensor, rings=False)


def turning_about(sensor: Sensor, T_map_lidar: F64, scan: Scan, rule: RingRule = RING_RULE) -> Sensor:
    """The sensor with the axes in which azimuths tell times, by the mount that poses (n, 4, 4) state and one ``scan``.

    A sensor that leans turns about its own z if its rings lie about that, else its points were turned, and it turns
    about the vertical. It faces the way driven in the middle of a revolution. Points without rings may have been
    tilted by some degrees, which hides them.
    """
    mount = mount_of_prior(T_map_lidar)
    if mount is None:
        return sensor if sensor.rings else _tilted(sensor, scan.by_lidar()[0][1], rule)
    if mount.lean_deg > rule.upright_deg:
        first = scan.by_lidar()[0][1]
        own = estimate_sensor([first], sensor.rate_hz, rule)
        level = estimate_sensor([mount.in_steps().scan(first)], sensor.rate_hz, rule)
        only_level_is_known = level.sensor.name in SENSORS and own.sensor.name not in SENSORS
        rings = own.sensor.rings and own.on_rings >= rule.sure and not contradiction(sensor, first, rule)
        if rings and not only_level_is_known:
            return sensor
    forward, left, up = mount.in_steps().C[:3, :3].tolist()
    return replace(sensor, azimuth_axes=(tuple(forward), tuple(left), tuple(up)))


def _tilted(sensor: Sensor, scan: Scan, rule: RingRule) -> Sensor:
    """The sensor without rings whose points were tilted, with the rings that they lie on about another axis, if they
    do."""
    R = level_by_axis(ring_axis(scan.points))
    level = replace(scan, points=np.ascontiguousarray(scan.points @ R.T, dtype=np.float32))
    estimate = estimate_sensor([level], sensor.rate_hz, rule)
    if not estimate.sensor.rings or estimate.on_rings < rule.sure:
        return sensor
    forward, left, up = R.tolist()
    return replace(estimate.sensor, azimuth_axes=(tuple(forward), tuple(left), tuple(up)))


def _angles(scan: Scan) -> tuple[F64, F64, F64]:
    """(elevation, azimuth) in degrees and range in metres of every point."""
    p = scan.points.astype(np.float64)
    flat = np.hypot(p[:, 0], p[:, 1])
    return np.degrees(np.arctan2(p[:, 2], flat)), np.degrees(np.arctan2(p[:, 1], p[:, 0])), np.hypot(flat, p[:, 2])


def _rings(scan: Scan, elevation: F64, azimuth: F64, _: F64) -> I64 | None:
    """Ring of each point, or None."""
    if scan.ring is not None and 3 < len(np.unique(scan.ring)) <= 256:
        return scan.ring.astype(np.int64)
    turns = np.cumsum(np.abs(np.diff(azimuth, prepend=azimuth[:1])) > 180.0)
    # Ring by ring, the azimuth comes round once a ring; a ring hidden at the seam joins its neighbour, hence the share.
    if 8 <= turns[-1] < 256 and len(azimuth) / (turns[-1] + 1) > 100:
        return np.asarray(turns, dtype=np.int64)
    return _clusters(elevation)


def _clusters(elevation: F64) -> I64 | None:
    """Rings as clusters of elevations, with gaps between them; None if they do not cluster."""
    for width_deg in (0.01, 0.03):  # dense sensors first; noise makes too many clusters of the finer bins
        bins = np.arange(-90.0, 90.0 + width_deg, width_deg)
        smooth = np.convolve(np.histogram(elevation, bins)[0].astype(np.float64), np.ones(3), mode="same")
        filled = smooth > 0.1 * np.quantile(smooth[smooth > 0], 0.9)
        starts = np.flatnonzero(filled[1:] & ~filled[:-1]) + 1
        if 4 <= len(starts) <= 256:
            return np.asarray(np.searchsorted(starts, np.digitize(elevation, bins) - 1, side="right"), dtype=np.int64)
    return None


def _ring_model(
    angles: Sequence[tuple[F64, F64, F64]], rings: Sequence[I64], far_m: float
) -> tuple[F64, float, float] | None:
    """(elevations from the top down, azimuth step in degrees, share of far points on their ring), or None."""
    # Elevation and azimuth step of each ring of each scan.
    elevations: list[float] = []
    steps: list[float] = []
    ring_of = []
    for (elevation, azimuth, reach), ring in zip(angles, rings, strict=True):
        for number in np.unique(ring):
            on_ring = ring == number
            far = on_ring & (reach > far_m)
            if on_ring.sum() < 20:
                continue
            elevations.append(float(np.median(elevation[far] if far.sum() >= 10 else elevation[on_ring])))
            gaps = np.diff(np.sort(azimuth[on_ring]))
            gaps = gaps[gaps > 1e-3]
            if len(gaps):
                steps.append(float(np.median(gaps)))
            ring_of.append(int(number))
    if len(set(ring_of)) < 4 or not steps:
        return None
    # The same ring in several scans is one level.
    every = np.sort(elevations)[::-1]
    same = np.cumsum(np.abs(np.diff(every, prepend=every[:1])) > 0.08)
    levels = np.array([np.median(every[same == k]) for k in range(int(same[-1]) + 1)])
    # The share of far points near a level.
    elevation, reach = (np.concatenate([a[k] for a in angles]) for k in (0, 2))
    spacing = np.median(np.abs(np.diff(levels))) if len(levels) > 1 else 1.0
    off = np.abs(elevation - _nearest(levels, elevation))[reach > far_m]
    share = float((off < max(spacing / 3.0, 0.05)).mean()) if len(off) else 0.0
    return levels, float(np.median(steps)), share


def _nearest(levels: F64, values: F64) -> F64:
    """The level (descending) nearest to each value."""
    up = levels[::-1]
    after = np.clip(np.searchsorted(up, values), 1, max(len(up) - 1, 1))
    below = up[after - 1]
    above = up[np.minimum(after, len(up) - 1)]
    return np.where(np.abs(values - below) <= np.abs(values - above), below, above)


def _known(elevations: F64) -> tuple[str, Sensor | None]:
    """The listed model whose beams are these: about as many, and each where one of them is."""
    for name, model in SENSORS.items():
        beams = np.array(model.elevations_deg)
        if abs(len(beams) - len(elevations)) > 0.3 * len(beams):
            continue
        spacing = float(np.median(np.abs(np.diff(np.sort(beams)))))
        off = np.abs(elevations - _nearest(np.sort(beams)[::-1], elevations))
        if (
            np.median(off) < 0.3 * spacing
            and np.abs([elevations[0] - beams.max(), elevations[-1] - beams.min()]).max() < 1.5
        ):
            return name, model
    return "", None


def _ringless(
    elevation: F64, azimuth: F64, rate_hz: float, blind: tuple[tuple[float, float], ...], share: float
) -> Estimate:
    """A model without rings: rows and columns over the field of view, as many as the density of points gives."""
    low, high = np.quantile(elevation, [0.002, 0.998])
    wide = 360.0 - sum(b - a for a, b in blind)
    per_deg = max(len(elevation), 1) / max((high - low) * wide, 1e-6)
    step = float(np.clip(1.0 / np.sqrt(max(per_deg, 1e-6)), 0.05, 2.0))
    rows = int(np.clip(round((high - low) / step), 4, 256))
    grid = tuple(round(float(e), 3) for e in np.linspace(high, low, rows))
    sensor = Sensor("no-rings", grid, round(step, 3), rate_hz=rate_hz, rings=False, blind_sectors_deg=blind)
    origin = (
        f"measured: no rings (only {share:.0%} of the points fit any); {low:.1f} to {high:.1f} deg, {wide:.0f} deg wide"
    )
    return Estimate(sensor, share, origin)


def _blind_sectors(azimuth: F64, rule: RingRule) -> tuple[tuple[float, float], ...]:
    """Azimuths (from, to) in degrees, at least ``rule.blind_deg`` wide, without a point; past 180 where a sector spans
    +-180."""
    turns = round(360.0 / rule.sector_deg)
    empty = np.histogram(azimuth, turns, (-180.0, 180.0))[0] == 0
    if empty.all() or not empty.any():
        return ()
    first = int(np.argmin(empty))  # begin where something is seen, so that no sector is cut in two
    rolled = np.roll(empty, -first)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], rolled, [False]]).astype(np.int8)))
    sectors = []
    for start, stop in edges.reshape(-1, 2):
        if (stop - start) * rule.sector_deg >= rule.blind_deg:
            begin = (start + first) * rule.sector_deg - 180.0
            sectors.append((float(begin), float(begin + (stop - start) * rule.sector_deg)))
    return tuple(sectors)


def _clockwise(scans: Sequence[Scan], angles: Sequence[tuple[F64, F64, F64]]) -> bool:
    """Whether azimuth falls as time goes on; True, as most sensors turn, where no times are known."""
    turned = [
        float(np.sign((np.diff(azimuth[np.argsort(scan.time_s, kind="stable")]) + 180.0) % 360.0 - 180.0).sum())
        for scan, (_, azimuth, _) in zip(scans, angles, strict=True)
        if scan.time_s is not None
    ]
    return sum(turned) <= 0


def _reach(scans: Sequence[Scan]) -> float:
    """The range that nearly all points keep within, rounded up to 10 m, at least 50."""
    farthest = max(float(np.quantile(np.linalg.norm(scan.points, axis=1), 0.999)) for scan in scans)
    return float(max(50.0, np.ceil(farthest / 10.0) * 10.0))
