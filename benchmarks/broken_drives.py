"""Kinds of broken drives: what is done to a sound one, and the words by which it is named rightly.

A kind changes scans, poses or times of a drive in memory, or the files of the folder once it is written.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import tomli_w

from mapvote.core.geometry import exp, from_xyz_rpy, inverse, transform
from mapvote.formats.drives.kitti import write_poses


@dataclass
class Recording:
    """A drive in memory: scans [(n, 4)], poses (m, 4, 4), times (m,) in seconds, lines of drive.toml."""

    scans: list
    T: np.ndarray
    times_s: np.ndarray
    toml: dict = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        (folder / "velodyne").mkdir(parents=True)
        for i, scan in enumerate(self.scans):
            np.ascontiguousarray(scan, dtype="<f4").tofile(folder / "velodyne" / f"{i:06d}.bin")
        write_poses(folder / "prior.txt", self.T)
        (folder / "times.txt").write_text("".join(f"{t:.9f}\n" for t in self.times_s))
        (folder / "drive.toml").write_text(tomli_w.dumps(self.toml))


@dataclass(frozen=True)
class Kind:
    name: str
    right: str
    """A regular expression that names it."""
    drive: Callable[[Recording], Recording] = lambda r: r
    files: Callable[[Path], None] = lambda folder: None
    grave: bool = True
    """Whoever goes on with it gets a wrong map or none."""


def points(name: str, right: str, change: Callable[[np.ndarray], np.ndarray], grave: bool = True) -> Kind:
    """``change`` of a scan's x, y, z (n, 3)."""

    def drive(r: Recording) -> Recording:
        return replace(r, scans=[np.column_stack([change(s[:, :3].astype(np.float64)), s[:, 3]]) for s in r.scans])

    return Kind(name, right, drive, grave=grave)


def rows(name: str, right: str, change: Callable[[np.ndarray], np.ndarray], grave: bool = True) -> Kind:
    """``change`` of a scan's rows (n, 4)."""
    return Kind(name, right, lambda r: replace(r, scans=[change(s) for s in r.scans]), grave=grave)


def poses(name: str, right: str, change: Callable[[np.ndarray], np.ndarray], grave: bool = True) -> Kind:
    """``change`` of the poses (m, 4, 4)."""
    return Kind(name, right, lambda r: replace(r, T=change(r.T.copy())), grave=grave)


def times(name: str, right: str, change: Callable[[np.ndarray], np.ndarray], grave: bool = True) -> Kind:
    """``change`` of the times (m,)."""
    return Kind(name, right, lambda r: replace(r, times_s=change(r.times_s.copy())), grave=grave)


def one_scan(name: str, right: str, change: Callable[[np.ndarray], np.ndarray], grave: bool = True) -> Kind:
    """``change`` of one scan's rows, in the middle."""

    def drive(r: Recording) -> Recording:
        k = len(r.scans) // 2 + 1
        return replace(r, scans=[change(s) if i == k else s for i, s in enumerate(r.scans)])

    return Kind(name, right, drive, grave=grave)


