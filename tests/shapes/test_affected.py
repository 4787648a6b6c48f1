"""Elements near changes in a lanelet2 map: exact on a crossing drawn by hand, whichever way its lines are stored."""

from __future__ import annotations

import json
import logging
from itertools import count
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from command_line import typed
from mapvote.core.types import MapvoteError
from mapvote.formats.geo.frame import MapFrame, read_projector
from mapvote.formats.geo.lanelet2 import read_lanelets
from mapvote.shapes.affected import TAG, affected_parts, affected_rows, marked_osm, read_changes

MGRS = read_projector("MGRS:54SUE")
Line = list[tuple[float, float]]


class Drawing:
    """A lanelet2 file, written as editors do: nodes, ways, relations."""

    def __init__(self, *, degrees: bool = True, metres: bool = True) -> None:
        self.degrees, self.metres = degrees, metres
        self.root, self.ids = ElementTree.Element("osm", {"generator": "test"}), count(1)

    def way(self, line: Line, **tags: str) -> str:
        refs = [self._node(x, y) for x, y in line]
        way = ElementTree.SubElement(self.root, "way", {"id": str(next(self.ids))})
        for ref in refs:
            ElementTree.SubElement(way, "nd", {"ref": ref})
        return self._tagged(way, tags)

    def relation(self, members: list[tuple[str, str]], **tags: str) -> str:
        relation = ElementTree.SubElement(self.root, "relation", {"id": str(next(self.ids))})
        for role, ref in members:
            ElementTree.SubElement(relation, "member", {"type": "way", "role": role, "ref": ref})
        return self._tagged(relation, tags)

    def lanelet(self, left: Line, right: Line, subtype: str = "road") -> str:
        bounds = [("left", self.way(left, type="line_thin")), ("right", self.way(right, type="line_thin"))]
        return self.relation(bounds, type="lanelet", subtype=subtype)

    def save(self, file: Path) -> Path:
        ElementTree.ElementTree(self.root).write(file, encoding="UTF-8", xml_declaration=True)
        return file

    def _node(self, x: float, y: float) -> str:
        lon, lat, _ = MGRS.to_lonlat(np.array([[x, y, 0.0]]))[0].tolist()
        places = {"lat": f"{lat:.11f}", "lon": f"{lon:.11f}"} if self.degrees else {"lat": "", "lon": ""}
        node = ElementTree.SubElement(self.root, "node", {"id": str(next(self.ids))} | places)
        self._tagged(node, {"local_x": f"{x:.4f}", "local_y": f"{y:.4f}"} if self.metres else {})
        return str(node.get("id"))

    def _tagged(self, element: ElementTree.Element, tags: dict[str, str]) -> str:
        for key, value in tags.items():
            ElementTree.SubElement(element, "tag", {"k": key, "v": value})
        return str(element.get("id"))


def crossing(**which: bool) -> tuple[Drawing, dict[str, str]]:
    """Two lanes of 3.5 m along x, a stop line, a sign beside the road, a crosswalk, a parking lot; their ids."""
    drawing = Drawing(**which)
    ids = {
        "west": drawing.lanelet([(100, 103.5), (120, 103.5)], [(120, 100), (100, 100)]),  # the right one is reversed
        "east": drawing.lanelet([(120, 103.5), (150, 103.5)], [(120, 100), (150, 100)]),
        "crosswalk": drawing.lanelet([(130, 95), (130, 108)], [(134, 95), (134, 108)], "crosswalk"),
        "stop": drawing.way([(128, 100), (128, 103.5)], type="stop_line"),
        "sign": drawing.way([(127.8, 97), (128.2, 97)], type="traffic_sign", subtype="stop"),
        "lot": drawing.way([(100, 110), (115, 110), (115, 120), (100, 120)], type="parking_lot", area="yes"),
    }
    return drawing, ids


