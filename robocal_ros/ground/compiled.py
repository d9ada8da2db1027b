# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels, kept on disk until the source of any of them changes.

Numba forgets kept machine code when the file of its function changes, but not when the function
of another file changes that was built into it. Here all kernels are forgotten together.

Kept code is written to the first of these that can be written: ``NUMBA_CACHE_DIR``, ``__pycache__``
beside the source, the user's cache folder, a private folder in the temporary one. It is read from
there and from ``__pycache__``, which may be read-only: what was compiled at the installation serves
every user. Where nothing can be written or read, kernels are compiled at each start.
"""

import hashlib
import inspect
import os
import stat
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import llvmlite.binding as untyped_llvm
import numba
from numba.core import caching as untyped
from numba.core import event as untyped_event

Function = TypeVar("Function", bound=Callable[..., Any])

caching: Any = untyped  # numba is typed here and there
llvm: Any = untyped_llvm
events: Any = untyped_event
# LLVM works on several points of a loop at a time where it can compare where the arrays in it lie.
# It takes so many places in one array as one, else a hundred: `six_axis` has more.
llvm.set_option("", "-memory-check-merge-threshold=1000")
THIS_FILE = Path(__file__)
PACKAGE = THIS_FILE.parents[1]
MARK = b"\nfrom robocal_ros.ground.compiled import "  # how a module that has kernels is known


def kernel(function: Function) -> Function:
    """Decorator: compile with numba, without the interpreter's lock, and keep the machine code.

    There is one machine code of it, which other kernels call. What a kernel uses of ours, functions
    and constants, lies in modules that have kernels.
    """
    return _compiled(function, "never")


def bare(function: Function) -> Function:
    """Decorator: as `kernel`, for a function that makes no array, only parts of given ones.

    No references are counted in it, which would take longer than its work.
    """
    return _compiled(function, "never", counts=False)


def lean(function: Function) -> Function:
    """Decorator: as `bare`, for a small function, or one that is called at one place.

    It is compiled again into each caller: of a large one that takes the compiler long.
    """
    return _compiled(function, "never", counts=False, is_part=True)


def inlined(function: Function) -> Function:
    """Decorator: as `kernel`, but the body is put into each kernel that calls it."""
    return _compiled(function, "always")


def _compiled(
    function: Function,
    inline: Literal["never", "always"],
    counts: bool = True,
    is_part: bool = False,
) -> Function:
    options: dict[str, Any] = {"inline": inline, "forceinline": is_part, "_nrt": counts}
    compiler: Any = numba.njit(nogil=True, error_model="numpy", **options)
    made = compiler(function)
    if made is not function:  # as it is with NUMBA_DISABLE_JIT
        made._cache = _KeptCode(function, is_part)
    return cast(Function, made)


@contextmanager
def compiling(tell: Callable[[str], None]) -> Iterator[None]:
    """Tell the name of each kernel that is compiled meanwhile; none that is loaded."""

    class Listener(events.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            function = event.data["dispatcher"].py_func
            if function.__module__.startswith("robocal_ros."):  # else numba's own
                tell(function.__name__)

        def on_end(self, event: Any) -> None:
            pass

    with events.install_listener("numba:compile", Listener()):
        yield


def is_cold() -> bool:
    """Whether no kernel that was loaded so far has kept machine code: the first call compiles."""
    return bool(_made) and not any(kept.is_there() for kept in _made)


def _private_folder() -> Path:
    """A folder of this user alone, since code that is read from it is run.

    Raises
    ------
    OSError
        When there is none.
    """
    folder = Path(tempfile.gettempdir()) / f"robocal_kernels_{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    state = folder.lstat()
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != os.getuid() or state.st_mode & 0o077:
        raise PermissionError(f"{folder} is not this user's alone")
    return folder


class _LastLocator(caching._CacheLocator):  # type: ignore[misc]
    """A place for kept code where neither source folder nor home can be written.

    The temporary folder; where that cannot be written either, the source's, to be read only.
    """

    def __init__(self, function: Any, file: str) -> None:
        self._lineno = function.__code__.co_firstlineno
        try:
            self._path = _private_folder() / self.get_suitable_cache_subpath(file)
            self.ensure_cache_path()
        except OSError:
            self._path = Path(file).parent / "__pycache__"

    def get_cache_path(self) -> str:
        return str(self._path)

    def get_source_stamp(self) -> str:
        return _digest_of_sources()

    def get_disambiguator(self) -> str:
        return str(self._lineno)

    @classmethod
    def from_function(cls, function: Any, file: str) -> "_LastLocator":
        return cls(function, file)


class _Places(caching.CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (*caching.CompileResultCacheImpl._locator_classes, _LastLocator)

    def reduce(self, cres: Any) -> Any:
        """Keep with it of which kernels it calls the code."""
        declared = (f.name for f in cres.library._final_module.functions if f.is_declaration)
        called = [(symbol, *_called[symbol]) for symbol in declared if symbol in _called]
        return called, super().reduce(cres)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Rebuild kept code behind that of the kernels that it calls.

        Its bitcode is read when a kernel is built from it: of the start of a node that reading is
        half a second, and no node builds kernels.
        """
        called, ((name, kind, (code, bitcode)), described, *rest) = payload
        engine = target_context.codegen()._engine
        for symbol, module, function, sig in called:
            getattr(import_module(module), function).compile(sig)
            if symbol not in engine._defined_symbols:  # LLVM would end the process
                raise LookupError(f"{function} was compiled anew, and so must be what calls it")
        engine._defined_symbols |= {
            described.llvm_func_name,
            described.llvm_cpython_wrapper_name,
            described.env_name,
        }
        kept = (name, kind, (code, _nothing().as_bitcode()))
        found = super().rebuild(target_context, (kept, described, *rest))
        found.library._get_module_for_linking = cache(lambda: _parsed(engine, bitcode))
        return found


