"""Clouds as ROS 2's point_cloud_transport compresses them: CompressedPointCloud2 by zstd and zlib.

Both compress the bytes of a PointCloud2 and lose nothing. draco and cloudini code each field by itself and round it; no
package on PyPI reads what their plug-ins write.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from typing import Any

from mapvote.codec.planes import zstd
from mapvote.core.types import MapvoteError
from mapvote.formats.drives.ros_types import COMPRESSED


def definition_of_compressed() -> str:
    """The definition of the message, which rosbags lacks."""
    cloud = "std_msgs/Header header, uint32 height, uint32 width, sensor_msgs/PointField[] fields, bool is_bigendian, "
    cloud += "uint32 point_step, uint32 row_step, uint8[] compressed_data, bool is_dense, string format"
    return cloud.replace(", ", "\n")


def _of_zstd(data: bytes, size: int) -> bytes:
    return zstd.ZstdDecompressor().decompress(data, max_length=size + 1)


def _of_zlib(data: bytes, size: int) -> bytes:
    either_header = 32 + zlib.MAX_WBITS  # the plug-in writes gzip's, older ones wrote zlib's own
    return zlib.decompressobj(either_header).decompress(data, size + 1)


_READ: Mapping[str, Callable[[bytes, int], bytes]] = {"zstd": _of_zstd, "zlib": _of_zlib}
"""Decoders by format. Each returns one byte more than the size at most: a message cannot fill the memory."""


def decompressed(source: str, message: Any) -> bytes:
    """The bytes of the points of a CompressedPointCloud2. MapvoteError if they are damaged, or in a format that is not
    read."""
    form = str(message.format).strip().lower()
    if form not in _READ:
        raise MapvoteError(f"{source}: its points are compressed by {form or 'an unnamed method'}: {republished(form)}")
    size = int(message.height) * max(int(message.row_step), int(message.width) * int(message.point_step))
    try:
        data = _READ[form](bytes(message.compressed_data), size)
    except (zlib.error, zstd.ZstdError, EOFError) as error:
        raise MapvoteError(
            f"{source}: its points do not decompress by {form} ({error}): the message is damaged"
        ) from error
    if len(data) != size:
        size_found = f"more than {size}" if len(data) > size else f"{len(data)}"
        raise MapvoteError(
            f"{source}: {size_found} bytes after {form}, but its header says {size}: the message is cut off"
        )
    return data


def republished(form: str) -> str:
    """The mend for clouds in a format that is not read."""
    named = form or "FORMAT"
    return (
        f"send zstd or zlib, or make PointCloud2 of them: ros2 run point_cloud_transport republish --ros-args "
        f"-p in_transport:={named} -p out_transport:=raw -r in/{named}:=TOPIC -r out:=/points"
    )


def unread_format(topic: str) -> str:
    """The format that the name of a CompressedPointCloud2's topic tells, /points/draco, if it is none that is read."""
    form = topic.rpartition("/")[2].lower()
    return form if form in ("draco", "cloudini") else ""


def one_of_each_cloud(topics: Mapping[str, str]) -> list[str]:
    """The names of ``topics``, which have their types, without those that another one makes needless.

    A driver sends one cloud as /points, /points/zstd, /points/zlib, /points/draco: the first that is there is taken.
    """
    best: dict[str, str] = {}
    for name in sorted(topics, key=lambda name: _rank(name, topics[name])):
        best.setdefault(name.rpartition("/")[0] if topics[name] == COMPRESSED else name, name)
    return [name for name in topics if name in best.values()]


def _rank(topic: str, kind: str) -> int:
    """0 for a cloud as it is, then the formats that are read, then the others."""
    last = topic.rpartition("/")[2].lower()
    if kind != COMPRESSED:
        return 0
    return 1 + list(_READ).index(last) if last in _READ else 1 + len(_READ)
