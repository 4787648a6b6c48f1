"""A map from above as a small PNG, for notebooks: the higher above the ground, the warmer the colour."""

from __future__ import annotations

import base64
import html
import struct
import zlib
from collections.abc import Collection

import numpy as np

from mapvote.core.tile import Tile
from mapvote.core.types import F32, U8

SIDE = 480
"""Pixels of the longer side at most."""
_PIXEL_M = 0.3
_TOP_M = 12.0
_COLOURS = np.array([[205, 205, 205], [68, 90, 170], [32, 144, 140], [253, 200, 50], [215, 60, 40]], dtype=np.float64)
"""From the ground to ``_TOP_M`` above it."""


def html_picture(title: str, tiles: Collection[Tile]) -> str:
    """``title`` over the picture of all ``tiles``, as HTML that needs nothing from elsewhere."""
    line = f"<div><code>{html.escape(title)}</code></div>"
    if not any(len(tile.points) for tile in tiles):
        return line
    data = base64.b64encode(png(paint(heights(tiles)))).decode()
    return f'{line}<img alt="the map from above, north up" src="data:image/png;base64,{data}">'


def heights(tiles: Collection[Tile]) -> F32:
    """(rows, cols) the highest point above the ground in each pixel, metres, north up; NaN where no point is."""
    filled = [tile for tile in tiles if len(tile.points)]
    low = np.min([tile.points_map[:, :2].min(axis=0) for tile in filled], axis=0)
    high = np.max([tile.points_map[:, :2].max(axis=0) for tile in filled], axis=0)
    pixel_m = max(_PIXEL_M, float((high - low).max()) / (SIDE - 1))
    cols, rows = ((high - low) // pixel_m).astype(int) + 1
    flat = np.full(rows * cols, -np.inf, dtype=np.float32)
    for tile in filled:
        at = ((tile.points_map[:, :2] - low) // pixel_m).astype(np.int64)
        ground = tile.ground_z.reshape(-1)[tile.cells]
        above = tile.points[:, 2] - np.where(np.isfinite(ground), ground, tile.points[:, 2].min())
        np.maximum.at(flat, at[:, 1] * cols + at[:, 0], above)
    picture = np.where(np.isfinite(flat), flat, np.float32(np.nan)).reshape(rows, cols)
    return picture[::-1]


def paint(heights_m: F32) -> U8:
    """(rows, cols, 3) RGB of heights above the ground; white where nothing is known."""
    stops = np.linspace(0.0, _TOP_M, len(_COLOURS))
    known = np.isfinite(heights_m)
    level = np.where(known, heights_m, 0.0)
    colour = np.stack([np.interp(level, stops, _COLOURS[:, channel]) for channel in range(3)], axis=-1)
    return np.where(known[..., None], colour, 255.0).astype(np.uint8)


def png(rgb: U8) -> bytes:
    """An image (rows, cols, 3) as a PNG file (W3C, Portable Network Graphics, 2nd edition: 8 bits, no filter)."""
    rows, cols, _ = rgb.shape
    lines = np.concatenate([np.zeros((rows, 1), dtype=np.uint8), rgb.reshape(rows, 3 * cols)], axis=1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", cols, rows, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(lines.tobytes()))
        + chunk(b"IEND", b"")
    )
