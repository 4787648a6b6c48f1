"""How loops over points and cells are compiled (docs/measurements/speed.md has what it costs).

A division by zero gives infinity or NaN, as in numpy: without the branch to an exception loops vectorise and compile
sooner. C code never calls a kernel, so the wrapper for C is left out: 10 ms of 80 for the smallest kernel. Most kernels
get the arrays that they fill: an allocation takes 50 ms to compile, and without any the code that counts references
(numba's run time, NRT) is left out: a seventh of all that is compiled.

Compiled kernels are kept on disk. numba compiles a kernel again if its own file has changed. The cache below also does
so if this file, or a kernel or a constant of another one has changed, and if an entry cannot be read: it names a type
that was renamed since, or a power failure cut it off.

numba keeps them beside the program, else in the user's cache, and else refuses to import them at all. A container with
a read-only image and a user without a home has neither: there they stay in the temporary folder.
"""

from __future__ import annotations

import inspect
import os
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler import Compiler
from numba.core.registry import cpu_target
from numba.extending import intrinsic

_VARIABLE = "NUMBA_CACHE_DIR"


def choose_kernel_cache() -> None:
    """Name a folder of this user's in the temporary one, where nothing else can be written to."""
    users = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    if os.environ.get(_VARIABLE) or _may_write(Path(__file__).parent) or _may_write(users):
        return
    os.environ[_VARIABLE] = folder = _private_folder()
    numba.config.CACHE_DIR = folder  # numba has read its variables already


def _may_write(folder: Path) -> bool:
    """Whether this folder, or the nearest above it that exists, can be written to."""
    existing = next((f for f in (folder, *folder.parents) if f.is_dir()), None)
    return existing is not None and os.access(existing, os.W_OK | os.X_OK)


def _private_folder() -> str:
    """The same one at each start; one for this process alone if others may have put kernels there, for they are run."""
    within = Path(tempfile.gettempdir())
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = within / f"mapvote-kernels-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if stat.S_ISDIR(found.st_mode) and found.st_uid == user and not found.st_mode & 0o022:
        return str(folder)
    return tempfile.mkdtemp(prefix="mapvote-kernels-", dir=within)


choose_kernel_cache()
_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "no_rewrites": True}


class _Progress(event.Listener):  # type: ignore[misc]
    """Hears each step of numba's compiler."""

    def __init__(self, call: Callable[[], object]) -> None:
        self._call = call

    def on_start(self, event: Any) -> None:
        self._call()

    def on_end(self, event: Any) -> None:
        self._call()


def call_while_compiling(call: Callable[[], object]) -> None:
    """Call ``call`` at each step of the compiler from now on: some times a second while a kernel is compiled."""
    event.register("numba:run_pass", _Progress(call))


class _Index(IndexDataCacheFile):  # type: ignore[misc]
    """The entries of one kernel. They hold for the kernel's file and for all that the kernel takes from other files."""

    def __init__(self, function: FunctionType, path: str, name: str, file_stamp: object) -> None:
        super().__init__(path, name, file_stamp)
        self._function = function
        self._file_stamp = file_stamp

    def _load_index(self) -> dict[Any, str]:
        # Only at a call: what a kernel calls may be declared after it.
        self._source_stamp = (self._file_stamp, *_compiled_into(self._function, set()))
        try:
            return super()._load_index()
        except Exception:  # whatever unpickling raises: the kernel is compiled again and the entry overwritten
            return {}

    def _load_data(self, name: str) -> Any:
        try:
            return super()._load_data(name)
        except Exception as error:
            raise OSError(f"{name}: {error}") from error  # which numba takes as absent


@cache
def _stamp_of_this_file() -> tuple[int, int]:
    """It says how kernels are compiled."""
    own = Path(__file__).stat()
    return own.st_mtime_ns, own.st_size


