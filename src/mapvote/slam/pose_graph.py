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

from mapvote.core.geometry import adjoints, exps, inverses, logs
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


def optimise(T_map: F64, links: list[Links], anchors: list[Anchors], iterations: int = 4) -> F64:
    """Poses (n, 4, 4) moved to the least-squares solution; those that nothing fixes stay where they are."""
    poses = T_map.copy()
    for _ in range(iterations):
        H, gradient = _normal_equations(poses, links, anchors)
        step = -np.asarray(spsolve(H, gradient.ravel())).reshape(len(poses), 6)
        poses = poses @ exps(step)
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
    every = np.arange(n)
    blocks = [(every, every, np.broadcast_to(1e-6 * np.eye(6), (n, 6, 6)))]
    for link in links:
        W, (i, j) = _weight(link.sigma_m, link.sigma_rad), (link.first, link.second)
        T_i_j = inverses(poses[i]) @ poses[j]
        r = logs(inverses(link.T_first_second) @ T_i_j)
        A_t = -adjoints(inverses(T_i_j)).transpose(0, 2, 1)
        A_t_W = A_t * W
        np.add.at(gradient, i, (A_t_W * r[:, None, :]).sum(axis=2))
        np.add.at(gradient, j, W * r)
        blocks += [
            (i, i, A_t_W @ A_t.transpose(0, 2, 1)),
            (j, j, np.broadcast_to(np.diag(W), (len(j), 6, 6))),
            (i, j, A_t_W),
            (j, i, A_t_W.transpose(0, 2, 1)),
        ]
    for anchor in anchors:
        W, i = _weight(anchor.sigma_m, anchor.sigma_rad), anchor.pose
        believed = np.ones(len(i)) if anchor.weights is None else anchor.weights
        np.add.at(gradient, i, believed[:, None] * W * logs(inverses(anchor.T_map) @ poses[i]))
        blocks.append((i, i, believed[:, None, None] * np.diag(W)))
    first, second, values = (np.concatenate(part) for part in zip(*blocks, strict=True))
    row = np.broadcast_to(6 * first[:, None, None] + np.arange(6)[:, None], values.shape)
    col = np.broadcast_to(6 * second[:, None, None] + np.arange(6), values.shape)
    # Blocks that stand in the same place add up.
    H = sparse.csc_matrix((values.ravel(), (row.ravel(), col.ravel())), shape=(6 * n, 6 * n))
    return H, gradient


def _weight(sigma_m: float, sigma_rad: float) -> F64:
    """(6,) the diagonal of an information matrix."""
    return np.array([sigma_m**-2] * 3 + [sigma_rad**-2] * 3)
