"""Parts that every drive format shares: drive.toml, ``--scans``, names, priors; and the making of a Drive from them."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import msgspec
import numpy as np
from msgspec import structs

from mapvote.config import did_you_mean
from mapvote.core import geometry
from mapvote.core.sensors import NAMED, Sensor
from mapvote.core.times import has_date
from mapvote.core.types import F64, I64, Drive, MapvoteError, Scan
from mapvote.formats.drives.bag_files import is_bag, is_bag_without_metadata
from mapvote.formats.drives.point_times import UNITS_NS, TimeRules
from mapvote.formats.drives.sensor_estimate import (
    RING_RULE,
    UNKNOWN_SENSOR,
    estimate_sensor,
    rate_of_first,
    turning_about,
)
from mapvote.formats.geo.frame import MapFrame, enu_frame
from mapvote.formats.listing import below, entry, file_if_any
from mapvote.formats.reading import read_text


class SaidOfDrive(TypedDict, total=False):
    """Options of a drive when it is opened, by name; None says nothing."""

    scans: str | None
    prior: str | None
    rate_hz: float | None
    sensor: str | None
    vehicle: str | None
    mount: str | None
    topic: str | None
    columns: str | None
    dtype: str | None
    motion_compensated: bool | None
    time_field: str | None
    time_unit: str | None
    frame: MapFrame | None
    as_live: bool


class DriveOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Facts that the files of a drive cannot state: drive.toml, in which every key is optional, and over it the
    caller's arguments."""

    vehicle: str | None = None
    drive: str | None = None
    sensor: str | dict[str, Any] | None = None
    """A name of ``core.sensors.NAMED``, or a table of Sensor's fields; a table wins over what the scans say."""
    rate_hz: float | None = None
    start_ns: int = 0
    prior: str | None = None
    prior_sigma_m: float = 1.0
    prior_sigma_deg: float = 1.0
    T_base_lidar: list[float] | None = None
    """12 numbers, the rows of the 3 x 4 matrix; or 6: x, y, z in metres, roll, pitch, yaw in degrees."""
    motion_compensated: bool | None = None
    time_field: str | None = None
    """The field with the times of points, or "none"."""
    time_unit: str | None = None
    topic: str | None = None
    """The PointCloud2 topic of a bag."""
    origin: list[float] | None = None
    """Latitude, longitude (degrees), altitude (metres) of the map's origin, for priors from GNSS."""
    columns: str | None = None
    """Names of a .bin or .npy scan's columns, comma-separated."""
    dtype: str | None = None
    scans: str | None = None
    mounts: dict[str, list[float]] = {}
    """``T_base_lidar`` of each PointCloud2 topic of a bag, instead of /tf_static."""
    mount: str | None = None
    """``T_base_lidar`` as the command line gives it."""
    frame: MapFrame | None = None
    """The map's frame, into which latitudes and longitudes go."""
    as_live: bool = False
    """Whether poses, mount and sensor of a bag are chosen as ``mapvote drive`` chooses them from the same topics."""

    @property
    def time_rules(self) -> TimeRules:
        """The statements on the times of points."""
        rate = self.rate_hz is not None or (isinstance(self.sensor, dict) and "rate_hz" in self.sensor)
        return TimeRules(self.motion_compensated, self.time_field, self.time_unit, rate)


def beside(drive: Path) -> Path:
    """The folder in which drive.toml, prior.txt and other files of a drive lie: its own, or that of its only file."""
    return drive.parent if drive.is_file() else drive


def source_of_times(drive: Path) -> str:
    """Where the times of a drive's scans stand, as advice names it."""
    for name in ("times.txt", "velodyne_points/timestamps.txt"):
        if entry(drive, name).is_file():
            return name
    in_messages = not drive.is_dir() or is_bag(drive) or is_bag_without_metadata(drive)
    return "the stamps of its messages" if in_messages else "the names of its scans"


