"""The nouns, all on one page. Shapes, dtypes and frames are written beside the arrays.

Frames: ``map`` (the world), ``base`` (the vehicle), ``lidar``. SI units, else the unit is in the name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mapvote.core.grid import Grid
from mapvote.core.record import record
from mapvote.core.sensors import Sensor

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]
U64 = NDArray[np.uint64]
I8 = NDArray[np.int8]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]
_Number = TypeVar("_Number", bound=np.generic)


class MapvoteError(Exception):
    """An error that a user can mend: the message names what, where, how. Printed without a traceback, exit code 1."""


def read_only(array: NDArray[_Number]) -> NDArray[_Number]:
    """The array itself, or a view of it, read-only. Views of a file's bytes are read-only anyway. If all arrays are, a
    kernel is compiled once instead of once for each kind."""
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def check_array(array: Any, name: str, shape: tuple[int | None, ...], dtype: DTypeLike, finite: bool = True) -> None:
    """MapvoteError unless ``array`` has this dtype and shape (None: any length) and, if ``finite``, no NaN or inf."""
    if not isinstance(array, np.ndarray):
        raise MapvoteError(f"{_wanted(name, shape, dtype)}, got a {type(array).__name__}")
    like = tuple(is_ if side is None else side for is_, side in zip(array.shape, shape, strict=False))
    if array.dtype != dtype or array.ndim != len(shape) or array.shape != like:
        raise MapvoteError(f"{_wanted(name, shape, dtype)}, got {array.dtype} {array.shape}")
    if finite and not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))
        raise MapvoteError(f"{name}: {len(bad)} numbers are not finite, the first at {bad[0].tolist()}; leave them out")


def _wanted(name: str, shape: tuple[int | None, ...], dtype: DTypeLike) -> str:
    return f"{name}: expected {np.dtype(dtype)} ({', '.join('n' if side is None else str(side) for side in shape)})"


class CellState(IntEnum):
    """The five classes of paper III-A; the value is the column of a tally."""

    UNCHANGED_OCCUPIED = 0
    UNCHANGED_EMPTY = 1
    CHANGED_OCCUPIED = 2
    CHANGED_EMPTY = 3
    UNDETERMINED = 4


@record(votes=True)
@dataclass(frozen=True, slots=True)
class PrecisePrior:
    """A surveyor's prior, at least this good in both: it guides each registration and holds the map's frame. A place to
    2 cm without an attitude would turn scans to where they hit it: .4 deg, .1 m at 10 m."""

    position_m: float = 0.1
    """Standard deviation of the position, metres."""
    attitude_deg: float = 0.2
    """Standard deviation of the attitude, degrees."""


PRECISE_PRIOR = PrecisePrior()

N_STATES = len(CellState)
NO_VOTE = 255
"""In a uint8 state grid: never seen, or invalid. Not the same as UNDETERMINED."""


@dataclass(frozen=True, slots=True)
class TimesTold:
    """How the times of a scan's points are known."""

    how: Literal["field", "azimuth", "compensated", "none"]
    """A field tells them; they follow from the azimuths; points are stated to be motion-compensated; no field tells
    them, and nothing is stated."""
    told: str
    """The field with unit and origin, or the fields that are there."""
    doubtful: bool = False
    """Whether the user should state what was assumed."""
    fields: tuple[str, ...] = ()
    """The field that tells them, or those that may."""
    other_clock: bool = False
    """Whether the field counts by a clock that is not the stamps'."""