def changed(file: Path, *boxes: tuple[float, float, float, float], degrees: bool = False) -> Path:
    """Boxes as `diff --out` writes them."""
    frame = "WGS 84 longitude, latitude" if degrees else "map metres, not the longitude and latitude of RFC 7946"
    features = []
    for number, box in enumerate(boxes, 1):
        corners = shapely.get_coordinates(shapely.box(*box))
        if degrees:
            corners = MGRS.to_lonlat(np.column_stack([corners, np.zeros(len(corners))]))[:, :2]
        geometry = {"type": "Polygon", "coordinates": [corners.tolist()]}
        about = {"id": f"c{number}", "properties": {"kind": "new"}}
        features.append({"type": "Feature", "geometry": geometry} | about)
    file.write_text(json.dumps({"type": "FeatureCollection", "frame": frame, "features": features}))
    return file


def near(folder: Path, box: tuple[float, float, float, float], within_m: float) -> set[str]:
    """Names of what is listed for one box in the crossing."""
    drawing, ids = crossing()
    changes = read_changes(changed(folder / "changes.geojson", box))
    parts = read_lanelets(drawing.save(folder / "map.osm"), changes.frame).parts
    names = {name: key for key, name in ids.items()}
    return {names[one.part.id] for one in affected_parts(parts, changes, within_m)}


@pytest.mark.parametrize(
    ("box", "within_m", "expected"),
    [
        ((105, 101, 106, 102), 0.0, {"west"}),
        ((105, 103.6, 106, 104), 0.0, set()),
        ((105, 103.6, 106, 104), 0.2, {"west"}),
        ((119, 101, 121, 102), 0.0, {"west", "east"}),
        ((131, 101, 132, 102), 0.0, {"east", "crosswalk"}),
        ((131, 101, 132, 102), 4.0, {"east", "crosswalk", "stop"}),
        ((127, 96.5, 129, 97.5), 0.0, {"sign"}),
        ((105, 114, 106, 115), 0.0, {"lot"}),
        ((300, 300, 310, 310), 5.0, set()),
    ],
)
def test_parts_within_the_distance_of_a_box_are_listed_and_no_others(
    tmp_path: Path, box: tuple[float, float, float, float], within_m: float, expected: set[str]
) -> None:
    assert near(tmp_path, box, within_m) == expected


@given(flips=st.tuples(st.booleans(), st.booleans()))
def test_a_lanelet_has_one_shape_whichever_way_its_bounds_are_stored(
    tmp_path_factory: pytest.TempPathFactory, flips: tuple[bool, bool]
) -> None:
    left: Line = [(0, 4), (20, 4), (40, 9)]
    right: Line = [(0, 0), (22, 0), (43, 6)]
    drawing = Drawing()
    drawing.lanelet(left[::-1] if flips[0] else left, right[::-1] if flips[1] else right)
    (part,) = read_lanelets(drawing.save(tmp_path_factory.mktemp("osm") / "map.osm"), MapFrame()).parts
    assert part.shape.equals(shapely.Polygon(left + right[::-1]))


def test_changes_in_degrees_meet_nodes_in_degrees_within_a_millimetre(tmp_path: Path) -> None:
    drawing, _ = crossing(metres=False)
    changes = read_changes(changed(tmp_path / "c.geojson", (127, 96, 129, 96.5), degrees=True))
    assert changes.frame.crs == "EPSG:32654"
    parts = read_lanelets(drawing.save(tmp_path / "map.osm"), changes.frame).parts
    (sign,) = affected_rows(affected_parts(parts, changes, 0.8), changes)
    assert (sign["kind"], sign["subtype"], sign["changes"]) == ("traffic_sign", "stop", ["c1"])
    assert sign["distance_m"] == pytest.approx(0.5, abs=1e-3)


def test_a_bound_of_several_ways_is_joined_in_any_order(tmp_path: Path) -> None:
    drawing = Drawing()
    pieces: list[Line] = [[(10, 4), (20, 4)], [(0, 4), (10, 4)]]
    members = [("left", drawing.way(piece)) for piece in pieces] + [("right", drawing.way([(0, 0), (20, 0)]))]
    drawing.relation(members, type="lanelet")
    (lanelet,) = read_lanelets(drawing.save(tmp_path / "map.osm"), MapFrame()).parts
    assert lanelet.shape.area == pytest.approx(80.0)


