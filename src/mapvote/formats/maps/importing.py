"""Import: a point cloud in any coordinates becomes a map, with a report."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.formats import stream_cloud
from mapvote.formats.geo.frame import LOCAL, MapFrame
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.tiling import Look, in_map_metres, map_of

NOISE = (7, 18)
"""ASPRS classes: low noise, high noise."""


def import_cloud(
    path: Path,
    wanted: MapFrame | None = None,
    from_crs: str | None = None,
    folder: Path | None = None,
    look: Look | None = None,
) -> tuple[PointMap, list[str]]:
    """(the map, lines that say what became of the file's coordinates, classes and fields).

    ``wanted``: the frame to project to. ``from_crs``: the file's coordinate system, where the file states none or a
    wrong one. ``folder``: where temporary files may lie. ``look``: sees the points, in metres, before a map is made of
    them.
    """
    pieces = stream_cloud(path)
    if from_crs is not None:
        said = MapFrame(LOCAL if from_crs.lower() == LOCAL else from_crs)
        pieces = (replace(piece, frame=said) for piece in pieces)
    left = _LeftOut()
    metres = in_map_metres(str(path), pieces, wanted, sure=from_crs is not None)
    point_map = map_of(str(path), left.noise(metres), folder, look)
    return point_map, left.told()


@dataclass
class _LeftOut:
    """What passes by on the way from the file to the map."""

    frame: MapFrame = field(default_factory=MapFrame)
    points: int = 0
    fields: dict[str, None] = field(default_factory=dict)

    def noise(self, pieces: Iterator[Cloud]) -> Iterator[Cloud]:
        """The pieces without the points that the file classifies as noise."""
        for piece in pieces:
            self.frame = piece.frame
            self.fields |= dict.fromkeys(piece.dropped)
            kept, n = without_noise(piece)
            self.points += n
            yield kept

    def told(self) -> list[str]:
        """In words."""
        told = [f"coordinates: {self.frame.told()}"]
        if self.points:
            told.append(f"dropped: {self.points} points that the file classifies as noise (classes 7 and 18)")
        if self.fields:
            told.append(f"dropped fields: {', '.join(self.fields)}")
        return told


def without_noise(cloud: Cloud) -> tuple[Cloud, int]:
    """The cloud without the points that its file classifies as noise, and how many were dropped."""
    classes = cloud.fields.get("classification")
    if classes is None:
        return cloud, 0
    noise = np.isin(classes, NOISE)
    if not noise.any():
        return cloud, 0
    fields = {name: column[~noise] for name, column in cloud.fields.items()}
    return replace(cloud, points=cloud.points[~noise], fields=fields), int(noise.sum())
