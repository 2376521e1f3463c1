"""The decorator of kernels, and the place of their compiled code.

numba keeps compiled code beside a function's file, and uses it until that file changes. It does not look into the
other files from which the kernel takes functions and constants. After an upgrade, a commit or an edit of those, it
would run the old code. Here compiled code belongs to the content of the kernel's module and of all modules that it
imports, to the versions of libraries, and to the Python (`digest_of`). All other changes leave it: a page of the
documentation, another module, another folder of the checkout.

The code is kept in one folder of the user (`kept_in`). Processes, checkouts and installations share it.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import importlib.metadata
import os
import pickle
import re
import shutil
import stat
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, NamedTuple

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

PACKAGES = ("coupole", "drivers", "sim")
"""Packages whose modules are followed wherever they are imported."""
LIBRARIES = ("llvmlite", "numba", "numpy", "scipy")
"""Libraries that compile kernels, or compute constants that are compiled into them."""
UNUSED_S = 30 * 86400.0
"""Code that nobody used for this time is removed when other code of the same module is kept."""
_LOCKED_S = 2.0
"""Longest wait for another process that keeps code in the same folder. It may have been stopped meanwhile."""
_DAY_S = 86400.0
_ROOT = Path(__file__).parent.parent.parent
_IMPORT = re.compile(r"^(?:from ([\w.]+) import (\([^)]*\)|[^\n]*)|import ([^\n]+))", re.MULTILINE)
_COMMENT = re.compile(r"#[^\n]*")


def kernel(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Decorate a kernel: numba compiles it, without Python's lock, and its code is kept.

    `options` are the options of `numba.njit`, such as `parallel=True`. Constants of modules are compiled into the
    code. They must not depend on anything but modules that are imported: no files, environment or time.
    """
    if function is None:
        return functools.partial(kernel, **options)
    dispatcher: Any = numba.njit(nogil=True, **options)(function)
    if dispatcher is not function:  # as where numba is switched off (NUMBA_DISABLE_JIT)
        dispatcher._cache = _KernelCache(function)  # type: ignore[no-untyped-call]
    return dispatcher


# -- what the code belongs to -----------------------------------------------------------------------------


@functools.cache
def digest_of(file: Path) -> str:
    """Digest of the content on which the code of a module's kernels depends, as 32 hexadecimal digits. The
    content is the module's file, the files of all modules of ours that it imports at its top (directly or through
    other modules), the versions of `LIBRARIES`, and the version of Python. The place of the files does not count.
    """
    scripts = None if _is_ours(file) else str(file.parent)
    contents = {file.name if scripts else str(file.relative_to(_ROOT)): _content(str(file))}
    waiting = [*contents.values()]
    while waiting:
        for name in waiting.pop().imports:
            for file_name, path in _files_of(name, scripts):
                if file_name not in contents:
                    contents[file_name] = _content(path)
                    waiting.append(contents[file_name])
    lines = [*_versions(), *(f"{name} {contents[name].digest}" for name in sorted(contents))]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:32]


def imported_names(source: str) -> Iterator[str]:
    """Dotted names of the modules that a module imports at its top, and of the names that it imports from them."""
    for module, names, modules in _IMPORT.findall(source):
        name_list = names.strip("()") or modules
        for name in (_COMMENT.sub("", name_list) if "#" in name_list else name_list).split(","):
            if words := name.split():
                yield f"{module}.{words[0]}" if module else words[0]


@functools.cache
def _versions() -> tuple[str, ...]:
    libraries = (f"{library} {importlib.metadata.version(library)}" for library in LIBRARIES)
    return (str(sys.implementation.cache_tag), *libraries)


class _Content(NamedTuple):
    digest: str
    imports: tuple[str, ...]


@functools.cache
def _content(file: str) -> _Content:
    with open(file, "rb") as stream:  # noqa: PTH123  pathlib takes half of the time, for hundreds of files
        data = stream.read()
    return _Content(hashlib.sha256(data).hexdigest(), tuple(imported_names(data.decode())))