class _Cache(FunctionCache):  # type: ignore[misc]
    def __init__(self, function: FunctionType, allocates: bool) -> None:
        super().__init__(function)
        self._allocates = allocates
        stamp = self._impl.locator.get_source_stamp(), _stamp_of_this_file()
        self._cache_file = _Index(function, self.cache_path, self._impl.filename_base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        # numba makes its compiler ready even for a kernel that is kept: it compiles its run time, which only code that
        # allocates calls, and imports all that a kernel may call, scipy's BLAS too. That takes .5 s and 48 MB.
        if self._allocates:
            return super().load_overload(sig, target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def _index_key(self, sig: Any, codegen: Any) -> tuple[object, ...]:
        # numba compares named tuples by class and types. Fields that changed places would go unnoticed.
        return (*super()._index_key(sig, codegen), tuple(getattr(kind, "fields", None) for kind in sig))


def _compiled_into(function: FunctionType, seen: set[FunctionType]) -> Iterator[str | bytes]:
    """The code and the constants of a kernel and of all kernels that it calls, equal in every process."""
    seen.add(function)
    code = function.__code__
    names = inspect.getclosurevars(function)
    yield repr((code.co_code, code.co_consts, code.co_names, code.co_varnames))
    for name, value in sorted({**names.globals, **names.nonlocals}.items()):
        called = getattr(value, "py_func", None)
        if called is None and not isinstance(value, ModuleType):
            constant = value.tobytes() if isinstance(value, np.ndarray) else value
            yield repr((name, constant, getattr(value, "_fields", None)))
        elif called is not None and called not in seen:
            yield from _compiled_into(called, seen)


class _Disjoint(Compiler):  # type: ignore[misc]
    """numba's compiler, told that no argument overlaps another."""

    def __init__(self, *function_and_types: Any) -> None:
        super().__init__(*function_and_types)
        self.state.flags.noalias = True


def _kept(**options: object) -> Callable[[Any], Any]:
    """A decorator that compiles with these options and keeps the compiled form on disk."""
    compiled = numba.njit(**_OPTIONS, **options)

    def declare(function: FunctionType) -> Any:
        dispatcher = compiled(function)
        allocates = options.get("_nrt", True) is True
        dispatcher._cache = _Cache(function, allocates)  # as enable_caching() does with numba's own
        return dispatcher

    return declare


def cached_for(kernel: Any) -> tuple[Path, str]:
    """The folder that holds a compiled kernel, and the numba, the Python and the processor that it was compiled for."""
    target = cpu_target.target_context.codegen().magic_tuple()
    return Path(kernel._cache.cache_path), repr((numba.__version__, sys.version, target))


kernel = _kept(_nrt=False)
"""A loop that Python calls, and that allocates nothing."""
fast_math = _kept(_nrt=False, fastmath=True)
"""A kernel in which sums may be taken in any order, so that they vectorise."""
allocating = _kept()
"""A kernel that allocates arrays."""
inlined = numba.njit(inline="always", error_model="numpy")
"""A part of kernels, typed and compiled inside each of them."""


def disjoint(function: Callable[..., Any]) -> Any:
    """A kernel of which no array overlaps another, so that loops which read anywhere and write vectorise."""
    return _kept(_nrt=False, pipeline_class=_Disjoint)(function)


@intrinsic
def one_bit(context: Any, place: Any) -> Any:
    """uint32 with the bit at ``place`` (int32), 0 where that is not 0 to 31: one instruction in a loop that vectorises.

    numba's own shift has 64 bits, half as many in a vector, and leaves open what a place outside the word gives.
    """

    def built(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        (at,) = values
        within = builder.icmp_unsigned("<", at, at.type(32))
        return builder.select(within, builder.shl(at.type(1), at), at.type(0))

    return numba.uint32(numba.int32), built


@intrinsic
def whole_along(context: Any, slope: Any, way: Any, start: Any) -> Any:
    """int32 nearest to ``start`` + ``slope`` ``way`` (float32, up to 4e6 either way), counted from that of 0, 0, 0.

    An addition leaves the whole number in the last bits of the sum. Floor and conversion take three times as long in a
    loop that vectorises.
    """

    def built(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        slope, way, start = values
        kind = ir.FunctionType(start.type, [start.type] * 3)
        fused = builder.module.declare_intrinsic("llvm.fmuladd", [start.type], kind)  # one rounding or two
        place = builder.call(fused, [slope, way, start])
        shifted = builder.fadd(place, place.type(1.5 * 2**23))
        return builder.bitcast(shifted, context.get_value_type(numba.int32))

    return numba.int32(numba.float32, numba.float32, numba.float32), built


@intrinsic
def two_at(context: Any, values: Any, place: Any) -> Any:
    """int32 of two neighbours in ``values`` (uint16), the one at ``place`` (int64) in the lower half: processors gather
    no 16 bits, and 32 take no longer."""

    def built(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, given[0])
        first = builder.gep(array.data, [given[1]])
        both = builder.bitcast(first, context.get_value_type(numba.int32).as_pointer())
        return builder.load(both, align=2)

    return numba.int32(values, numba.int64), built
