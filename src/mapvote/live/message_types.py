"""Message types that rosbags lacks: those of Autoware's map, of parameters, of compressed clouds and of Livox's."""

from __future__ import annotations

from mapvote.formats.drives.compressed_cloud import definition_of_compressed
from mapvote.formats.drives.ros_types import COMPRESSED, LIVOX


def lacking_types() -> dict[str, str]:
    """Definition of each type by its name. Requests and responses begin with the client's number and the request's."""
    numbered = "uint64 guid, int64 seq"
    types = {
        COMPRESSED: definition_of_compressed(),
        "tier4_external_api_msgs/msg/MapHash": "string lanelet, string pcd",
    }
    for cloud in LIVOX:
        package = cloud.partition("/")[0]
        point = "uint32 offset_time, float32 x, float32 y, float32 z, uint8 reflectivity, uint8 tag, uint8 line"
        types[f"{package}/msg/CustomPoint"] = point
        head = "std_msgs/Header header, uint64 timebase, uint32 point_num, uint8 lidar_id, uint8[3] rsvd"
        types[cloud] = f"{head}, {package}/CustomPoint[] points"
    # Services of the map loader, and their parts.
    maps = "autoware_map_msgs"
    area = f"{maps}/AreaInfo area"
    square = f"{maps}/PointCloudMapCellMetaData metadata"
    tiles = f"Header header, {maps}/PointCloudMapCellWithID[] new_pointcloud_with_ids"
    types |= {
        f"{maps}/msg/AreaInfo": "float32 center_x, float32 center_y, float32 radius",
        f"{maps}/msg/PointCloudMapCellMetaData": "float32 min_x, float32 min_y, float32 max_x, float32 max_y",
        f"{maps}/msg/PointCloudMapCellMetaDataWithID": f"string cell_id, {square}",
        f"{maps}/msg/PointCloudMapCellWithID": f"string cell_id, sensor_msgs/PointCloud2 pointcloud, {square}",
        f"{maps}/msg/PointCloudMapMetaData": f"Header header, {maps}/PointCloudMapCellMetaDataWithID[] metadata_list",
    }
    for service, (request, response) in {
        "Differential": (f"{area}, string[] cached_ids", f"{tiles}, string[] ids_to_remove"),
        "Partial": (area, tiles),
        "Selected": ("string[] cell_ids", tiles),
    }.items():
        types[f"{maps}/srv/Get{service}PointCloudMap_Request"] = f"{numbered}, {request}"
        types[f"{maps}/srv/Get{service}PointCloudMap_Response"] = f"{numbered}, {response}"
    # Services of the parameters of a node.
    given = "rcl_interfaces"
    for service, (request, response) in {
        "GetParameters": ("string[] names", f"{given}/ParameterValue[] values"),
        "GetParameterTypes": ("string[] names", "uint8[] types"),
        "DescribeParameters": ("string[] names", f"{given}/ParameterDescriptor[] descriptors"),
        "ListParameters": ("string[] prefixes, uint64 depth", f"{given}/ListParametersResult result"),
        "SetParameters": (f"{given}/Parameter[] parameters", f"{given}/SetParametersResult[] results"),
        "SetParametersAtomically": (f"{given}/Parameter[] parameters", f"{given}/SetParametersResult result"),
    }.items():
        types[f"{given}/srv/{service}_Request"] = f"{numbered}, {request}"
        types[f"{given}/srv/{service}_Response"] = f"{numbered}, {response}"
    return {name: text.replace(", ", "\n") for name, text in types.items()}
