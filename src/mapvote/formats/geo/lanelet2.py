"""Lanelet2 maps: the OSM file that Autoware calls lanelet2_map.osm, its lanelets, areas and lines in map metres.

Nodes carry latitude and longitude, Autoware's also ``local_x`` and ``local_y`` in metres. A way is a line of nodes. A
relation of type lanelet names its left and its right way; one of type multipolygon names the ways around an area.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from xml.etree import ElementTree

import numpy as np
import shapely

from mapvote.core.types import F64, MapvoteError
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.reading import reading

log = logging.getLogger("mapvote.formats")


@dataclass(frozen=True, slots=True)
class MapPart:
    """A lanelet, an area or a line of a lanelet2 map."""

    kind: str
    """"lanelet", "area", or the type of a line: stop_line, traffic_sign, traffic_light, ..."""
    subtype: str
    """Its tag ``subtype``, such as road or crosswalk; "" without one."""
    id: str
    """Its id in the file."""
    shape: Any
    """shapely geometry, map metres, seen from above."""
    element: ElementTree.Element
    """Its place in the file."""


@dataclass(frozen=True, slots=True)
class LaneletMap:
    """A lanelet2 file: its parts, and the XML that they lie in."""

    parts: list[MapPart]
    tree: ElementTree.ElementTree[ElementTree.Element]


def read_lanelets(file: Path, frame: MapFrame, content: BinaryIO | None = None) -> LaneletMap:
    """The parts of a lanelet2 file, in the metres of ``frame``. ``content``: what the file holds, if it is not on this
    machine.

    By latitude and longitude if the frame knows its place on Earth, else by ``local_x`` and ``local_y``. A way that
    only bounds lanelets is no part of its own. Parts without a shape are counted in a warning that names the first.

    MapvoteError if the file is no lanelet2 map, or its nodes lack these coordinates.
    """
    with reading(file, "lanelet2 map (OSM XML)"):
        tree = ElementTree.parse(
            content or file, ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
        )
    root = tree.getroot()
    if root.tag != "osm":
        raise MapvoteError(f"{file}: no lanelet2 map: its first element is <{root.tag[:40]}>, not <osm>")
    positions = _positions(root, frame, file)
    lines, lost = _lines(root, positions)
    bounds = _bounds(root)
    parts = []
    for part in _all_parts(root, lines, bounds):
        if part.shape is None or part.shape.is_empty:
            lost.append(f"{part.kind} {part.id}")
        else:
            parts.append(part)
    if lost:
        log.warning("%s: %d parts have no shape, first: %s; they are left out", file, len(lost), lost[0])
    if not parts:
        raise MapvoteError(f"{file}: holds no lanelet, area or line; is it a lanelet2 map?")
    return LaneletMap(parts, tree)


def _positions(root: ElementTree.Element, frame: MapFrame, file: Path) -> dict[str, F64]:
    """(2,) map metres of each node, by its id."""
    nodes = [node for node in root.iter("node") if node.get("action") != "delete"]
    ids = [str(node.get("id")) for node in nodes]
    if frame.is_local:
        coordinates = [(_tags(node).get("local_x"), _tags(node).get("local_y")) for node in nodes]
        names = "local_x and local_y; the changes lie in local metres, so name their frame: --projector MGRS:54SUE"
    else:
        coordinates = [(node.get("lon"), node.get("lat")) for node in nodes]
        names = "lat and lon; if its local_x and local_y are metres of the map, give --projector Local"
    lacking = [name for name, pair in zip(ids, coordinates, strict=True) if not all(pair)]
    if lacking:
        raise MapvoteError(f"{file}: {len(lacking)} of {len(ids)} nodes, first {lacking[0]}, have no {names}")
    try:
        xy = np.array(coordinates, dtype=np.float64).reshape(-1, 2)
    except ValueError as error:
        raise MapvoteError(f"{file}: a coordinate of a node is no number ({error})") from error
    if not np.isfinite(xy).all():
        raise MapvoteError(
            f"{file}: a coordinate of node {ids[int(np.argmin(np.isfinite(xy).all(axis=1)))]} is not finite"
        )
    if not frame.is_local and len(xy):
        xy = frame.plane_from_lonlat(xy)
    return dict(zip(ids, xy, strict=True))


def _lines(root: ElementTree.Element, positions: Mapping[str, F64]) -> tuple[dict[str, F64], list[str]]:
    """((n, 2) corners of each way by its id, the ways that name a node that is not there)."""
    lines: dict[str, F64] = {}
    lost: list[str] = []
    for way in _there(root, "way"):
        refs = [str(nd.get("ref")) for nd in way.iter("nd")]
        if len(refs) >= 2 and all(ref in positions for ref in refs):
            lines[str(way.get("id"))] = np.array([positions[ref] for ref in refs])
        else:
            lost.append(f"way {way.get('id')}")
    return lines, lost


def _bounds(root: ElementTree.Element) -> set[str]:
    """The ways that bound a lanelet or an area, or are its centreline: their relation stands for them."""
    relations = [r for r in _there(root, "relation") if _tags(r).get("type") in ("lanelet", "multipolygon")]
    return {str(m.get("ref")) for r in relations for m in r.iter("member") if m.get("type") == "way"}


def _all_parts(root: ElementTree.Element, lines: Mapping[str, F64], bounds: set[str]) -> Iterator[MapPart]:
    for relation in _there(root, "relation"):
        tags = _tags(relation)
        name = str(relation.get("id"))
        if tags.get("type") == "lanelet":
            yield MapPart("lanelet", tags.get("subtype", ""), name, _lanelet(relation, lines), relation)
        elif tags.get("type") == "multipolygon":
            yield MapPart("area", tags.get("subtype", ""), name, _area(relation, lines), relation)
    edges = ("line_thin", "line_thick", "virtual", "")  # types that mean nothing but the edge of a lane
    for way in _there(root, "way"):
        tags = _tags(way)
        name = str(way.get("id"))
        kind = tags.get("type", "")
        if name not in lines or (name in bounds and kind in edges):
            continue
        closed = tags.get("area") == "yes"
        shape = _polygon(lines[name]) if closed else shapely.LineString(lines[name])
        yield MapPart(kind or "line", tags.get("subtype", ""), name, shape, way)


def _lanelet(relation: ElementTree.Element, lines: Mapping[str, F64]) -> Any:
    """The polygon between the left and the right bound. A file may store either way in either direction: of the two
    polygons the one with the shorter ends is right (Lanelet2 aligns bounds likewise)."""
    left, right = (_joined(_members(relation, role, lines)) for role in ("left", "right"))
    if left is None or right is None:
        return None
    straight = np.linalg.norm(left[0] - right[0]) + np.linalg.norm(left[-1] - right[-1])
    crossed = np.linalg.norm(left[0] - right[-1]) + np.linalg.norm(left[-1] - right[0])
    return _polygon(np.concatenate([left, right[::-1] if straight <= crossed else right]))


def _area(relation: ElementTree.Element, lines: Mapping[str, F64]) -> Any:
    outer = _joined(_members(relation, "outer", lines))
    if outer is None:
        return None
    inner = [_polygon(line) for line in _members(relation, "inner", lines) if len(line) >= 3]
    return shapely.difference(_polygon(outer), shapely.union_all(inner)) if inner else _polygon(outer)


def _members(relation: ElementTree.Element, role: str, lines: Mapping[str, F64]) -> list[F64]:
    refs = [str(m.get("ref")) for m in relation.iter("member") if m.get("role") == role and m.get("type") == "way"]
    return [lines[ref] for ref in refs if ref in lines]


def _joined(lines: Sequence[F64]) -> F64 | None:
    """The one line that ways make end to end, in whatever order and direction they are listed; None if they do not."""
    if not lines:
        return None
    merged = shapely.line_merge(shapely.multilinestrings([shapely.LineString(line) for line in lines]))
    return shapely.get_coordinates(merged) if merged.geom_type == "LineString" else None


def _polygon(corners: F64) -> Any:
    """The polygon of (n, 2) corners, mended where it crosses itself; None of fewer than three."""
    return shapely.make_valid(shapely.Polygon(corners)) if len(corners) >= 3 else None


def _there(root: ElementTree.Element, tag: str) -> Iterator[ElementTree.Element]:
    """The elements that an editor has not marked as deleted."""
    return (element for element in root.iter(tag) if element.get("action") != "delete")


def _tags(element: ElementTree.Element) -> dict[str, str]:
    return {str(tag.get("k")): str(tag.get("v")) for tag in element.iter("tag")}
