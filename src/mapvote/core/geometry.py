"""Rigid motions and azimuths. Motions are (4, 4) float64 matrices: ``T_a_b`` takes coordinates in frame b to frame a.

Tangent vectors are (6,) float64, translation first: ``(x, y, z, rx, ry, rz)`` in metres and
radians, applied on the left (``exp(xi) @ T``). Source: Barfoot, State Estimation for Robotics, ch. 8.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import F64, I64, read_only


def transform(T_a_b: F64, points_b: NDArray[np.floating]) -> F64:
    """Points (n, 3) of frame b in frame a, float64 whatever came in.

    Not by a matrix product: BLAS wakes all its threads for so small a matrix, and on a busy machine they wait for each
    other (twice the CPU time of a whole drive).
    """
    points = read_only(np.ascontiguousarray(points_b))  # float32 as it is: a copy takes ten times as long as the kernel
    out = np.empty((len(points), 3))
    _transform(read_only(np.ascontiguousarray(T_a_b, dtype=np.float64)), points, out)
    return out


@kernel
def _transform(T: F64, points: NDArray[np.floating], out: F64) -> None:
    for i in range(len(points)):
        x = np.float64(points[i, 0])
        y = np.float64(points[i, 1])
        z = np.float64(points[i, 2])
        for k in range(3):
            out[i, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]


def rows_from(points: F64, origin: F64) -> NDArray[np.float32]:
    """(3, n) float32: points (n, 3) from ``origin`` (3,), in rows of x, y and z, which loops over points vectorise."""
    rows = np.empty((3, len(points)), np.float32)
    _rows_from(read_only(np.ascontiguousarray(points)), read_only(np.ascontiguousarray(origin)), rows)
    return rows


@kernel
def _rows_from(points: F64, origin: F64, rows: NDArray[np.float32]) -> None:
    x = rows[0]
    y = rows[1]
    z = rows[2]
    for i in range(np.uint64(0), np.uint64(len(points))):  # unsigned: an index that cannot be negative vectorises
        x[i] = points[i, 0] - origin[0]
        y[i] = points[i, 1] - origin[1]
        z[i] = points[i, 2] - origin[2]


def corners(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """(2, k) the lowest and the highest coordinates of points (n, k), column by column: numpy takes ten times as long
    to reduce rows of three."""
    columns = points.T
    return np.array([[column.min() for column in columns], [column.max() for column in columns]])


def inverse(T_a_b: F64) -> F64:
    """T_b_a of T_a_b, by the transpose of the rotation (exact for rigid motions)."""
    (r00, r01, r02, x), (r10, r11, r12, y), (r20, r21, r22, z), _ = np.asarray(T_a_b, dtype=np.float64).tolist()
    return np.array(
        (
            (r00, r10, r20, -(r00 * x + r10 * y + r20 * z)),
            (r01, r11, r21, -(r01 * x + r11 * y + r21 * z)),
            (r02, r12, r22, -(r02 * x + r12 * y + r22 * z)),
            (0.0, 0.0, 0.0, 1.0),
        )
    )


def hat(v: ArrayLike) -> F64:
    """The (3, 3) cross-product matrix of a (3,) vector."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(xi: ArrayLike) -> F64:
    """SE(3) exponential of a (6,) tangent vector (Barfoot 8.33)."""
    rho, phi = np.asarray(xi, dtype=np.float64).reshape(2, 3).tolist()
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    angle = math.sqrt(angle2)
    small = angle < 1e-8
    s = 1.0 if small else math.sin(angle) / angle
    half_chord = 0.5 if small else 2.0 * (math.sin(0.5 * angle) / angle) ** 2  # 1 - cos cancels at small angles
    rest = 0.0 if small else (1.0 - s) / angle2
    x, y, z = _by_turn(rho, phi, half_chord, rest)
    # The square of the cross-product matrix of v is v v^T - v^2.
    (a, b, c), m = phi, 1.0 - half_chord * angle2
    return np.array(
        (
            (m + half_chord * a * a, half_chord * a * b - s * c, half_chord * a * c + s * b, x),
            (half_chord * a * b + s * c, m + half_chord * b * b, half_chord * b * c - s * a, y),
            (half_chord * a * c - s * b, half_chord * b * c + s * a, m + half_chord * c * c, z),
            (0.0, 0.0, 0.0, 1.0),
        )
    )