@dataclass(frozen=True, slots=True)
class Scan:
    """One revolution. ``stamp_ns`` is the moment in whose lidar frame the points are, once de-skewed."""

    stamp_ns: int
    points: F32
    """(n, 3) lidar frame; finite, beyond the sensor's minimum range."""
    time_s: F32 | None = None
    """(n,) when each point was measured, relative to ``stamp_ns``; None if already motion-compensated."""
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Attributes (n,) of the points by name, as core/points.py says; intensity is in [0, 1]."""
    ring: U16 | None = None
    """(n,) which beam measured each point, where known."""
    origin: F64 | None = None
    """(3,) where its rays begin, in the frame of the points; None at (0, 0, 0), as with the vehicle's first LiDAR."""

    others: tuple[tuple[int, F64], ...] = ()
    """Parts of a sweep of several LiDARs: the index from which the next LiDAR's points follow, and the origin (3,) of
    their rays."""
    times: TimesTold | None = None
    """How ``time_s`` is known, if it was read; of a sweep, of the LiDAR that says least."""

    @classmethod
    def sweep(cls, stamp_ns: int, scans: Sequence[Scan]) -> Scan:
        """Scans that several LiDARs of one vehicle took in one revolution as one, at ``stamp_ns``. Their points must be
        in one frame (:meth:`seen_from`). Fields and ring stay where all scans have them."""
        if all(scan.time_s is None and scan.stamp_ns == stamp_ns for scan in scans):
            time_s = None
        else:
            zero = (np.zeros(len(s.points), np.float32) if s.time_s is None else s.time_s for s in scans)
            later = (np.float32((s.stamp_ns - stamp_ns) * 1e-9) for s in scans)
            time_s = np.concatenate([t + late for t, late in zip(zero, later, strict=True)])
        names = [name for name in scans[0].fields if all(name in s.fields for s in scans)]
        ring = [s.ring for s in scans if s.ring is not None]
        starts = np.cumsum([len(s.points) for s in scans[:-1]]).tolist()
        origins = [np.zeros(3) if s.origin is None else s.origin for s in scans]
        return cls(
            stamp_ns,
            np.concatenate([s.points for s in scans]),
            time_s,
            {name: np.concatenate([s.fields[name] for s in scans]) for name in names},
            np.concatenate(ring) if len(ring) == len(scans) else None,
            scans[0].origin,
            tuple(zip(starts, origins[1:], strict=True)),
            next((s.times for s in scans if s.times is not None and s.times.how == "none"), scans[0].times),
        )

    def by_lidar(self) -> list[tuple[slice, Scan]]:
        """Where the points of each LiDAR are, and its own part: one of a scan that one LiDAR took."""
        if not self.others:
            return [(slice(None), self)]
        starts = [0, *(start for start, _ in self.others), len(self.points)]
        origins = [self.origin, *(origin for _, origin in self.others)]
        parts = [slice(a, b) for a, b in pairwise(starts)]
        return [(part, self._part(part, origin)) for part, origin in zip(parts, origins, strict=True)]

    def _part(self, part: slice, origin: F64 | None) -> Scan:
        return Scan(
            self.stamp_ns,
            self.points[part],
            None if self.time_s is None else self.time_s[part],
            {name: values[part] for name, values in self.fields.items()},
            None if self.ring is None else self.ring[part],
            origin,
        )

    def origin_map(self, T_map_lidar: F64) -> F64:
        """(3,) where its rays begin, in map metres; of a sweep those of its first LiDAR."""
        start = T_map_lidar[:3, 3] if self.origin is None else T_map_lidar[:3, :3] @ self.origin + T_map_lidar[:3, 3]
        return np.array(start, dtype=np.float64)

    def seen_from(self, T_first_other: F64) -> Scan:
        """The scan of another LiDAR of the vehicle in the frame of its first one."""
        T = T_first_other.astype(np.float32)  # points are floats of 32 bits, and rounded to them in the end
        points = self.points @ T[:3, :3].T + T[:3, 3]
        return replace(self, points=points, origin=T_first_other[:3, 3].copy())

    def __post_init__(self) -> None:
        check_array(self.points, "Scan.points", (None, 3), np.float32)
        if self.time_s is not None:
            check_array(self.time_s, "Scan.time_s", (len(self.points),), np.float32)
        for name, values in self.fields.items():
            dtype = getattr(values, "dtype", np.float32)
            check_array(values, f"Scan.fields[{name!r}]", (len(self.points),), dtype)