@cache
def _nothing() -> Any:
    return llvm.parse_assembly("")


def _parsed(engine: Any, bitcode: bytes) -> Any:
    module = llvm.parse_bitcode(bitcode)
    engine._load_defined_symbols(module)
    return module


class _KeptCode(caching.FunctionCache):  # type: ignore[misc]
    """Kept machine code of one kernel, read beside the source too.

    It is valid while the digest of the sources equals what stands in it; numba puts that of one
    file. Whatever is wrong with it, a kernel can be called.
    """

    _impl_class = _Places
    _cache_file: Any

    def __init__(self, function: Any, is_part: bool) -> None:
        super().__init__(function)
        self._is_part, self._where = is_part, (function.__module__, function.__name__)
        own, digest = self._cache_file, _digest_of_sources()
        own._source_stamp = digest
        beside = str(Path(inspect.getfile(function)).parent / "__pycache__")
        shipped = caching.IndexDataCacheFile(beside, self._impl.filename_base, digest)
        self._files = [own] if beside == self._cache_path else [shipped, own]
        _made.append(self)

    def is_there(self) -> bool:
        """Whether there is code of this source."""
        return any(_index(file) for file in self._files)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load what is kept; a file that a power cut left in pieces counts as none."""
        for file in self._files:  # the last one is what is written to
            self._cache_file = file
            try:
                found = super().load_overload(sig, target_context)
            except Exception:
                continue
            if found is not None:
                self._offer(sig, found)
                return found
        return None

    def _offer(self, sig: Any, made: Any) -> None:
        """Let callers call this code, where nothing is built into them."""
        if not self._is_part:
            made.library._shared_module = _nothing()
            _called[made.fndesc.llvm_func_name] = (*self._where, sig)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled, where that is possible."""
        self._offer(sig, data)
        self._cache_file = self._files[-1]
        try:
            if not _index(self._cache_file):
                self.flush()  # also over an index in pieces
            super().save_overload(sig, data)
        except Exception as error:
            if not _warned:
                _warned.append(
                    f"the machine code of kernels cannot be kept in {self._cache_path} ({error}): "
                    "each start compiles; set NUMBA_CACHE_DIR to a folder that can be written"
                )
                warnings.warn(_warned[0], RuntimeWarning, stacklevel=2)


_made: list[_KeptCode] = []
_called: dict[str, tuple[str, str, Any]] = {}  # by symbol: module, function, types of arguments
_warned: list[str] = []


def _index(file: Any) -> Any:
    """Index of kept code, empty where there is none that can be read."""
    try:
        return file._load_index()
    except Exception:
        return {}


@cache
def _digest_of_sources() -> str:
    """Digest of this file and of all modules of the package that have kernels."""
    digest = hashlib.sha256(THIS_FILE.read_bytes())
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_bytes()
        if MARK in text:
            digest.update(f"\0{path.relative_to(PACKAGE)}\0".encode() + text)
    return digest.hexdigest()
