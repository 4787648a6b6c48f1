"""How loops over points and cells are compiled (docs/measurements/speed.md has what it costs).

A division by zero gives infinity or NaN, as in numpy: without the branch to an exception loops vectorise and compile
sooner. C code never calls a kernel, so the wrapper for C is left out: 10 ms of 80 for the smallest kernel. Most kernels
get the arrays that they fill: an allocation takes 50 ms to compile, and without any the code that counts references
(numba's run time, NRT) is left out: a seventh of all that is compiled.
"""

from __future__ import annotations

import numba

_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "no_rewrites": True}

kernel = numba.njit(**_OPTIONS, _nrt=False)
"""A loop that Python calls, and that allocates nothing. Its compiled form is kept on disk."""
fast_math = numba.njit(**_OPTIONS, _nrt=False, fastmath=True)
"""A kernel in which sums may be taken in any order, so that they vectorise."""
allocating = numba.njit(**_OPTIONS)
"""A kernel that allocates arrays."""
inlined = numba.njit(inline="always", error_model="numpy")
"""A part of kernels, typed and compiled inside each of them."""
