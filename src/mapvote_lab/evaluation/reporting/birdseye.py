"""Point clouds in bird's-eye view (the manner of the paper's Figures 5, 7 and 8).

Points are drawn from far to near into an image with a depth buffer; edges of depth are darkened (eye-dome lighting,
Boucheny 2009), which makes a cloud without normals readable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mapvote import plots as style
from mapvote.core.types import F32, F64, I64, U8

WIDTH, HEIGHT = 1400, 800


@dataclass(frozen=True, slots=True)
class Camera:
    """Looks at ``target`` (x, y, z), map metres, from ``distance_m`` away, from bearing ``azimuth_deg`` (0 = from +x,
    90 = from +y), ``elevation_deg`` above the horizon."""

    target: tuple[float, float, float]
    distance_m: float
    azimuth_deg: float
    elevation_deg: float = 32.0
    fov_deg: float = 42.0

    def project(self, points: F64) -> tuple[F64, F64]:
        """(pixels (n, 2) as x right and y down, depth (n,) metres in front of the camera)."""
        a, e = np.radians(self.azimuth_deg), np.radians(self.elevation_deg)
        back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        up = np.cross(back, right)
        from_camera = points - (np.asarray(self.target) + self.distance_m * back)
        depth = -(from_camera @ back)
        focal = 0.5 * WIDTH / np.tan(np.radians(0.5 * self.fov_deg))
        scale = focal / np.maximum(depth, 0.1)
        pixels = np.column_stack(
            [0.5 * WIDTH + (from_camera @ right) * scale, 0.5 * HEIGHT - (from_camera @ up) * scale]
        )
        return pixels, depth


def shades(height: F64) -> F32:
    """(n, 3) grey-blue by height above ground (n,), metres: pale ground, darker walls."""
    share = np.clip((height[:, None] - 0.2) / 9.0, 0.0, 1.0)
    low, high = np.array(to_rgb("#a9b8c4")), np.array(to_rgb("#33506a"))
    colours = low + (high - low) * share
    colours[height < 0.3] = to_rgb("#d3dade")
    return colours.astype(np.float32)


def render(points: F64, colours: F32, camera: Camera, size_m: float = 0.2) -> U8:
    """(HEIGHT, WIDTH, 4) opaque image of points (n, 3) in their ``colours`` (n, 3), each a square of ``size_m``.

    Bytes with a fourth channel: matplotlib resamples them as float32, an image without one as float64."""
    image = np.ones((HEIGHT, WIDTH, 3), dtype=np.float32)
    depth_image = np.full((HEIGHT, WIDTH), np.inf, dtype=np.float32)
    pixels, depth = camera.project(points)
    order = np.argsort(-depth, kind="stable")
    order = order[depth[order] > 1.0]
    corner: I64 = np.floor(pixels[order]).astype(np.int64)
    focal = 0.5 * WIDTH / np.tan(np.radians(0.5 * camera.fov_deg))
    sizes = np.clip(np.ceil(size_m * focal / depth[order]), 2, 9).astype(np.int64)
    # Sizes fall into few groups; far ones first, so that nearer points overwrite.
    for size in np.unique(sizes):
        chosen = order[sizes == size]
        at = corner[sizes == size] - size // 2
        for dx in range(size):
            for dy in range(size):
                x, y = at[:, 0] + dx, at[:, 1] + dy
                inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
                xi, yi, who = x[inside], y[inside], chosen[inside]
                nearer = depth[who] <= depth_image[yi, xi]
                xi, yi, who = xi[nearer], yi[nearer], who[nearer]
                image[yi, xi] = colours[who]
                depth_image[yi, xi] = depth[who]
    image *= _eye_dome(depth_image)[..., None]
    opaque = np.full((HEIGHT, WIDTH, 4), 255, dtype=np.uint8)
    opaque[..., :3] = np.rint(255.0 * image)
    return opaque


def _eye_dome(depth: F32, radius: int = 2, strength: float = 2.2) -> F32:
    """(rows, cols) factor in (0, 1]: darker where neighbours are nearer."""
    log_depth = np.log(np.where(np.isfinite(depth), depth, 1e4))
    occlusion = np.zeros(depth.shape, dtype=np.float32)
    for dr, dc in ((-radius, 0), (radius, 0), (0, -radius), (0, radius)):
        neighbour = np.roll(log_depth, (dr, dc), axis=(0, 1))
        occlusion += np.clip(log_depth - neighbour, 0.0, 0.12)
    out: F32 = np.exp(-strength * occlusion).astype(np.float32)
    out[~np.isfinite(depth)] = 1.0
    return out


def draw(
    panels: Sequence[tuple[str, F64, F32]],
    camera: Camera,
    *,
    paths: Sequence[tuple[str, F64]] = (),
    legend: Sequence[tuple[str, str]] = (),
    size_m: float = 0.2,
) -> Figure:
    """Panels (title, points (n, 3), colours (n, 3)) from one camera; ``paths`` of vehicles (name, points (m, 3))."""
    width = 13.0
    figure, axes = style.new_figure(width, 0.62 * width / len(panels) + 0.6, 1, len(panels))
    for axis, (title, points, colours) in zip(axes[0], panels, strict=True):
        axis.imshow(render(points, colours, camera, size_m), interpolation="antialiased")
        for i, (_, path) in enumerate(paths):
            pixels, depth = camera.project(path)
            seen = depth > 2.0
            axis.plot(*pixels[seen].T, color=style.VEHICLE_COLOURS[i % 8], lw=2.0, solid_capstyle="round")
        axis.set_xlim(0, WIDTH)
        axis.set_ylim(HEIGHT, 0)
        axis.set_title(title, loc="left")
        axis.set_xticks([])
        axis.set_yticks([])
    handles = [Line2D([], [], marker="s", ls="", color=colour, label=name, markersize=7) for name, colour in legend]
    handles += [
        Line2D([], [], color=style.VEHICLE_COLOURS[i % 8], lw=2, label=name) for i, (name, _) in enumerate(paths)
    ]
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False)
    return figure
