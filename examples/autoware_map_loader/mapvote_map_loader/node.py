"""Serves the newest version of a mapvote server's map to a running Autoware, in place of its pointcloud_map_loader.

The answers are made by mapvote.live.map_loader, which knows no ROS; this node only passes messages on.
"""

from __future__ import annotations

import array
import threading
from pathlib import Path
from typing import Any

import rclpy
from autoware_map_msgs.msg import PointCloudMapCellMetaDataWithID, PointCloudMapCellWithID, PointCloudMapMetaData
from autoware_map_msgs.srv import (
    GetDifferentialPointCloudMap,
    GetPartialPointCloudMap,
    GetSelectedPointCloudMap,
)
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2, PointField
from tier4_external_api_msgs.msg import MapHash

from mapvote import MapClient, MapvoteError
from mapvote.cli.files import follow_once
from mapvote.live.map_loader import DIFFERENTIAL, PARTIAL, SELECTED, MapLoader

SERVICES = {
    "~/service/get_differential_pcd_map": (GetDifferentialPointCloudMap, DIFFERENTIAL),
    "~/service/get_partial_pcd_map": (GetPartialPointCloudMap, PARTIAL),
    "~/service/get_selected_pcd_map": (GetSelectedPointCloudMap, SELECTED),
}


class MapvoteMapLoader(Node):
    """The node. A thread of its own asks the server for newer versions."""

    def __init__(self) -> None:
        super().__init__("mapvote_map_loader")
        self.url, key_file, folder, projector, self.keep, self.period = (
            self.declare_parameter(name, default).value
            for name, default in (
                ("server_url", "http://127.0.0.1:8080"),
                ("key_file", ""),
                ("folder", "/var/lib/mapvote/map"),
                ("projector", ""),
                ("keep_versions", 3),
                ("period", 5.0),
            )
        )
        self.key = Path(key_file).read_text().strip() if key_file else None
        self.projector = projector or None
        self.loader = MapLoader(Path(folder))
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.hash = self.create_publisher(MapHash, "~/output/map_hash", latched)
        self.whole = self.create_publisher(PointCloud2, "~/output/pointcloud_map", latched)
        # map_height_fitter reads these parameters of Autoware's loader, and chooses by them how it asks.
        for name, value in (("enable_partial_load", True), ("enable_selected_load", True), ("enable_whole_load", True)):
            self.declare_parameter(name, value)
        self.table = self.create_publisher(PointCloudMapMetaData, "~/output/pointcloud_map_metadata", latched)
        self.offered = False
        self.refresh()
        # The folder is looked at in the executor's thread, so that the services begin to exist there.
        self.timer = self.create_timer(0.5, self.refresh)
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self.follow, daemon=True)
        self.thread.start()

    def answering(self, service: str) -> Any:
        """The callback of a service of this type."""

        def answer(request: Any, response: Any) -> Any:
            self.refresh()
            answered = self.loader.answer(service, request)
            response.header.frame_id = answered["header"].frame_id
            response.new_pointcloud_with_ids = [cell_message(cell) for cell in answered["new_pointcloud_with_ids"]]
            if "ids_to_remove" in answered:
                response.ids_to_remove = answered["ids_to_remove"]
            return response

        return answer

    def refresh(self) -> None:
        """Read the folder's table if it was replaced, and publish which map it is. The services exist from the first
        table on: a client that was answered before would drop its map."""
        try:
            if not self.loader.refresh():
                return
        except MapvoteError as error:
            self.get_logger().error(f"{error}; the tiles before are served")
            return
        if not self.offered:
            self.offered = True
            for name, (kind, service) in SERVICES.items():
                self.create_service(kind, name, self.answering(service))
        self.hash.publish(MapHash(pcd=self.loader.hash()))
        table = PointCloudMapMetaData()
        table.header.frame_id, table.header.stamp = "map", self.get_clock().now().to_msg()
        for cell in self.loader.cells.values():
            listed = PointCloudMapCellMetaDataWithID(cell_id=cell.id)
            set_square(listed.metadata, cell)
            table.metadata_list.append(listed)
        self.table.publish(table)
        cloud = self.loader.whole(0)  # None: the map is too large for one message
        if cloud is not None:
            whole = PointCloud2()
            copy_cloud(cloud, whole)
            self.whole.publish(whole)

    def follow(self) -> None:
        """Lay each newer version into the folder."""
        with MapClient(self.url, key=self.key, home=self.loader.folder / ".mapvote_cache") as client:
            while not self.ended.wait(self.period):
                try:
                    change = follow_once(client, self.loader.folder, self.projector, self.keep)
                except (MapvoteError, OSError) as error:
                    self.get_logger().warning(f"{error}; the map stays as it is")
                    continue
                if change is not None:
                    self.get_logger().info(f"version {change.version}: {change.written} tiles are new")


def cell_message(cell: Any) -> PointCloudMapCellWithID:
    """A tile as a message of ROS, from one of mapvote.live.map_loader."""
    out = PointCloudMapCellWithID(cell_id=cell.cell_id)
    set_square(out.metadata, cell.metadata)
    copy_cloud(cell.pointcloud, out.pointcloud)
    return out


def copy_cloud(cloud: Any, points: Any) -> None:
    """Copy a cloud of mapvote.live.messages into a PointCloud2 of ROS."""
    points.header.frame_id = cloud.header.frame_id
    points.height, points.width, points.is_dense = cloud.height, cloud.width, cloud.is_dense
    points.point_step, points.row_step = cloud.point_step, cloud.row_step
    points.fields = [
        PointField(name=field.name, offset=field.offset, datatype=field.datatype, count=field.count)
        for field in cloud.fields
    ]
    points.data = array.array("B", cloud.data.tobytes())


def set_square(out: Any, square: Any) -> None:
    """Copy the corners of a tile."""
    out.min_x, out.min_y, out.max_x, out.max_y = square.min_x, square.min_y, square.max_x, square.max_y


def main() -> None:
    rclpy.init()
    node = MapvoteMapLoader()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.ended.set()


if __name__ == "__main__":
    main()
