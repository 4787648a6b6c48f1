"""In place of Autoware's map loader: its answers in the cases of that loader's own tests, from files and over DDS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from live.loopback_dds import until
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.drives.point_fields import point_cloud_table
from mapvote.formats.drives.ros_types import CLOUD
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.maps.autoware import check_followed, laid_version, lay_version
from mapvote.formats.maps.cloud import Cloud
from mapvote.live.map_loader import (
    DIFFERENTIAL,
    HASH,
    HASH_TOPIC,
    LOADER_WAITS,
    NODE,
    PARTIAL,
    SELECTED,
    SERVICES,
    TABLE,
    TABLE_TOPIC,
    WHOLE_TOPIC,
    Cell,
    MapLoader,
)
from mapvote.live.messages import blank_message, from_cdr, to_cdr
from mapvote.live.parameters import NodeParameters


def points(*corners: tuple[float, float], z: float = 1.0) -> F64:
    """Two points in the 20 m square at each corner."""
    return np.array([(x + d, y + d, z) for x, y in corners for d in (3.0, 4.0)])


def lay(folder: Path, cloud: F64, version: int) -> None:
    lay_version(folder, Cloud(cloud, frame=MapFrame()), version)


@pytest.fixture
def loader(tmp_path: Path) -> MapLoader:
    """Three tiles: at 0, 0; at 20, 0; and at 200, 200."""
    lay(tmp_path / "map", points((0, 0), (20, 0), (200, 200)), 1)
    made = MapLoader(tmp_path / "map")
    assert made.refresh()
    return made


def asked(loader: MapLoader, *cached: str, x: float = 10.0, y: float = 10.0) -> tuple[list[Any], list[str]]:
    """(tiles, ids to remove) that a client at (x, y) with a radius of 15 m gets."""
    area = SimpleNamespace(center_x=x, center_y=y, radius=15.0)
    answer = loader.answer(DIFFERENTIAL, SimpleNamespace(area=area, cached_ids=list(cached)))
    return answer["new_pointcloud_with_ids"], answer["ids_to_remove"]


def corner(cells: list[Any]) -> list[tuple[float, float]]:
    squares = [getattr(cell, "metadata", cell) for cell in cells]
    return [(square.min_x, square.min_y) for square in squares]


def test_a_client_gets_the_tiles_in_its_area_that_it_lacks_and_drops_those_out_of_it(loader: MapLoader) -> None:
    new, removed = asked(loader)
    assert (corner(new), removed) == ([(0, 0), (20, 0)], [])
    cloud = new[0].pointcloud
    assert (cloud.width, cloud.point_step, cloud.header.frame_id) == (2, 12, "map")
    assert np.frombuffer(cloud.data, "<f4").reshape(-1, 3).tolist() == [[3, 3, 1], [4, 4, 1]]
    kept, removed = asked(loader, new[0].cell_id)
    assert (corner(kept), removed) == ([(20, 0)], [])
    held = [asked(loader, x=210.0, y=210.0)[0][0].cell_id, "/path/of/another/loader.pcd"]
    new, removed = asked(loader, *held)
    assert (corner(new), removed) == ([(0, 0), (20, 0)], held), "in their order, and unknown ones too"


def test_an_area_gets_every_tile_that_it_touches_at_the_border_too_and_none_beside(loader: MapLoader) -> None:
    assert corner(loader.partial(100.0, 100.0, 20.0)) == []
    assert corner(loader.partial(42.0, 10.0, 2.0)) == [(20, 0)]
    assert corner(loader.partial(42.0, 10.0, 1.9)) == []
    box = Cell("box", -1.0, -1.0, 1.0, 1.0)
    assert not box.is_near(5.0, 0.0, 3.9)
    assert box.is_near(0.0, 0.0, 5.0)
    assert box.is_near(5.0, 5.0, 4.5)  # the widened square's corner, which the cylinder does not reach


def test_selected_tiles_come_in_the_order_asked_for_as_often_and_without_unknown_ones(
    loader: MapLoader, caplog: pytest.LogCaptureFixture
) -> None:
    a, b, _ = loader.cells
    found = loader.selected(["missing_0.pcd", b, "missing_1.pcd", a, b])
    assert [cell.id for cell in found] == [b, a, b]
    assert [record.message[:12] for record in caplog.records] == ["no tile miss"] * 2


def test_a_tile_that_changed_has_another_id_and_the_old_one_is_dropped(loader: MapLoader, tmp_path: Path) -> None:
    held = [cell.cell_id for cell in asked(loader)[0]]
    before = loader.hash()
    assert not loader.refresh()
    lay(tmp_path / "map", np.concatenate([points((0, 0), (200, 200)), points((20, 0), z=2.0)]), 2)
    assert loader.refresh()
    new, removed = asked(loader, *held)
    assert (corner(new), removed) == ([(20, 0)], [held[1]])
    assert loader.hash() != before
    assert np.frombuffer(new[0].pointcloud.data, "<f4")[2::3].tolist() == [2.0, 2.0]


def test_a_broken_an_empty_and_a_foreign_table_are_said_and_the_tiles_before_stay(
    loader: MapLoader, tmp_path: Path
) -> None:
    table, tiles = tmp_path / "map/pointcloud_map_metadata.yaml", list(loader.cells)
    for broken in ("x_resolution: much\n", "", "x_resolution: 20.0\ny_resolution: 20.0\n", "{", "a: [1"):
        table.write_text(broken)
        with pytest.raises(MapvoteError, match=r"not Autoware's metadata|cannot be read"):
            loader.refresh()
        assert not loader.refresh(), "it is said once"
        assert list(loader.cells) == tiles
    lay(tmp_path / "theirs", points((0, 0)), 1)
    (tmp_path / "theirs/.mapvote_versions.json").unlink()
    with pytest.raises(MapvoteError, match="mapvote did not make; choose another folder"):
        MapLoader(tmp_path / "theirs").refresh()


HELD = ["0_0_ffffffff.pcd", "20_0_ffffffff.pcd", "/path/of/another/loader.pcd"]


def test_no_answer_leaves_a_client_without_a_map(loader: MapLoader, tmp_path: Path) -> None:
    new, removed = asked(MapLoader(tmp_path / "empty"), *HELD)
    assert (new, removed) == ([], []), "no version is known"
    assert asked(loader, *HELD, x=-5000.0) == ([], []), "this map has nothing there"
    (tmp_path / "map/pointcloud_map.pcd" / next(iter(loader.cells))).unlink()
    new, removed = asked(loader, *HELD)
    assert (corner(new), removed) == ([(20, 0)], []), "a tile that replaces one of theirs cannot be read"
    for tile in loader.cells:
        (tmp_path / "map/pointcloud_map.pcd" / tile).write_bytes(b"VERSION 0.7")
    assert asked(loader, *HELD) == ([], [])


@given(held=st.sets(st.integers(0, 40)), x=st.floats(-100, 300), version=st.integers(1, 2))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
def test_a_client_that_holds_tiles_and_obeys_holds_tiles_of_the_area_or_all_that_it_had(
    loader: MapLoader, tmp_path: Path, held: set[int], x: float, version: int
) -> None:
    """Ids of this version and of others, at any place."""
    lay(tmp_path / "map", points((0, 0), (20, 0), (200, 200), z=float(version)), version)
    loader.refresh()
    ids = {f"{20 * k}_0_abcdef01.pcd" for k in held} | {name for k, name in enumerate(loader.cells) if k in held}
    new, removed = asked(loader, *sorted(ids), x=x)
    after = (ids - set(removed)) | {cell.cell_id for cell in new}
    wanted = {cell.id for cell in loader.partial(x, 10.0, 15.0)}
    assert after == (wanted or ids)


def test_a_version_that_was_half_laid_is_laid_again_and_another_map_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "map"
    cloud = Cloud(points((0, 0), (20, 0)), frame=MapFrame())
    assert laid_version(folder) is None
    lay_version(folder, cloud, 1, map_id="town")
    table = (folder / "pointcloud_map_metadata.yaml").read_bytes()
    lay_version(folder, Cloud(points((0, 0), z=3.0), frame=MapFrame()), 2, map_id="town")
    assert laid_version(folder) == 2
    (folder / "pointcloud_map_metadata.yaml").write_bytes(table)  # killed before the table was replaced
    assert laid_version(folder) is None
    lay_version(folder, cloud, 3, map_id="town")
    next((folder / "pointcloud_map.pcd").glob("20_0_*.pcd")).unlink()
    assert laid_version(folder) is None
    lay_version(folder, cloud, 3, map_id="town")
    assert laid_version(folder) == 3
    with pytest.raises(MapvoteError, match="holds map town, but the server has map village"):
        check_followed(folder, "village")


def test_a_height_fitter_of_other_message_types_learns_that_it_may_ask_for_parts_and_gets_the_whole_map(
    loader: MapLoader, tmp_path: Path, domain: int
) -> None:
    pytest.importorskip("cyclonedds")
    from live.foreign_client import HeightFitter
    from mapvote.live.dds import Network
    from mapvote.live.map_loader import LoaderService

    service = LoaderService(Network(domain), MapLoader(tmp_path / "map"))
    fitter = HeightFitter(domain)
    assert service.refresh()

    def told() -> list[bool]:
        service.serve(0.05)
        return fitter.partial_load()

    assert until(told) == [True]
    assert until(fitter.whole_maps) == [6]
    service.close()


def test_a_map_that_is_too_large_is_not_published_whole_and_the_parameter_says_so(loader: MapLoader) -> None:
    assert loader.parameters()["enable_whole_load"]
    small = replace(LOADER_WAITS, most_whole_bytes=100)
    loader = MapLoader(loader.folder, small)
    loader.refresh()
    assert not loader.parameters()["enable_whole_load"]
    assert loader.whole(0) is None


def test_the_parameters_of_the_loader_are_told_and_never_set(loader: MapLoader) -> None:
    node = NodeParameters(NODE, loader.parameters)

    def answer(kind: str, **members: Any) -> Any:
        return node.answer(f"rcl_interfaces/srv/{kind}", SimpleNamespace(**members))

    assert set(node.services().values()) >= {f"{NODE}/{name}_parameters" for name in ("get", "set", "list", "describe")}
    assert f"{NODE}/get_parameter_types" in node.services().values()
    listed = answer("ListParameters", prefixes=["enable"], depth=0)["result"].names
    assert sorted(listed) == [f"enable_{which}_load" for which in ("downsampled_whole", "partial", "selected", "whole")]
    assert answer("GetParameterTypes", names=["pcd_metadata_path", "use_sim_time"])["types"].tolist() == [4, 1]
    assert answer("DescribeParameters", names=["use_sim_time"])["descriptors"][0].read_only
    (value,) = answer("GetParameters", names=["pcd_paths_or_directory"])["values"]
    assert (value.type, value.string_array_value) == (9, [str(loader.folder / "pointcloud_map.pcd")])
    assert [r.successful for r in answer("SetParameters", parameters=[1, 2])["results"]] == [False, False]
    assert not answer("SetParametersAtomically", parameters=[1])["result"].successful


def test_a_request_that_cannot_be_read_is_answered_by_its_number_with_no_tile(loader: MapLoader, domain: int) -> None:
    pytest.importorskip("cyclonedds")
    from mapvote.live.dds import Network
    from mapvote.live.map_loader import LoaderService

    service = LoaderService(Network(domain), loader)
    whole = to_cdr(f"{PARTIAL}_Request", blank_message(f"{PARTIAL}_Request", guid=77, seq=5))
    for cut, numbers in ((4 + 16, (77, 5)), (4 + 20, (77, 5)), (4 + 8, (77, 0)), (2, (0, 0))):
        reply = from_cdr(f"{PARTIAL}_Response", service._reply(PARTIAL, memoryview(whole[:cut]), loader.answer))
        assert ((reply.guid, reply.seq), len(reply.new_pointcloud_with_ids)) == (numbers, 0)


def test_a_client_of_rmw_cyclonedds_gets_its_own_answers_over_dds(
    loader: MapLoader, tmp_path: Path, domain: int
) -> None:
    """The client is ours: it writes the header as rmw_cyclonedds does, and takes only replies that carry its number."""
    pytest.importorskip("cyclonedds")
    from mapvote.live.dds import Network
    from mapvote.live.map_loader import LoaderService

    loader = MapLoader(tmp_path / "map")
    service, network = LoaderService(Network(domain), loader), Network(domain)
    assert service.refresh()

    def client(kind: str, guid: int, name: str = "") -> Callable[..., Any]:
        name = name or SERVICES[kind]
        requests = network.publish(f"rq{name}Request", f"{kind}_Request", depth=10)
        replies = network.subscribe(f"rr{name}Reply", f"{kind}_Response", reliable=True, depth=10)
        until(lambda: requests.readers and replies.writers, "the service was not found")

        def ask(seq: int, **members: Any) -> Any:
            request = blank_message(f"{kind}_Request", guid=guid, seq=seq, **members)
            requests.send(to_cdr(f"{kind}_Request", request))

            def own() -> Any:
                service.serve(0.05)
                received = [from_cdr(f"{kind}_Response", data) for _, data in replies.take()]
                return [reply for reply in received if (reply.guid, reply.seq) == (guid, seq)]

            return until(own)[0]

        return ask

    area = blank_message("autoware_map_msgs/msg/AreaInfo", center_x=10.0, center_y=10.0, radius=15.0)
    ask = client(DIFFERENTIAL, 0xFFFF_0000_1234_5678)
    reply = ask(1, area=area, cached_ids=[])
    held = [cell.cell_id for cell in reply.new_pointcloud_with_ids]
    assert (len(held), list(reply.ids_to_remove)) == (2, [])
    lay(tmp_path / "map", points((0, 0), (20, 0), z=5.0), 2)
    service.refresh()
    reply = ask(2, area=area, cached_ids=held)
    assert list(reply.ids_to_remove) == held
    assert {float(np.frombuffer(c.pointcloud.data, "<f4")[2]) for c in reply.new_pointcloud_with_ids} == {5.0}
    partial = client(PARTIAL, 7)(1, area=area)
    assert [c.cell_id for c in partial.new_pointcloud_with_ids] == list(loader.cells)
    one = next(iter(loader.cells))
    selected = client(SELECTED, 8)(9, cell_ids=[one])
    assert [c.cell_id for c in selected.new_pointcloud_with_ids] == [one]
    get = client("rcl_interfaces/srv/GetParameters", 3, f"{NODE}/get_parameters")
    asked_for = get(1, names=["enable_partial_load", "enable_whole_load"]).values
    assert [(value.type, value.bool_value) for value in asked_for] == [(1, True), (1, True)]
    assert list(get(2, names=["enable_partial_load", "unknown"]).values) == [], "as rclcpp has it"
    told = {}
    for topic, kind in ((HASH_TOPIC, HASH), (TABLE_TOPIC, TABLE), (WHOLE_TOPIC, CLOUD)):
        late = network.subscribe(topic, kind, reliable=True, transient_local=True)
        told[kind] = from_cdr(kind, until(late.take)[0][1])
    assert len(told[HASH].pcd) == 64
    whole = point_cloud_table("/map/pointcloud_map", told[CLOUD])
    assert sorted(zip(whole["x"].tolist(), whole["z"].tolist(), strict=True)) == [(3, 5), (4, 5), (23, 5), (24, 5)]
    assert told[TABLE].header.frame_id == "map"
    listed = [
        (c.metadata.min_x, c.metadata.min_y, c.metadata.max_x, c.metadata.max_y) for c in told[TABLE].metadata_list
    ]
    assert sorted(listed) == [(0, 0, 20, 20), (20, 0, 40, 20)], "of the newest version"
