"""Compiled kernels: `numba.njit` with a cache on disk that no edit of a source file can make stale.

numba's own cache looks at the file of the called function only, not at the functions and constants that it takes from
other files. Here the code of a kernel is kept in a folder named by a hash of its source file and of all project files
that this one imports, directly or not. The folder lies in the user's cache: an installation may be read-only, and two
checkouts with the same sources share it. The module imports no other one of the project, so every package can use it.
"""

from __future__ import annotations

import os
import re
import shutil
import uuid
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, overload

import llvmlite.binding
import numba
import platformdirs
from numba.core import codegen, config

_ROOT = Path(__file__).parents[1]
_HOST_AND_START = uuid.uuid4().hex[:8]  # with the process number, which a fork changes
_VERSIONS_KEPT = 8  #: of each module; those of the least recent processes are removed

# `from .a.b import c, d`, also with its names in brackets over several lines, and `import a.b`
_IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+(\.*)([\w.]*)[ \t]+)?import[ \t]+(\([^)]*\)|[^\n]+)", re.MULTILINE)
_NAME = re.compile(r"[\w.]+")


Function = TypeVar("Function", bound=Callable[..., Any])


@overload
def kernel(function: Function, /) -> Function: ...
@overload
def kernel(*, allocates: bool = True, **options: Any) -> Callable[[Function], Function]: ...
def kernel(function: Any = None, /, **options: Any) -> Any:
    """Compiles a function with `numba.njit` (its `options`) without the interpreter's lock; keeps the code on disk.

    A function that `allocates` no arrays does not count references, which take longer than the work of a short one.
    """
    if function is None:
        return lambda decorated: kernel(decorated, **options)
    options["_nrt"] = options.pop("allocates", True)
    dispatcher: Any = numba.njit(nogil=True, **options)(function)
    if cache_folder(Path(function.__code__.co_filename).resolve(), function.__module__) is not None:
        _enable_caching(dispatcher)
    return dispatcher


class _KeptLibrary(codegen.JITCodeLibrary):
    """Machine code from disk. numba also reads the code in its intermediate form, which takes more memory and time.

    Here that is read when another function is compiled with this one: a survey of 70 kernels needs 90 MB less.
    """

    _intermediate: Any = None

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        name, kind, data = state
        if kind != "object":
            return super()._unserialize(codegen, state)
        library = cls(codegen, name)
        library.enable_object_caching()
        library._set_compiled_object(data[0])
        library._finalize_final_module()
        library._intermediate = data[1]
        return library

    def get_pointer_to_function(self, name: str) -> int:
        if self._intermediate is None:
            return super().get_pointer_to_function(name)
        return self._codegen._engine.get_function_address(name)

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None and self._intermediate is not None:
            self._shared_module = llvmlite.binding.parse_bitcode(self._intermediate)
        return super()._get_module_for_linking()


codegen.JITCPUCodegen._library_class = _KeptLibrary


class KernelLocator:
    """Tells numba where a function's machine code is kept (its interface of `NUMBA_CACHE_LOCATOR_CLASSES`)."""

    def __init__(self, folder: Path, first_line: int):
        self._folder, self._first_line = folder, first_line

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> KernelLocator | None:
        folder = cache_folder(Path(file).resolve(), function.__module__)
        return cls(folder, function.__code__.co_firstlineno) if folder is not None else None

    def ensure_cache_path(self) -> None:
        """Makes the folder again if it was removed since."""
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Returns the hash of the sources, which numba compares with that of the kept code."""
        return self._folder.name

    def get_disambiguator(self) -> str:
        """Returns the function's first line, which tells functions of one name apart."""
        return str(self._first_line)