def drive_options(folder: Path, **said: Unpack[SaidOfDrive]) -> DriveOptions:
    """drive.toml in ``folder``, or beside a drive that is one file, and over it what is ``said``. MapvoteError names an
    unknown key or a wrong value."""
    file = beside(folder) / "drive.toml"
    stated = file_if_any(beside(folder), "drive.toml")
    try:
        table = {} if stated is None else tomllib.loads(read_text(stated))
    except tomllib.TOMLDecodeError as error:
        raise MapvoteError(f"{file}: not valid TOML ({error})") from error
    prior = table.get("prior")
    # A name with a slash in front is a topic, unless it is a file elsewhere.
    if isinstance(prior, str) and (not prior.startswith("/") or Path(prior).exists()):
        place = below(beside(folder), prior, file)
        table["prior"] = str(place) if place.is_file() else prior
    not_in_file = ("scans", "mount", "frame", "as_live")
    keys = [key for key in DriveOptions.__struct_fields__ if key not in not_in_file]
    for key in table:
        if key not in keys:
            raise MapvoteError(f"{file}: unknown key {key!r}{did_you_mean(key, keys)}")
    try:
        options = msgspec.convert(table, DriveOptions)
    except msgspec.ValidationError as error:
        raise MapvoteError(f"{file}: {error}") from error
    if not (0.0 < options.prior_sigma_m < math.inf and 0.0 < options.prior_sigma_deg < math.inf):
        raise MapvoteError(f"{file}: prior_sigma_m and prior_sigma_deg must be positive numbers")
    for unit, per_ns in (("seconds", 10**9), ("milliseconds", 10**6), ("microseconds", 10**3)):
        start_ns = options.start_ns * per_ns
        if has_date(start_ns) and start_ns <= 4_102_444_800 * 10**9:  # the year 2100
            problem = f"{file}: start_ns = {options.start_ns} looks like {unit} since 1970"
            raise MapvoteError(f"{problem}: write nanoseconds, {start_ns}")
    options = structs.replace(options, **{name: value for name, value in said.items() if value is not None})
    if options.time_unit not in (None, *UNITS_NS):
        raise MapvoteError(f"{file}: time_unit is {options.time_unit!r}; it must be {', '.join(UNITS_NS)}")
    return options


def read_mount(numbers: list[float] | str, source: str) -> F64:
    """T_base_lidar (4, 4) from 12 numbers (rows of 3 x 4) or 6 (metres; roll, pitch, yaw in degrees)."""
    try:
        values = [float(v) for v in numbers.replace(",", " ").split()] if isinstance(numbers, str) else numbers
    except ValueError as error:
        raise MapvoteError(f"{source}: T_base_lidar is not a list of numbers: {numbers!r}") from error
    T_base_lidar = np.eye(4)
    if len(values) == 12:
        T_base_lidar[:3] = np.reshape(values, (3, 4))
    elif len(values) == 6:
        T_base_lidar = geometry.from_xyz_rpy(*values[:3], *np.deg2rad(values[3:]))
    if len(values) not in (6, 12) or not geometry.is_rigid(T_base_lidar):
        raise MapvoteError(
            f"{source}: T_base_lidar must be 12 numbers (a rigid 3 x 4 matrix, row by row) or 6 "
            f"(x, y, z in metres, roll, pitch, yaw in degrees); got {len(values)}: {values}"
        )
    return T_base_lidar


def read_sensor(sensor: str | dict[str, Any], source: str) -> Sensor:
    """A sensor by name, or by a table of its fields. MapvoteError lists the known ones."""
    if isinstance(sensor, str):
        if sensor not in NAMED:
            raise MapvoteError(
                f"{source}: no sensor named {sensor!r}{did_you_mean(sensor, NAMED)}; known: {', '.join(NAMED)}; "
                f"others as a table [sensor] in drive.toml (name, elevations_deg, azimuth_step_deg)"
            )
        return NAMED[sensor]
    keys = [f.name for f in fields(Sensor)]
    for key in sensor:
        if key not in keys:
            raise MapvoteError(f"{source}: [sensor]: unknown key {key!r}{did_you_mean(key, keys)}")
    try:
        return msgspec.convert(sensor, Sensor)
    except msgspec.ValidationError as error:
        raise MapvoteError(f"{source}: [sensor]: {error}") from error


