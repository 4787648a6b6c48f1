"""Import: somebody's point cloud, in whatever coordinates, as a map; and what to tell about it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.formats import read_cloud
from mapvote.formats.geo.frame import LOCAL, MapFrame
from mapvote.formats.maps.cloud import Cloud, to_map

NOISE = (7, 18)
"""ASPRS classes: low noise, high noise."""


def import_cloud(path: Path, wanted: MapFrame | None = None, from_crs: str | None = None) -> tuple[PointMap, list[str]]:
    """(the map, lines that say what became of the file's coordinates, classes and fields).

    ``wanted``: the frame to project to. ``from_crs``: what the file is in, where it says nothing or the wrong thing.
    """
    cloud = read_cloud(path)
    if from_crs is not None:
        cloud = replace(cloud, frame=MapFrame(LOCAL if from_crs.lower() == LOCAL else from_crs))
    cloud = cloud.in_metres(str(path), wanted, sure=from_crs is not None)
    told = [f"coordinates: {cloud.frame.told()}"]
    cloud, noise = without_noise(cloud)
    if noise:
        told.append(f"dropped: {noise} points that the file classifies as noise (classes 7 and 18)")
    if cloud.dropped:
        told.append(f"dropped fields: {', '.join(cloud.dropped)}")
    return to_map(str(path), cloud), told


def without_noise(cloud: Cloud) -> tuple[Cloud, int]:
    """The cloud without the points that its file classifies as noise, and how many went."""
    classes = cloud.fields.get("classification")
    if classes is None:
        return cloud, 0
    noise = np.isin(classes, NOISE)
    if not noise.any():
        return cloud, 0
    fields = {name: column[~noise] for name, column in cloud.fields.items()}
    return replace(cloud, points=cloud.points[~noise], fields=fields), int(noise.sum())