def _by_turn(v: list[float], phi: list[float], first: float, second: float) -> tuple[float, float, float]:
    """(1 + first W + second W^2) v, W the cross-product matrix of phi. Plain numbers: ten small arrays take ten times
    as long."""
    x, y, z = v
    a, b, c = phi
    along = a * x + b * y + c * z
    rest = 1.0 - second * (a * a + b * b + c * c)
    return (
        rest * x + first * (b * z - c * y) + second * along * a,
        rest * y + first * (c * x - a * z) + second * along * b,
        rest * z + first * (a * y - b * x) + second * along * c,
    )


def log(T: F64) -> F64:
    """The (6,) tangent vector of T; inverse of :func:`exp` for rotations below pi."""
    (r00, r01, r02, x), (r10, r11, r12, y), (r20, r21, r22, z), _ = np.asarray(T, dtype=np.float64).tolist()
    vee = [r21 - r12, r02 - r20, r10 - r01]
    length = math.sqrt(vee[0] * vee[0] + vee[1] * vee[1] + vee[2] * vee[2])
    angle = math.atan2(0.5 * length, 0.5 * (r00 + r11 + r22 - 1.0))
    if angle < 1e-8:
        phi = [0.5 * v for v in vee]
        return np.array([*_by_turn([x, y, z], phi, -0.5, 0.0), *phi])
    if np.pi - angle < 1e-6:  # vee vanishes: take the axis from R + I instead
        S = 0.5 * (T[:3, :3] + np.eye(3))
        k = int(np.argmax(np.diag(S)))
        axis = S[:, k] / np.sqrt(S[k, k])
        phi = (angle * (axis if float(axis @ vee) >= 0 else -axis)).tolist()
    else:
        phi = [v * angle / length for v in vee]
    half = 0.5 * angle
    return np.array([*_by_turn([x, y, z], phi, -0.5, (1.0 - half / math.tan(half)) / angle**2), *phi])


def interpolate(T_0: F64, T_1: F64, alpha: float) -> F64:
    """The motion a share ``alpha`` of the way from T_0 to T_1 at constant twist; extrapolates outside [0, 1]."""
    return T_0 @ exp(alpha * log(inverse(T_0) @ T_1))


def wrapped(angles_rad: F64) -> F64:
    """(n,) the same angles between -pi and pi."""
    return np.asarray((angles_rad + np.pi) % (2.0 * np.pi) - np.pi)


def from_xyz_rpy(
    x: ArrayLike, y: ArrayLike, z: ArrayLike, roll: ArrayLike = 0.0, pitch: ArrayLike = 0.0, yaw: ArrayLike = 0.0
) -> F64:
    """(..., 4, 4) of metres and radians, numbers or arrays of one shape; R = Rz(yaw) Ry(pitch) Rx(roll)."""
    cr = np.cos(roll)
    sr = np.sin(roll)
    cp = np.cos(pitch)
    sp = np.sin(pitch)
    cy = np.cos(yaw)
    sy = np.sin(yaw)
    T = np.tile(np.eye(4), (*np.broadcast_shapes(np.shape(x), cr.shape, cp.shape, cy.shape), 1, 1))
    T[..., 0, 0] = cy * cp
    T[..., 0, 1] = cy * sp * sr - sy * cr
    T[..., 0, 2] = cy * sp * cr + sy * sr
    T[..., 1, 0] = sy * cp
    T[..., 1, 1] = sy * sp * sr + cy * cr
    T[..., 1, 2] = sy * sp * cr - cy * sr
    T[..., 2, 0] = -sp
    T[..., 2, 1] = cp * sr
    T[..., 2, 2] = cp * cr
    T[..., 0, 3] = x
    T[..., 1, 3] = y
    T[..., 2, 3] = z
    return T


def rotations_of(quaternions: ArrayLike) -> F64:
    """(n, 3, 3) rotations of quaternions (n, 4) x, y, z, w of any length but 0.

    The import of scipy's takes .4 s and 24 MB, in every live drive.
    """
    q = np.asarray(quaternions, dtype=np.float64)
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.array(rows).transpose(2, 0, 1)


def poses_at(positions: ArrayLike, rotations: ArrayLike | None = None) -> F64:
    """(n, 4, 4) of positions (n, 3), turned by rotations (n, 3, 3), or by nothing."""
    positions = np.asarray(positions, dtype=np.float64)
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, 3] = positions
    T[:, :3, :3] = np.eye(3) if rotations is None else rotations
    return T


def rotation_angle(T: F64) -> float:
    """Magnitude of the rotation of T, radians in [0, pi]."""
    return float(np.linalg.norm(log(T)[3:]))