def map_frame(options: DriveOptions) -> MapFrame | None:
    """The frame that latitudes and longitudes go into: the map's, else a plane at drive.toml's origin, else None."""
    if options.frame is not None and not options.frame.is_local:
        return options.frame
    if options.origin is None:
        return None
    if len(options.origin) != 3 or not np.isfinite(options.origin).all() or abs(options.origin[0]) > 90.0:
        raise MapvoteError("drive.toml: origin must be latitude, longitude (degrees), altitude (metres)")
    return enu_frame(*options.origin)


def step_of(stamps_ns: I64) -> float | None:
    """Seconds between two scans (median) of stamps (n,); None of one scan."""
    return float(np.median(np.diff(stamps_ns))) * 1e-9 if len(stamps_ns) > 1 else None


def parse_scans(scans: str | None, n: int, source: str) -> I64:
    """Indices (m,) of the scans that comma-separated ``START:STOP:STEP`` slices choose from n; each once, ascending."""
    if scans is None:
        return np.arange(n, dtype=np.int64)
    chosen = np.zeros(n, dtype=bool)
    for piece in scans.split(","):
        try:
            parts = [int(p) if p.strip() else None for p in piece.split(":")]
            if len(parts) > 3 or parts == [None]:
                raise ValueError("not a slice")
            if len(parts) == 1:
                chosen[int(parts[0] or 0)] = True
            else:
                chosen[slice(*parts)] = True
        except (ValueError, IndexError):
            raise MapvoteError(
                f"{source}: --scans {piece!r} chooses nothing from {n} scans; write whole numbers as START:STOP:STEP, "
                f"for example 0:12,24:36"
            ) from None
    if not chosen.any():
        raise MapvoteError(f"{source}: --scans {scans!r} chooses none of its {n} scans")
    return np.flatnonzero(chosen)


def _name(said: str | None, path: Path, owner: str) -> str:
    """A legal name of a vehicle or a drive: the stated one, else made from the file's name."""
    name = said or re.sub(r"[^A-Za-z0-9._-]+", "-", path.resolve().name).lstrip("._-")[:64] or "drive"
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", name):
        raise MapvoteError(
            f"{path}: {owner} {name!r} is not a legal name: 1 to 64 letters, digits, dots, underscores and dashes"
        )
    return name