def test_the_marked_copy_holds_the_same_map_and_tags_of_the_newest_changes_alone(tmp_path: Path) -> None:
    drawing, ids = crossing()
    file = drawing.save(tmp_path / "map.osm")
    for box, name in (((105, 101, 106, 102), "west"), ((140, 101, 141, 102), "east")):
        changes = read_changes(changed(tmp_path / "c.geojson", box))
        lanelet_map = read_lanelets(file, changes.frame)
        before = [(part.id, part.shape.wkt) for part in lanelet_map.parts]
        file.write_text(marked_osm(lanelet_map.tree, affected_parts(lanelet_map.parts, changes, 0.5), changes))
        assert [(part.id, part.shape.wkt) for part in read_lanelets(file, changes.frame).parts] == before
        marked = [e for e in ElementTree.parse(file).getroot() if any(t.get("k") == TAG for t in e.iter("tag"))]
        assert [e.get("id") for e in marked] == [ids[name]]


def test_parts_without_a_shape_are_counted_and_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    drawing, _ = crossing()
    lost = drawing.relation([("left", drawing.way([(0, 0), (1, 0)]))], type="lanelet")
    with caplog.at_level(logging.WARNING):
        read_lanelets(drawing.save(tmp_path / "map.osm"), MapFrame())
    assert f"1 parts have no shape, first: lanelet {lost}" in caplog.text


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ("<osm><node id='1' lat='35' lon='139'/></osm>", "1 of 1 nodes, first 1, have no local_x"),
        ("<osm></osm>", "holds no lanelet, area or line"),
        ("<gpx/>", r"its first element is <gpx>"),
        ("<osm><node", "not a whole lanelet2 map"),
        ("<osm><node id='7'><tag k='local_x' v='a'/><tag k='local_y' v='1'/></node></osm>", "is no number"),
        (
            "<osm><node id='7'><tag k='local_x' v='nan'/><tag k='local_y' v='1'/></node></osm>",
            "of node 7 is not finite",
        ),
    ],
)
def test_a_file_that_is_no_lanelet2_map_is_refused_with_the_reason(tmp_path: Path, content: str, error: str) -> None:
    (tmp_path / "map.osm").write_text(content)
    with pytest.raises(MapvoteError, match=error):
        read_lanelets(tmp_path / "map.osm", MapFrame())


@pytest.mark.parametrize("content", ["[]", '{"features": [{}]}', "{", '{"features": [{"geometry": {"type": "Cube"}}]}'])
def test_a_file_that_is_no_geojson_of_changes_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "c.geojson").write_text(content)
    with pytest.raises(MapvoteError, match="no GeoJSON of changes"):
        read_changes(tmp_path / "c.geojson")


def test_affected_prints_the_list_and_writes_it_in_three_forms(tmp_path: Path) -> None:
    drawing, ids = crossing(degrees=False)
    drawing.save(tmp_path / "lanelet2_map.osm")
    (tmp_path / "map_projector_info.yaml").write_text("projector_type: Local\n")
    changed(tmp_path / "c.geojson", (131, 101, 132, 102))
    files = [tmp_path / name for name in ("near.geojson", "near.csv", "near.osm")]
    options = [word for pair in zip(("--out", "--csv", "--osm"), files, strict=True) for word in pair]
    said = typed("affected", tmp_path / "c.geojson", tmp_path / "lanelet2_map.osm", *options)
    assert "2 of 6 parts lie within 2 m of 1 changes: 2 lanelet" in said
    assert {f["id"] for f in json.loads(files[0].read_text())["features"]} == {ids["east"], ids["crosswalk"]}
    assert files[1].read_text().count("\n") == 3
    assert files[2].read_text().count(TAG) == 2
