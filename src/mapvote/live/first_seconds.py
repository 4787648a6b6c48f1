"""The doctor's checks on the first ten seconds of a live drive: no ballot leaves the vehicle before they are done."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive, MapvoteError, Scan
from mapvote.doctor import Finding, any_error, in_order
from mapvote.doctor.map_fit import check_on_map
from mapvote.doctor.scans import NO_PRIOR, Looking, cheap_checks
from mapvote.vehicle import Vehicle

_SECONDS_NS = 10 * 10**9
_EVERY = 4
"""Each scan is looked at, and one of so many is kept: 30 MB."""
_SICK = 0.5
"""If fewer scans have a sure place it is asked how the drive lies on the map."""


class FirstSeconds:
    """Some scans of the first ten seconds, and what is wrong with them."""

    def __init__(self, sensor_told: str) -> None:
        self._told = sensor_told
        self._kept: dict[int, Scan] = {}
        self._stamps_ns, self._priors = list[int](), list[F64 | None]()
        self._looking: Looking | None = None

    def add(self, scan: Scan, T_map_lidar_prior: F64 | None, vehicle: Vehicle) -> bool:
        """Look at this scan; returns whether the ten seconds are over."""
        if self._looking is None:
            self._looking = Looking(self._drive(vehicle))
        n = len(self._stamps_ns)
        self._stamps_ns.append(scan.stamp_ns)
        self._priors.append(T_map_lidar_prior)
        self._kept[n] = scan
        self._looking.look([n])
        if n % _EVERY:
            del self._kept[n]
        return scan.stamp_ns - self._stamps_ns[0] >= _SECONDS_NS

    def _drive(self, vehicle: Vehicle) -> Drive:
        priors = [T for T in self._priors if T is not None]
        return Drive(
            Path("the first seconds"),
            vehicle.name,
            vehicle.drive_id,
            vehicle.sensor,
            np.array(self._stamps_ns, dtype=np.int64),
            lambda i: self._kept[i] if i in self._kept else self._kept[i - i % _EVERY],
            np.stack(priors) if priors and len(priors) == len(self._stamps_ns) else None,
            sensor_told=self._told,
        )

    def findings(self, vehicle: Vehicle, point_map: PointMap) -> list[Finding]:
        """What shows in the scans themselves, and, if the vehicle finds no sure place, how they lie on the map."""
        if self._looking is None:
            return []
        drive = self._drive(vehicle)
        found = [f for f in cheap_checks(drive, self._looking.look([])) if f != NO_PRIOR]
        report = vehicle.report
        decided = len(report.T_map_lidar)
        if decided and len(report.lost) > _SICK * decided and not any_error(found):
            found += self._on_map(drive, point_map, len(report.lost), decided)
        return in_order(found)

    def _on_map(self, drive: Drive, point_map: PointMap, lost: int, decided: int) -> list[Finding]:
        what = f"{lost} of the first {decided} scans have no sure place on map {point_map.map_id}"
        lost_scans = Finding("warning", what, "they cast no vote; is this the map of this road?")
        if drive.T_map_lidar_prior is None:
            return [lost_scans]
        try:
            found = check_on_map(drive, drive.T_map_lidar_prior, point_map)[0]
        except MapvoteError as error:
            return [lost_scans, Finding("warning", str(error))]
        return [lost_scans, *found]