def is_rigid(T: F64, tolerance: float = 1e-3) -> bool:
    """Whether T is finite, its rotation orthonormal within ``tolerance`` and right-handed."""
    R = T[:3, :3]
    return bool(np.all(np.isfinite(T)) and np.allclose(R @ R.T, np.eye(3), atol=tolerance) and np.linalg.det(R) > 0)


_SMALL = 1e-8
"""Radians: below, sines and tangents are their arguments."""
_NEARLY_PI = 1e-6
"""Radians: so near to a half turn the axis shows in the rotation's diagonal only."""


def inverses(T_a_b: F64) -> F64:
    """(n, 4, 4) T_b_a of motions (n, 4, 4), by the transpose of the rotation."""
    T = np.zeros_like(T_a_b)
    T[:, :3, :3] = T_a_b[:, :3, :3].transpose(0, 2, 1)
    T[:, :3, 3] = -_turned(T[:, :3, :3], T_a_b[:, :3, 3])
    T[:, 3, 3] = 1.0
    return T


def hats(v: F64) -> F64:
    """(n, 3, 3) cross-product matrices of vectors (n, 3)."""
    W = np.zeros((len(v), 3, 3))
    W[:, 2, 1], W[:, 0, 2], W[:, 1, 0] = v.T
    return W - W.transpose(0, 2, 1)


def exps(xi: F64) -> F64:
    """(n, 4, 4) SE(3) exponentials of tangent vectors (n, 6), translation first, metres and radians."""
    rho = xi[:, :3]
    phi = xi[:, 3:]
    angle = np.linalg.norm(phi, axis=1)
    W = hats(phi)
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    s = np.where(small, 1.0, np.sin(safe) / safe)
    half_chord = np.where(small, 0.5, 2.0 * (np.sin(0.5 * safe) / safe) ** 2)  # 1 - cos cancels at small angles
    rest = np.where(small, 1.0 / 6.0, (1.0 - s) / safe**2)
    W2 = W @ W
    T = np.zeros((len(xi), 4, 4))
    T[:, :3, :3] = np.eye(3) + s[:, None, None] * W + half_chord[:, None, None] * W2
    T[:, :3, 3] = _turned(np.eye(3) + half_chord[:, None, None] * W + rest[:, None, None] * W2, rho)
    T[:, 3, 3] = 1.0
    return T


