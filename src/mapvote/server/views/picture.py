"""A place before and after, as one small picture: what a list, a mail or a report can show without a viewer."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from mapvote.core.types import F64, I64, U8
from mapvote.server.views.cutout import Box, Cutout
from mapvote.server.views.point_lod import unpack_cloud

WIDTH, HEIGHT, GAP = 300, 260, 8
"""Pixels of one side, and between the two."""
_MARGIN = 10
_ELEVATION = math.radians(32)
_NEAR, _FAR = np.array([88, 96, 106]), np.array([205, 210, 216])
_BLUE, _RED = np.array([0x2F, 0x62, 0xC4]), np.array([0xC2, 0x3B, 0x2E])
_DOT = ((0, 0), (0, 1))
_CROSS = ((0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
_DIAMOND = ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))
"""Shapes as well as colours: what went are crosses, what came diamonds."""


@dataclass(frozen=True, slots=True)
class _Eye:
    """A parallel projection: turned about z, then tilted; and where its middle lies on the picture."""

    turn: float
    middle: F64
    """(3,) metres."""
    pixels_per_m: float

    def look(self, points: F64) -> tuple[I64, I64, F64]:
        """(columns, rows, depth in metres, larger is farther) of points (n, 3)."""
        right, up, away = self.axes(points)
        cols = np.rint(0.5 * WIDTH + right * self.pixels_per_m).astype(np.int64)
        rows = np.rint(0.5 * HEIGHT - up * self.pixels_per_m).astype(np.int64)
        return cols, rows, away

    def axes(self, points: F64) -> tuple[F64, F64, F64]:
        x, y, z = (points - self.middle).T
        right = x * math.cos(self.turn) + y * math.sin(self.turn)
        ahead = y * math.cos(self.turn) - x * math.sin(self.turn)
        up = z * math.cos(_ELEVATION) + ahead * math.sin(_ELEVATION)
        away = ahead * math.cos(_ELEVATION) - z * math.sin(_ELEVATION)
        return right, up, away


def before_and_after(cutout: Cutout) -> bytes:
    """PNG of 608 x 260 pixels: left what stood, with blue crosses on what went; right what stands, with red diamonds
    on what came. Seen from above the longer side of the change, everything that the cutout holds in view."""
    kept, removed, added = (unpack_cloud(cutout.clouds[kind]) for kind in ("kept", "removed", "added"))
    everything = np.concatenate([kept, removed, added])
    eye = _eye(everything, cutout.box)
    sides = [_draw(eye, kept, removed, _CROSS, _BLUE), _draw(eye, kept, added, _DIAMOND, _RED)]
    gap = np.full((HEIGHT, GAP, 3), 255, dtype=np.uint8)
    out = io.BytesIO()
    Image.fromarray(np.concatenate([sides[0], gap, sides[1]], axis=1)).save(out, "PNG", optimize=True)
    return out.getvalue()


def _eye(points: F64, box: Box) -> _Eye:
    turn = 0.35 if box[2] - box[0] >= box[3] - box[1] else 0.35 - 0.5 * math.pi
    if not len(points):
        return _Eye(turn, np.zeros(3), 1.0)
    right, up, _ = _Eye(turn, np.zeros(3), 1.0).axes(points)
    spans = [np.quantile(axis, (0.002, 0.998)) for axis in (right, up)]
    wide, high = (max(float(span[1] - span[0]), 1.0) for span in spans)
    scale = min((WIDTH - 2 * _MARGIN) / wide, (HEIGHT - 2 * _MARGIN) / high)
    across, above = (0.5 * float(span.sum()) for span in spans)
    # The point in the plane z = 0 that the middle of the picture shows.
    ahead = above / math.sin(_ELEVATION)
    middle = np.array(
        [
            across * math.cos(turn) - ahead * math.sin(turn),
            across * math.sin(turn) + ahead * math.cos(turn),
            0.0,
        ]
    )
    return _Eye(turn, middle, scale)


def _draw(eye: _Eye, kept: F64, changed: F64, shape: Sequence[tuple[int, int]], colour: I64) -> U8:
    """(HEIGHT, WIDTH, 3) of one side: points from far to near, grey the paler the farther; changes over them."""
    image = np.full((HEIGHT, WIDTH, 3), 255, dtype=np.uint8)
    if len(kept):
        away = eye.axes(kept)[2]
        order = np.argsort(-away, kind="stable")
        low, high = np.quantile(away, (0.02, 0.98))
        share = np.clip((away[order] - low) / max(high - low, 1e-6), 0, 1)[:, None]
        _splat(image, eye, kept[order], _DOT, (_NEAR * (1 - share) + _FAR * share).astype(np.uint8))
    if len(changed):
        order = np.argsort(-eye.axes(changed)[2], kind="stable")
        _splat(image, eye, changed[order], shape, np.broadcast_to(colour.astype(np.uint8), (len(changed), 3)))
    return image


def _splat(image: U8, eye: _Eye, points: F64, shape: Sequence[tuple[int, int]], colours: U8) -> None:
    cols, rows, _ = eye.look(points)
    for down, along in shape:
        r, c = rows + down, cols + along
        seen = (r >= 0) & (r < HEIGHT) & (c >= 0) & (c < WIDTH)
        image[r[seen], c[seen]] = colours[seen]