def _positions(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    def poses_of(T: np.ndarray) -> np.ndarray:
        T[:, :3, 3] = change(T[:, :3, 3])
        return T

    return poses_of


def _rotations(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    def poses_of(T: np.ndarray) -> np.ndarray:
        T[:, :3, :3] = change(T[:, :3, :3])
        return T

    return poses_of


def _yaw_of(T: np.ndarray, rule: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    yaw = rule(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    return np.array([from_xyz_rpy(*p, yaw=float(a)) for p, a in zip(T[:, :3, 3], yaw, strict=True)])


def _noise(sigma: float) -> Callable[[np.ndarray], np.ndarray]:
    rng = np.random.default_rng(7)
    return lambda p: p + rng.normal(0, sigma, p.shape)


def _frozen(T: np.ndarray) -> np.ndarray:
    T[len(T) // 2 :] = T[len(T) // 2]
    return T


def _jump(metres: float) -> Callable[[np.ndarray], np.ndarray]:
    def poses_of(T: np.ndarray) -> np.ndarray:
        T[len(T) // 2 :, 0, 3] += metres
        return T

    return poses_of


def _spikes(T: np.ndarray) -> np.ndarray:
    T[5::12, 1, 3] += 25.0
    return T


def _degrees(swap: bool) -> Callable[[np.ndarray], np.ndarray]:
    def rule(p: np.ndarray) -> np.ndarray:
        lon, lat = 8.4 + p[:, 0] / (111_320.0 * np.cos(np.radians(49.0))), 49.0 + p[:, 1] / 111_320.0
        return np.column_stack([lat, lon, p[:, 2]] if swap else [lon, lat, p[:, 2]])

    return rule


def _wave(T: np.ndarray) -> np.ndarray:
    T[:, 2, 3] += 3.0 * np.sin(np.arange(len(T)) / 2.0)
    return T


def turn_points(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    T = from_xyz_rpy(0, 0, 0, *np.radians([roll, pitch, yaw]))
    return lambda p: transform(T, p)


def turn_poses(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    C = from_xyz_rpy(0, 0, 0, *np.radians([roll, pitch, yaw]))
    return lambda T: T @ C


def in_map_frame(r: Recording) -> Recording:
    return replace(
        r, scans=[np.column_stack([transform(T, s[:, :3]), s[:, 3]]) for T, s in zip(r.T, r.scans, strict=True)]
    )


def in_map_axes(r: Recording) -> Recording:
    return replace(
        r, scans=[np.column_stack([s[:, :3] @ T[:3, :3].T, s[:, 3]]) for T, s in zip(r.T, r.scans, strict=True)]
    )


def reordered(order: Callable[[int], np.ndarray]) -> Callable[[Recording], Recording]:
    return lambda r: replace(r, scans=[r.scans[i] for i in order(len(r.scans))])


def shuffled(n: int) -> np.ndarray:
    return np.random.default_rng(3).permutation(n)


def as_text_sorted(n: int) -> np.ndarray:
    """0, 1, 10, 11, ..., 2, 20: names without leading zeros, sorted as text."""
    return np.array(sorted(range(n), key=str))


def azimuth(rows_: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(rows_[:, 1], rows_[:, 0]))


def shifted_rows(k: int) -> Callable[[np.ndarray], np.ndarray]:
    """Every row ``k`` scans early; the last ones go on as the drive ended."""

    def rule(T: np.ndarray) -> np.ndarray:
        step = inverse(T[-2]) @ T[-1]
        beyond = [T[-1] @ np.linalg.matrix_power(step, j + 1) for j in range(k)]
        return np.concatenate([T[k:], beyond])

    return rule


def scattered_ranges(sigma_m: float) -> Callable[[np.ndarray], np.ndarray]:
    rng = np.random.default_rng(7)
    return lambda p: p * (1 + rng.normal(0, sigma_m, (len(p), 1)) / np.linalg.norm(p, axis=1, keepdims=True))


def with_roof(s: np.ndarray) -> np.ndarray:
    """Rows (n, 4) with an eighth more of them on the vehicle itself."""
    n = len(s) // 8
    return np.concatenate([s, np.array([1.3, 0.3, -0.4, 0.2]) + 0.1 * np.random.default_rng(1).random((n, 4))])


def five_columns(s: np.ndarray) -> np.ndarray:
    """What four columns make of a file of five, the fifth a ring."""
    five = np.column_stack([s, np.arange(len(s)) % 64])
    return five.ravel()[: five.size // 4 * 4].reshape(-1, 4)


def every_tenth(value: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda s: np.where(np.arange(len(s))[:, None] % 10 == 0, value, s)


def doubled(n: int) -> np.ndarray:
    """Every second scan written twice, the others lost."""
    return np.arange(n) // 2 * 2


def deltas(T: np.ndarray) -> np.ndarray:
    return np.array([np.eye(4), *(inverse(a) @ b for a, b in pairwise(T))])


def elsewhere(T: np.ndarray) -> np.ndarray:
    """The trajectory of another drive: a tight bend at another speed."""
    return np.array([exp(k * np.array([0.31, 0, 0, 0, 0, 0.06])) for k in range(len(T))])


def cut_bytes(n: int) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        file = sorted((folder / "velodyne").iterdir())[len(list((folder / "velodyne").iterdir())) // 2]
        file.write_bytes(file.read_bytes()[:-n])

    return change


def edit_lines(name: str, change: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join(change(lines)) + "\n")

    return edit


def positions(name: str, right: str, change: Callable[[np.ndarray], np.ndarray], grave: bool = True) -> Kind:
    return poses(name, right, _positions(change), grave)


def rotations(name: str, right: str, change: Callable[[np.ndarray], np.ndarray], grave: bool = True) -> Kind:
    return poses(name, right, _rotations(change), grave)


def with_yaw(name: str, right: str, rule: Callable[[np.ndarray], np.ndarray], grave: bool = True) -> Kind:
    return poses(name, right, lambda T: _yaw_of(T, rule), grave)


noise, frozen, jump, spikes, degrees, wave = _noise, _frozen, _jump, _spikes, _degrees, _wave