def logs(T: F64) -> F64:
    """(n, 6) tangent vectors of motions (n, 4, 4), metres and radians; inverse of :func:`exps` for rotations below
    pi."""
    R = T[:, :3, :3]
    vee = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    length = np.linalg.norm(vee, axis=1)
    angle = np.arctan2(0.5 * length, 0.5 * (R.trace(axis1=1, axis2=2) - 1.0))
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    phi = np.where(small, 0.5, safe / np.where(length > 0.0, length, 1.0))[:, None] * vee
    W = hats(phi)
    rest = np.where(small, 1.0 / 12.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    V_inv = np.eye(3) - 0.5 * W + rest[:, None, None] * (W @ W)
    out = np.concatenate([_turned(V_inv, T[:, :3, 3]), phi], axis=1)
    for k in np.flatnonzero(np.pi - angle < _NEARLY_PI):
        out[k] = log(T[k])
    return out


def rotation_angles(T: F64) -> F64:
    """(n,) magnitudes of the rotations of motions (n, 4, 4), radians in [0, pi]."""
    return np.asarray(np.linalg.norm(logs(T)[:, 3:], axis=1))


def adjoints(T: F64) -> F64:
    """(n, 6, 6) with exp(adjoint(T) xi) = T exp(xi) T^-1 of motions (n, 4, 4)."""
    R = T[:, :3, :3]
    out = np.zeros((len(T), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = R
    out[:, :3, 3:] = hats(T[:, :3, 3]) @ R
    return out


def _turned(M: F64, v: F64) -> F64:
    """(n, 3) vectors (n, 3), each by its own matrix (n, 3, 3)."""
    return np.asarray((M * v[:, None, :]).sum(axis=2))


_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7, _A8, _A9, _A10 = map(np.float32, (
    3.33333333333329318027e-01, -1.99999999998764832476e-01, 1.42857142725034663711e-01, -1.11111104054623557880e-01,
    9.09088713343650656196e-02, -7.69187620504482999495e-02, 6.66107313738753120669e-02, -5.83357013379057348645e-02,
    4.97687799461593236017e-02, -3.65315727442169155270e-02, 1.62858201153657823623e-02,
))  # fmt: skip
"""Coefficients of 1 - arctan(u) / u by powers of u squared. An index into a tuple would be compiled for each place."""
_H0, _H1, _H2, _H3 = map(np.float32, (0.46364760398864746, 0.7853981256484985, 0.9827936887741089, 1.570796251296997))
"""arctan of 1/2, 1, 3/2 and infinity, as near as float32 is below them."""
_L0, _L1, _L2, _L3 = map(
    np.float32, (5.01215824399992e-09, 3.774894707930798e-08, 3.447321716976148e-08, 7.549789415861596e-08)
)
"""The remainder of each."""
_PI, _PI_LEFT, _HALF_PI = np.float32(np.pi), np.float32(-8.7422776573e-08), np.float32(np.pi / 2.0)
_AT_INFINITY = np.float32(_H3 + _L3)
_B0, _B1, _B2, _B3, _B4 = map(np.float32, (0.4375, 0.6875, 1.1875, 2.4375, 2.0**25))
"""Between the branches; from the last one on, a ratio counts as infinite."""
_ZERO, _ONE, _TWO, _MIDDLE = (np.float32(v) for v in (0.0, 1.0, 2.0, 1.5))


@inlined
def azimuth(y: np.float32, x: np.float32) -> np.float32:
    """arctan2(y, x) of finite float32, as a kernel that vectorises, because every point of every scan needs it.

    The C library works one out in 24 ns, branch by branch. Here the right branch is chosen number by number in vectors,
    by the same steps (fdlibm's, which glibc's atan2f took until 2.40): the same float32 in a ninth of the time, on
    every machine.
    """
    t = _ZERO if y == _ZERO else abs(y / x)  # at the origin itself too
    first = t < _B0
    second = t < _B1
    third = t < _B2
    fourth = t < _B3
    # arctan t = h + l + arctan u, u = top / under. Nested choices would be branches again.
    top = _TWO * t - _ONE if second else t - _ONE
    under = _TWO + t if second else t + _ONE
    top_ = t - _MIDDLE if fourth else -_ONE
    under_ = _ONE + _MIDDLE * t if fourth else t
    top = top if third else top_
    under = under if third else under_
    top = t if first else top
    under = _ONE if first else under
    h = _H0 if second else _H1
    l = _L0 if second else _L1  # noqa: E741
    h_ = _H2 if fourth else _H3
    l_ = _L2 if fourth else _L3
    h = h if third else h_
    l = l if third else l_  # noqa: E741
    h = _ZERO if first else h
    l = _ZERO if first else l  # noqa: E741
    u = top / under
    z = u * u
    w = z * z
    odd = z * (_A0 + w * (_A2 + w * (_A4 + w * (_A6 + w * (_A8 + w * _A10)))))
    even = w * (_A1 + w * (_A3 + w * (_A5 + w * (_A7 + w * _A9))))
    turn = h - ((u * (odd + even) - l) - u)
    turn = _AT_INFINITY if t >= _B4 else turn
    behind = _PI - (turn - _PI_LEFT)
    turn = behind if math.copysign(_ONE, x) < _ZERO else turn
    turn = _HALF_PI if (x == _ZERO) & (y != _ZERO) else turn
    return np.float32(math.copysign(turn, y))


@inlined
def turn(x: np.float32, y: np.float32) -> np.float32:
    """Azimuth of (x, y) in [0, 1] turns, within 1e-5 rad (Abramowitz and Stegun 4.4.49), in float32 and without a
    branch, so that a loop over points vectorises: it sorts rays, it measures nothing. 0 for (0, 0)."""
    ax = abs(x)
    ay = abs(y)
    q = min(ax, ay) / max(max(ax, ay), np.float32(1e-30))
    s = q * q
    a = np.float32(-0.0851330) + s * np.float32(0.0208351)
    a = q * (np.float32(0.9998660) + s * (np.float32(-0.3302995) + s * (np.float32(0.1801410) + s * a)))
    a *= np.float32(0.5 / np.pi)
    a = np.float32(0.25) - a if ay > ax else a
    a = np.float32(0.5) - a if x < np.float32(0.0) else a
    return np.float32(1.0) - a if y < np.float32(0.0) else a


def velocity_changes(places_m: F64, stamps_ns: I64) -> tuple[F64, F64]:
    """((m - 2,) changes of the velocity between consecutive steps, metres per second; (m - 2,) seconds in which each
    happens) of places (m, 3) at stamps (m,)."""
    seconds = np.diff(stamps_ns) * 1e-9
    velocity_mps = np.diff(places_m, axis=0) / seconds[:, None]
    return np.linalg.norm(np.diff(velocity_mps, axis=0), axis=1), 0.5 * (seconds[1:] + seconds[:-1])
