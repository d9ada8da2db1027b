"""Compiled kernels, kept on disk until the source of any of them changes.

Numba forgets kept machine code when the file of its function changes, but not when the function
of another file changes that was built into it. Here all kernels are forgotten together.
"""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

THIS_FILE = Path(__file__)
PACKAGE = THIS_FILE.parents[1]
MARK = b"\nfrom robocal_ros.core.compiled import "  # how a module that has kernels is known


def kernel(function: Function) -> Function:
    """Decorator: compile with numba, without the interpreter's lock, and keep the machine code.

    What a kernel uses of ours, functions and constants, lies in modules that have kernels.
    """
    return _compiled(function, "never")


def lean(function: Function) -> Function:
    """Decorator: as `kernel`, for a small function that makes no array, only parts of given ones.

    Its machine code goes into each caller's, and no references are counted in it: both would take
    longer than its work.
    """
    return _compiled(function, "never", lean=True)


def inlined(function: Function) -> Function:
    """Decorator: as `kernel`, but the body is put into each kernel that calls it."""
    return _compiled(function, "always")


def _compiled(
    function: Function, inline: Literal["never", "always"], lean: bool = False
) -> Function:
    options: dict[str, Any] = {"inline": inline, "forceinline": lean, "_nrt": not lean}
    compiler: Any = numba.njit(cache=True, nogil=True, error_model="numpy", **options)
    made = compiler(function)
    if made is not function:  # as it is with NUMBA_DISABLE_JIT
        # Kept code is valid while this equals what stands beside it; numba puts the file's age.
        made._cache._cache_file._source_stamp = _digest_of_sources()
    return cast(Function, made)


@cache
def _digest_of_sources() -> str:
    """Digest of this file and of all modules of the package that have kernels."""
    digest = hashlib.sha256(THIS_FILE.read_bytes())
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_bytes()
        if MARK in text:
            digest.update(f"\0{path.relative_to(PACKAGE)}\0".encode() + text)
    return digest.hexdigest()
