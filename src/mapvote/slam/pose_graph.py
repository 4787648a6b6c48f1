"""Poses that agree best with the motion measured between them and with what was known of each.

Registration to a growing map is smooth but drifts; a survey prior does not drift but is rough. Gauss-Newton on
SE(3) over the whole trajectory keeps the shape of the one in the frame of the other. Source: Barfoot, State Estimation
for Robotics, 8.1 and 9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu, spsolve

from mapvote.core.geometry import exp, hat, inverse, log
from mapvote.core.types import F64, I64


@dataclass(frozen=True, slots=True)
class Links:
    """Measured motions: pose ``second[k]`` in the frame of pose ``first[k]``."""

    first: I64
    second: I64
    T_first_second: F64
    """(k, 4, 4)."""
    sigma_m: float
    sigma_rad: float


@dataclass(frozen=True, slots=True)
class Anchors:
    """Poses known in the map beforehand."""

    pose: I64
    T_map: F64
    """(k, 4, 4)."""
    sigma_m: float
    sigma_rad: float
    said_m: float = 1.0
    """What each claims of itself alone; ``sigma_m`` is wider where many err alike."""
    weights: F64 | None = None
    """(k,) in (0, 1], how far each is believed; None: all."""


def adjoint(T: F64) -> F64:
    """(6, 6) with exp(adjoint(T) xi) = T exp(xi) T^-1 (translation first)."""
    R = T[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[:3, 3:] = hat(T[:3, 3]) @ R
    return out


def optimise(T_map: F64, links: list[Links], anchors: list[Anchors], iterations: int = 4) -> F64:
    """Poses (n, 4, 4) moved to the least-squares solution; those that nothing fixes stay where they are."""
    poses = T_map.copy()
    for _ in range(iterations):
        H, gradient = _normal_equations(poses, links, anchors)
        step = -np.asarray(spsolve(H, gradient.ravel())).reshape(len(poses), 6)
        poses = np.array([T @ exp(xi) for T, xi in zip(poses, step, strict=True)])
        if np.abs(step).max(initial=0.0) < 1e-6:
            break
    return poses


def position_sigmas(T_map: F64, links: list[Links], anchors: list[Anchors], asked: I64) -> F64:
    """(k,) standard deviation of the positions of the poses ``asked`` (k,), the largest over all directions."""
    H, _ = _normal_equations(T_map, links, anchors)
    solve = splu(H).solve
    out = []
    for i in asked.tolist():
        unit = np.zeros((6 * len(T_map), 3))
        unit[6 * i : 6 * i + 3] = np.eye(3)
        out.append(np.sqrt(np.linalg.eigvalsh(solve(unit)[6 * i : 6 * i + 3])[-1]))
    return np.array(out)


def _normal_equations(poses: F64, links: list[Links], anchors: list[Anchors]) -> tuple[sparse.csc_matrix, F64]:
    """(6n, 6n) and (n, 6) of a Gauss-Newton step T exp(step). A tiny weight on the step itself keeps what is free."""
    n = len(poses)
    gradient = np.zeros((n, 6))
    blocks: dict[tuple[int, int], F64] = {(i, i): 1e-6 * np.eye(6) for i in range(n)}

    def enter(i: int, j: int, block: F64) -> None:
        blocks[i, j] = blocks.get((i, j), np.zeros((6, 6))) + block

    for link in links:
        W = _weight(link.sigma_m, link.sigma_rad)
        for i, j, Z in zip(link.first.tolist(), link.second.tolist(), link.T_first_second, strict=True):
            T_i_j = inverse(poses[i]) @ poses[j]
            r = log(inverse(Z) @ T_i_j)
            A = -adjoint(inverse(T_i_j))
            gradient[i] += A.T @ W @ r
            gradient[j] += W @ r
            enter(i, i, A.T @ W @ A)
            enter(j, j, W)
            enter(i, j, A.T @ W)
            enter(j, i, W @ A)
    for anchor in anchors:
        W = _weight(anchor.sigma_m, anchor.sigma_rad)
        believed = np.ones(len(anchor.pose)) if anchor.weights is None else anchor.weights
        for i, P, w in zip(anchor.pose.tolist(), anchor.T_map, believed, strict=True):
            gradient[i] += w * W @ log(inverse(P) @ poses[i])
            enter(i, i, w * W)
    keys = np.array(list(blocks))
    row = 6 * keys[:, 0, None, None] + np.arange(6)[None, :, None] + np.zeros((1, 1, 6), dtype=np.int64)
    col = 6 * keys[:, 1, None, None] + np.arange(6)[None, None, :] + np.zeros((1, 6, 1), dtype=np.int64)
    values = np.array(list(blocks.values()))
    H = sparse.csc_matrix((values.ravel(), (row.ravel(), col.ravel())), shape=(6 * n, 6 * n))
    return H, gradient


def _weight(sigma_m: float, sigma_rad: float) -> F64:
    return np.diag([sigma_m**-2] * 3 + [sigma_rad**-2] * 3)
