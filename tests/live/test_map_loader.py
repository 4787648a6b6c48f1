"""In place of Autoware's map loader: its answers in the cases of that loader's own tests, from files and over DDS."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from live.loopback_dds import LOOPBACK, domain_of
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.maps.autoware import lay_version
from mapvote.formats.maps.cloud import Cloud
from mapvote.live.cdr import blank_message, from_cdr, to_cdr
from mapvote.live.map_loader import DIFFERENTIAL, HASH, HASH_TOPIC, PARTIAL, SELECTED, Area, Cell, MapLoader


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


def corner(cells: list[Cell]) -> list[tuple[float, float]]:
    return [(cell.min_x, cell.min_y) for cell in cells]


NEAR = Area(10.0, 10.0, 15.0)


def test_an_empty_cache_gets_all_tiles_in_the_area_and_drops_none(loader: MapLoader) -> None:
    new, removed = loader.differential(NEAR, [])
    assert corner(new) == [(0, 0), (20, 0)]
    assert removed == []


def test_what_is_cached_in_the_area_is_kept_and_not_sent_again(loader: MapLoader) -> None:
    first = loader.differential(NEAR, [])[0][0].id
    new, removed = loader.differential(NEAR, [first])
    assert corner(new) == [(20, 0)]
    assert removed == []


def test_cached_ids_out_of_the_area_and_unknown_ones_are_dropped_in_their_order(loader: MapLoader) -> None:
    far = loader.differential(Area(210.0, 210.0, 1.0), [])[0][0].id
    new, removed = loader.differential(NEAR, [far, "/path/of/another/loader.pcd"])
    assert corner(new) == [(0, 0), (20, 0)]
    assert removed == [far, "/path/of/another/loader.pcd"]


def test_an_area_gets_every_tile_that_it_touches_at_the_border_too_and_none_beside(loader: MapLoader) -> None:
    assert corner(loader.partial(Area(100.0, 100.0, 20.0))) == []
    assert corner(loader.partial(Area(42.0, 10.0, 2.0))) == [(20, 0)]
    assert corner(loader.partial(Area(42.0, 10.0, 1.9))) == []
    box = Cell("box", -1.0, -1.0, 1.0, 1.0)
    assert not box.is_near(Area(5.0, 0.0, 3.9))
    assert box.is_near(Area(0.0, 0.0, 5.0))
    assert box.is_near(Area(5.0, 5.0, 4.5))  # the widened square's corner, which the cylinder does not reach


def test_selected_tiles_come_in_the_order_asked_for_as_often_and_without_unknown_ones(
    loader: MapLoader, caplog: pytest.LogCaptureFixture
) -> None:
    a, b, _ = loader.cells
    found = loader.selected(["missing_0.pcd", b, "missing_1.pcd", a, b])
    assert [cell.id for cell in found] == [b, a, b]
    assert [record.message[:12] for record in caplog.records] == ["no tile miss"] * 2
    assert loader.selected([]) == []


def test_the_table_lists_every_square_in_the_map_frame(loader: MapLoader) -> None:
    table = loader.table(5)
    assert table.header.frame_id == "map"
    listed = [(c.metadata.min_x, c.metadata.min_y, c.metadata.max_x, c.metadata.max_y) for c in table.metadata_list]
    assert sorted(listed) == [(0, 0, 20, 20), (20, 0, 40, 20), (200, 200, 220, 220)]


def test_a_tile_that_changed_has_another_id_and_the_old_one_is_dropped(loader: MapLoader, tmp_path: Path) -> None:
    held = [cell.id for cell in loader.differential(NEAR, [])[0]]
    before = loader.hash()
    assert not loader.refresh()
    lay(tmp_path / "map", np.concatenate([points((0, 0), (200, 200)), points((20, 0), z=2.0)]), 2)
    assert loader.refresh()
    new, removed = loader.differential(NEAR, held)
    assert corner(new) == [(20, 0)]
    assert removed == [held[1]]
    assert loader.hash() != before
    assert loader.points(new[0]).points[:, 2].tolist() == [2.0, 2.0]


def test_a_folder_that_is_still_empty_answers_with_nothing_and_a_broken_table_is_said(tmp_path: Path) -> None:
    loader = MapLoader(tmp_path)
    assert not loader.refresh()
    assert (loader.differential(NEAR, ["a"]), loader.hash()) == (([], ["a"]), "")
    (tmp_path / "pointcloud_map_metadata.yaml").write_text("x_resolution: much\n")
    with pytest.raises(MapvoteError, match="not Autoware's metadata"):
        loader.refresh()


def test_any_object_with_a_requests_members_is_answered(loader: MapLoader) -> None:
    area = SimpleNamespace(center_x=10.0, center_y=10.0, radius=15.0)
    answer = loader.answer(DIFFERENTIAL, SimpleNamespace(area=area, cached_ids=["old"]))
    assert sorted(answer) == ["header", "ids_to_remove", "new_pointcloud_with_ids"]
    (first, _) = answer["new_pointcloud_with_ids"]
    assert (first.pointcloud.width, first.pointcloud.point_step, first.pointcloud.header.frame_id) == (2, 12, "map")
    assert np.frombuffer(first.pointcloud.data, "<f4").reshape(-1, 3).tolist() == [[3, 3, 1], [4, 4, 1]]


def test_a_client_of_rmw_cyclonedds_gets_its_own_answers_over_dds(
    loader: MapLoader, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The client is ours: it writes the header as rmw_cyclonedds does, and takes only replies that carry its number."""
    pytest.importorskip("cyclonedds")
    from mapvote.live.dds import Network
    from mapvote.live.loader_service import LoaderService

    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    domain = domain_of("loader")
    service, network = LoaderService(Network(domain), loader), Network(domain)
    service.show()

    def client(kind: str, name: str, guid: int) -> Callable[..., Any]:
        requests = network.publish(f"rq{name}Request", f"{kind}_Request", depth=10)
        replies = network.subscribe(f"rr{name}Reply", f"{kind}_Response", reliable=True, depth=10)
        end = time.monotonic() + 60.0
        while not (requests.readers and replies.writers):
            assert time.monotonic() < end, "the service was not found"
            time.sleep(0.02)

        def ask(seq: int, **members: Any) -> Any:
            request = blank_message(f"{kind}_Request", guid=guid, seq=seq, **members)
            requests.send(to_cdr(f"{kind}_Request", request))
            end = time.monotonic() + 60.0
            while time.monotonic() < end:
                service.serve(0.05)
                for data in replies.take():
                    reply = from_cdr(f"{kind}_Response", data)
                    if (reply.guid, reply.seq) == (guid, seq):
                        return reply
            raise AssertionError("no answer came in 10 s")

        return ask

    area = blank_message("autoware_map_msgs/msg/AreaInfo", center_x=10.0, center_y=10.0, radius=15.0)
    ask = client(DIFFERENTIAL, "/map/get_differential_pointcloud_map", 0xFFFF_0000_1234_5678)
    reply = ask(1, area=area, cached_ids=[])
    held = [cell.cell_id for cell in reply.new_pointcloud_with_ids]
    assert (len(held), list(reply.ids_to_remove)) == (2, [])
    lay(tmp_path / "map", points((0, 0), (20, 0), z=5.0), 2)
    loader.refresh()
    reply = ask(2, area=area, cached_ids=held)
    assert list(reply.ids_to_remove) == held
    assert {float(np.frombuffer(c.pointcloud.data, "<f4")[2]) for c in reply.new_pointcloud_with_ids} == {5.0}
    partial = client(PARTIAL, "/map/get_partial_pointcloud_map", 7)(1, area=area)
    assert [c.cell_id for c in partial.new_pointcloud_with_ids] == list(loader.cells)
    one = next(iter(loader.cells))
    selected = client(SELECTED, "/map/get_selected_pointcloud_map", 8)(9, cell_ids=[one])
    assert [c.cell_id for c in selected.new_pointcloud_with_ids] == [one]
    late = network.subscribe(HASH_TOPIC, HASH, reliable=True, transient_local=True)
    end = time.monotonic() + 60.0
    while not (told := late.take()):
        assert time.monotonic() < end, "no hash came"
        time.sleep(0.02)
    assert len(from_cdr(HASH, told[0]).pcd) == 64