@functools.cache
def _files_of(name: str, scripts: str | None) -> tuple[tuple[str, str], ...]:
    """The files that Python runs to import a dotted name, if the name is one of ours or of the folder `scripts`.
    Each has its name without the folder, and its path.
    """
    if name.partition(".")[0] in PACKAGES:
        folder = str(_ROOT)
    elif scripts is None:
        return ()
    else:
        folder = scripts
    parent, _, last = name.rpartition(".")
    stem = "/".join((*parent.split("."), last)) if parent else last
    files = [file for file in (f"{stem}.py", f"{stem}/__init__.py") if os.path.isfile(f"{folder}/{file}")]  # noqa: PTH113
    return (*(_files_of(parent, scripts) if parent else ()), *((file, f"{folder}/{file}") for file in files))


def _is_ours(file: Path) -> bool:
    return file.is_relative_to(_ROOT) and file.relative_to(_ROOT).parts[0] in PACKAGES


# -- where it is kept -------------------------------------------------------------------------------------


@functools.cache
def kept_in() -> Path:
    """The folder of compiled code: that of NUMBA_CACHE_DIR; otherwise `coupole/kernels` in the user's cache; or,
    if no home can be written, a folder of this user among the temporary files. Code is loaded from this folder.
    Therefore a folder that others can write, or that somebody else has made, is not used. A new folder is then
    made for this process alone.
    """
    if folder := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(folder)
    xdg_cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    caches = xdg_cache if xdg_cache.is_absolute() else Path(os.path.expanduser("~/.cache"))  # noqa: PTH111  without a home: as it is
    for place in (caches / "coupole" / "kernels", Path(tempfile.gettempdir()) / f"coupole-kernels-{os.getuid()}"):
        if place.is_absolute() and _is_own(place):
            return place
    return Path(tempfile.mkdtemp(prefix="coupole-kernels-"))


def _is_own(place: Path) -> bool:
    """Make the folder if it is missing; tell whether it belongs to this user alone and can be written."""
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.mkdir(mode=0o700, exist_ok=True)
        state = place.lstat()
        tempfile.TemporaryFile(dir=place).close()
    except OSError:
        return False
    return stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o077


def _note_use(folder: Path) -> None:
    """Give a folder the time of this use, once a day."""
    with suppress(OSError):
        if time.time() - folder.stat().st_mtime > _DAY_S:
            os.utime(folder)


def _remove_unused(module: str) -> None:
    """Remove folders of a module's code that nobody used lately."""
    for folder in kept_in().glob(f"{module}-*"):
        with suppress(OSError):
            if time.time() - folder.stat().st_mtime > UNUSED_S:
                shutil.rmtree(folder)


def _lock(lock: IO[str]) -> None:
    """Take the lock of a folder of code. Raises TimeoutError if another process holds it for too long."""
    give_up_s = time.monotonic() + _LOCKED_S
    while True:
        try:
            return fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > give_up_s:
                raise TimeoutError(f"another process holds {lock.name}") from None
            time.sleep(0.01)


# -- numba's side -----------------------------------------------------------------------------------------


class _ByContent(_CacheLocator):
    """The place of a function's code: a folder for each content of its module."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file  # of numba's warnings
        self._line = function.__code__.co_firstlineno
        self._digest = digest_of(Path(file).resolve())
        self._place = kept_in() / f"{function.__module__}-{self._digest}"
        _note_use(self._place)

    def get_cache_path(self) -> str:
        return str(self._place)

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _ByContent:
        return cls(function, file)


class _KernelCacheImpl(CompileResultCacheImpl):
    _locator_classes: list[type[object]] = [_ByContent]  # noqa: RUF012  numba's own


class _KernelCache(FunctionCache):
    """numba's cache of one function. Processes that keep code at the same time do not take each other's names of
    files; a file that is broken is compiled again; a disk that is full keeps nothing and stops nobody."""

    _impl_class = _KernelCacheImpl

    def _load_overload(self, signature: Any, target_context: Any) -> Any:
        try:
            return super()._load_overload(signature, target_context)  # type: ignore[no-untyped-call]
        except (OSError, EOFError, pickle.UnpicklingError):
            with suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]
            return None

    def _save_overload(self, signature: Any, code: Any) -> None:
        folder = Path(self.cache_path)
        try:
            if not folder.exists():
                _remove_unused(folder.name.rpartition("-")[0])
            folder.mkdir(parents=True, exist_ok=True)
            with (folder / "lock").open("w") as lock:
                _lock(lock)
                super()._save_overload(signature, code)  # type: ignore[no-untyped-call]
        except OSError as error:
            warnings.warn(f"compiled code is not kept: {error}", RuntimeWarning, stacklevel=2)