def make_drive(
    path: Path,
    options: DriveOptions,
    *,
    stamps_ns: I64,
    T_map_lidar_prior: F64 | None,
    read_scan: Callable[[int, Sensor], Scan],
    frame: MapFrame = MapFrame(),  # noqa: B008 - frozen
    T_base_lidar: F64 | None = None,
    prior_sigmas: F64 | None = None,
) -> Drive:
    """A Drive of the chosen scans. ``stamps_ns`` (n,), the prior (n, 4, 4) and its sigmas (n, 2) are of all scans of
    the files.

    ``frame``: where the prior's frame lies. ``T_base_lidar``: the format's own mount, unless another is given.
    The sensor is what the caller or drive.toml say, else it is measured in some of the scans.

    MapvoteError if stamps do not increase or a prior is not a rigid motion.
    """
    source = str(path)
    late = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(late):
        i = int(late[0]) + 1
        raise MapvoteError(
            f"{source}: times are not sorted: scan {i} ({stamps_ns[i] / 1e9:.6f} s) does not come after scan {i - 1} "
            f"({stamps_ns[i - 1] / 1e9:.6f} s); {len(late)} such places; "
            f"sort the scans by time or correct {source_of_times(path)}"
        )
    chosen = parse_scans(options.scans, len(stamps_ns), source)
    rate_hz = options.rate_hz
    sensor, sensor_told = _sensor_of(source, options, stamps_ns, chosen, read_scan)
    if rate_hz is not None:
        if not 0.1 <= rate_hz <= 100:
            raise MapvoteError(f"{source}: a rate of {rate_hz} Hz is not a LiDAR's; give revolutions per second")
        sensor = replace(sensor, rate_hz=rate_hz)
    T_map_lidar = None if T_map_lidar_prior is None else T_map_lidar_prior[chosen]
    sigmas = None if prior_sigmas is None else prior_sigmas[chosen]
    sigma_m, sigma_deg = _usual_sigmas(options, sigmas)
    if options.motion_compensated is False and T_map_lidar is not None:
        middle = read_scan(int(chosen[len(chosen) // 2]), replace(sensor, rings=True))  # whether or not it has any
        sensor = turning_about(sensor, T_map_lidar, middle)

    return Drive(
        path=path,
        vehicle=_name(options.vehicle, path, "vehicle"),
        drive_id=_name(options.drive, path, "drive"),
        sensor=sensor,
        stamps_ns=stamps_ns[chosen],
        read_scan=lambda i: read_scan(int(chosen[i]), sensor),
        T_map_lidar_prior=T_map_lidar,
        prior_sigma_m=sigma_m,
        prior_sigma_deg=sigma_deg,
        prior_sigmas=sigmas,
        T_base_lidar=mount_of(options, T_base_lidar, source),
        georeference={} if frame.is_local else frame.georeference(),
        sensor_told=sensor_told,
    )


def _usual_sigmas(options: DriveOptions, sigmas: F64 | None) -> tuple[float, float]:
    """Standard deviations of a drive's priors in metres and degrees: the medians of ``sigmas`` (n, 2), metres and
    radians, where the priors have their own, else those of the options."""
    if sigmas is None or not np.isfinite(sigmas[:, 0]).any():
        return options.prior_sigma_m, options.prior_sigma_deg
    sigma_m, sigma_rad = np.median(sigmas[np.isfinite(sigmas[:, 0])], axis=0).tolist()
    return sigma_m, float(np.degrees(sigma_rad))


def _sensor_of(
    source: str,
    options: DriveOptions,
    stamps_ns: I64,
    chosen: I64,
    read_scan: Callable[[int, Sensor], Scan],
) -> tuple[Sensor, str]:
    """(the sensor, where it comes from). A table that gives only some fields wins over the measured ones."""
    said = options.sensor
    rate_hz = options.rate_hz
    if isinstance(said, str):
        return read_sensor(said, source), "named"
    if isinstance(said, dict) and {"name", "elevations_deg", "azimuth_step_deg"} <= set(said):
        return read_sensor(said, source), "drive.toml"
    sample = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), 3)).astype(np.int64)]
    if options.as_live and rate_hz is None and len(chosen) > 1:
        sample = chosen[: RING_RULE.scans]
        rate_hz = rate_of_first(stamps_ns[sample])
    elif rate_hz is None and len(stamps_ns) > 1:
        rate_hz = float(np.clip(1e9 / np.median(np.diff(stamps_ns)), 0.1, 100.0))
    read = (read_scan(int(i), replace(UNKNOWN_SENSOR, rate_hz=rate_hz or 10.0)) for i in np.unique(sample))
    scans = [scan.by_lidar()[0][1] for scan in read]  # the first LiDAR's own
    estimate = estimate_sensor(scans, rate_hz or 10.0)
    if isinstance(said, dict):
        estimated = msgspec.to_builtins(estimate.sensor)
        return read_sensor(estimated | said, source), f"drive.toml, the rest {estimate.told}"
    return estimate.sensor, estimate.told


def mount_of(options: DriveOptions, own: F64 | None, source: str) -> F64:
    """T_base_lidar (4, 4): what the options say, else the format's own, else the identity."""
    said = options.mount or options.T_base_lidar
    if said is not None:
        return read_mount(said, source)
    return np.eye(4) if own is None else own