@dataclass(frozen=True, slots=True)
class Drive:
    """A recorded drive, streamed: scans are read one by one, never all at once."""

    path: Path
    vehicle: str
    drive_id: str
    sensor: Sensor
    stamps_ns: I64
    """(n,) strictly increasing."""
    read_scan: Callable[[int], Scan]
    """Scan i of this drive; raises MapvoteError naming the file and the defect."""
    T_map_lidar_prior: F64 | None = None
    """(n, 4, 4) what the vehicle believed (GNSS/INS), or None."""
    prior_sigma_m: float = 1.0
    prior_sigma_deg: float = 1.0
    prior_sigmas: F64 | None = None
    """(n, 2) standard deviations of priors by satellite fixes, metres in the plane and radians of heading; inf where a
    scan has no prior. The two above are then their medians."""
    prior_in_map: bool = True
    """Whether the prior is in the map's frame; odometry in a frame of its own (REP 105: odom) is not."""
    T_base_lidar: F64 = field(default_factory=lambda: np.eye(4))
    georeference: Mapping[str, str] = field(default_factory=dict)
    """Where on Earth the prior's frame lies, as a map carries it; empty if unknown."""
    sensor_told: str = ""
    """Where the sensor's model comes from, and how sure it is."""
    left_out: tuple[str, ...] = ()
    """Sentences on scans of the recording that are not among these."""

    def __post_init__(self) -> None:
        check_array(self.stamps_ns, "Drive.stamps_ns", (None,), np.int64)
        check_array(self.T_base_lidar, "Drive.T_base_lidar", (4, 4), np.float64)
        if self.T_map_lidar_prior is not None:
            check_array(self.T_map_lidar_prior, "Drive.T_map_lidar_prior", (len(self.stamps_ns), 4, 4), np.float64)

    @property
    def has_precise_prior(self) -> bool:
        """Whether its prior is a surveyor's."""
        good = self.prior_sigma_m <= PRECISE_PRIOR.position_m and self.prior_sigma_deg <= PRECISE_PRIOR.attitude_deg
        return self.T_map_lidar_prior is not None and self.prior_sigmas is None and good

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __iter__(self) -> Iterator[Scan]:
        return (self.read_scan(i) for i in range(len(self)))


@dataclass(frozen=True, slots=True)
class PosePrior:
    """Prior information on a pose: independent errors of position and rotation."""

    T_map_lidar: F64
    sigma_m: float
    sigma_rad: float
    is_planar: bool = False
    """Whether place and heading in the plane alone are believed, as by satellite fixes: height, roll and pitch are not.
    """

    def __post_init__(self) -> None:
        check_array(self.T_map_lidar, "T_map_lidar of the prior", (4, 4), np.float64)

    @classmethod
    def of(cls, drive: Drive, i: int) -> PosePrior | None:
        """The prior of scan ``i`` of ``drive``, if it has one."""
        if drive.T_map_lidar_prior is None:
            return None
        if drive.prior_sigmas is not None:
            sigma_m, sigma_rad = drive.prior_sigmas[i].tolist()
            return cls(drive.T_map_lidar_prior[i], sigma_m, sigma_rad, True) if np.isfinite(sigma_m) else None
        return cls(drive.T_map_lidar_prior[i], drive.prior_sigma_m, float(np.radians(drive.prior_sigma_deg)))

    @property
    def information(self) -> F64:
        """(6, 6) inverse covariance of (x, y, z, roll, pitch, yaw) in map axes."""
        level = 0.0 if self.is_planar else 1.0
        position = self.sigma_m**-2
        rotation = self.sigma_rad**-2
        out = np.zeros((6, 6))
        out.flat[::7] = position, position, level * position, level * rotation, level * rotation, rotation
        return out


@dataclass(frozen=True, slots=True)
class Registration:
    """A pose and how far to trust it (a lost vehicle must never demolish a street)."""

    T_map_lidar: F64
    covariance: F64
    """(6, 6) of the pose error (rho, phi) in map axes about the sensor: t' = t + rho, R' = exp(phi) R."""
    score: float
    """Mean NDT likelihood of the points used, in [0, 1]."""
    inlier_share: float
    """Share of the points used that fell into a populated voxel and agreed with it."""
    iterations: int
    converged: bool


@dataclass(frozen=True, slots=True)
class Reference:
    """The partial reference map R_i (paper III-A) as planes over one window.

    Where obstacles were not measured (:class:`mapvote.core.reference.LocalMap`), ``counts``, ``bottom_z`` and ``top_z``
    say that there are none.
    """

    grid: Grid
    ground_z: F32
    """(rows, cols) map metres, NaN where unknown."""
    base: I32
    """(rows, cols) lattice layer of bit 0 of each column: floor(ground_z / 0.3); smooth, filled where unknown."""
    occupied: U64
    """(rows, cols) column words of the map's obstacle points (above ground)."""
    counts: I32
    """(rows, cols) obstacle points of the map in each cell."""
    bottom_z: F32
    """(rows, cols) lowest obstacle point of the map in the cell, map metres; +inf where none."""
    top_z: F32
    """(rows, cols) highest obstacle point of the map in the cell, map metres; -inf where none."""
    free: U64 | None
    """(rows, cols) column words known to be free, or None if this map never learned them."""
