"""The direction in which a point lies: as the C library says, corners and all."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import pytest

from mapvote.core.geometry import azimuth_64
from mapvote.core.types import F64


def _for_all(azimuth: Any) -> Any:
    """A kernel of (n,) y and x for one of a number."""

    @numba.njit(error_model="numpy")  # type: ignore[untyped-decorator]
    def every(y: F64, x: F64) -> F64:
        out = np.empty_like(x)
        for i in range(len(x)):
            out[i] = azimuth(y[i], x[i])
        return out

    return every


_all_32, _all_64 = _for_all(azimuth_32), _for_all(azimuth_64)


def _points(n: int) -> tuple[F64, F64]:
    """Near and far, on a grid too, so that many lie on an axis or a diagonal."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(0.0, 1.0, (2, n)) * 10.0 ** rng.uniform(-4.0, 3.0, (2, n))
    x[::3], y[::3] = np.round(x[::3], 1), np.round(y[::3], 1)
    return y, x


def test_a_float32_azimuth_is_the_true_one_but_for_the_last_digit() -> None:
    y, x = (v.astype(np.float32) for v in _points(300_000))
    exact = np.arctan2(y.astype(np.float64), x.astype(np.float64))
    off = np.abs(_all_32(y, x) - exact) / np.spacing(np.maximum(np.abs(exact), 1e-30).astype(np.float32))
    assert off.max() < 1.5


def test_a_float64_azimuth_is_the_c_librarys_or_the_number_beside_it() -> None:
    y, x = _points(300_000)
    exact = np.arctan2(y, x)
    assert (np.abs(_all_64(y, x) - exact) <= 1.01 * np.spacing(np.abs(exact))).all()


@pytest.mark.parametrize("y", [0.0, -0.0, 2.0, -2.0, 1e-30])
@pytest.mark.parametrize("x", [0.0, -0.0, 1.0, -1.0, 1e30, -1e30])
def test_on_the_axes_and_at_the_origin_signs_of_zero_count(y: float, x: float) -> None:
    one_32 = _all_32(np.array([y], np.float32), np.array([x], np.float32))[0]
    one_64 = _all_64(np.array([y]), np.array([x]))[0]
    exact = math.atan2(y, x)
    assert one_64 == pytest.approx(exact, rel=1e-15, abs=0.0)
    assert one_32 == np.float32(exact) or abs(exact) < 1e-37
    assert math.copysign(1.0, one_64) == math.copysign(1.0, one_32) == math.copysign(1.0, exact)