def cache_root() -> Path:
    """Returns the folder of all compiled code: `NUMBA_CACHE_DIR` if set, else in the user's cache folder."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("seabed-twin", appauthor=False)) / "kernels"


def source_hash(file: Path) -> str:
    """Returns a hash of a source file, of all project files that it imports, of numba and of the processor."""
    sources = (path.read_bytes() for path in sorted(_reachable(file)))
    compiler = f"{numba.__version__} {llvmlite.__version__} {_processor()}".encode()
    return sha256(b"\0".join((compiler, *sources))).hexdigest()[:16]


@cache
def cache_folder(file: Path, name: str) -> Path | None:
    """Returns the folder of a module's code, whose name may differ between checkouts; None if none can be written.

    Other results of the module that its sources and their arguments determine may be kept there too.
    """
    module = cache_root() / name
    folder = module / source_hash(file)
    try:
        is_new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except OSError:
        return None
    if not os.access(folder, os.W_OK):
        return None
    if is_new:
        _prune(module)
    return folder


def has_code(module: str) -> bool:
    """Returns whether compiled code of a module of the project is kept on disk."""
    folder = cache_folder(file, module) if (file := _file_of(module)) else None
    return folder is not None and any(folder.glob("*.nbc"))


def _module_name(file: Path) -> str:
    """Returns the dotted name of a module of the project, or the file's name for one outside of it."""
    inside = file.is_relative_to(_ROOT)
    return ".".join(file.relative_to(_ROOT).with_suffix("").parts) if inside else file.stem


def _prune(module: Path) -> None:
    versions = sorted(module.iterdir(), key=_last_use, reverse=True)
    for old in versions[_VERSIONS_KEPT:]:
        shutil.rmtree(old, ignore_errors=True)


def _last_use(folder: Path) -> float:
    try:
        return folder.stat().st_mtime
    except FileNotFoundError:  # another process has just removed it
        return 0.0


def _enable_caching(dispatcher: Any) -> None:
    """Sets `KernelLocator` for this function alone; numba's setting is one for all packages of the process."""
    before = config.CACHE_LOCATOR_CLASSES  # pyright: ignore[reportAttributeAccessIssue]
    config.CACHE_LOCATOR_CLASSES = f"{__name__}.{KernelLocator.__name__}"  # pyright: ignore[reportAttributeAccessIssue]
    try:
        dispatcher.enable_caching()
        _use_own_file_names(dispatcher)
    finally:
        config.CACHE_LOCATOR_CLASSES = before  # pyright: ignore[reportAttributeAccessIssue]


def _use_own_file_names(dispatcher: Any) -> None:
    """Puts a name of this process into the names of its files of machine code.

    numba numbers the files of a function. Two processes that compile it at once for different types of arguments would
    write the same file, and later load code for the wrong types. Names of their own cost an entry of the index at most.
    """
    file = dispatcher._cache._cache_file
    name = file._data_name_pattern.replace("{number:d}", "{process}.{number:d}")
    file._data_name = lambda number: name.format(process=f"{_HOST_AND_START}-{os.getpid()}", number=number)


def _reachable(file: Path) -> set[Path]:
    found, waiting = {file}, [file]
    while waiting:
        for imported in _imports(waiting.pop()) - found:
            found.add(imported)
            waiting.append(imported)
    return found


@cache
def _imports(file: Path) -> frozenset[Path]:
    names: set[str] = set()
    for dots, module, imported in _IMPORT.findall(file.read_text(encoding="utf-8")):
        inside = _module_name(file.parents[len(dots) - 1] / "__init__.py").removesuffix("__init__") if dots else ""
        package = inside + module
        names |= {package, *(f"{package}.{name}".lstrip(".") for name in _NAME.findall(imported))}
    return frozenset(path for name in names if (path := _file_of(name)) is not None)


@cache
def _file_of(name: str) -> Path | None:
    path = _ROOT.joinpath(*name.split("."))
    candidates = (path.with_name(path.name + ".py"), path / "__init__.py")
    return next((candidate for candidate in candidates if candidate.is_file()), None)


@cache
def _processor() -> str:
    return f"{llvmlite.binding.get_host_cpu_name()} {llvmlite.binding.get_host_cpu_features().flatten()}"
