"""Compiled code of kernels: it is used again for the same content only, in any folder, and by this user alone."""

from __future__ import annotations

import ast
import fcntl
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from places import REPO

from coupole.kernels.kept_code import PACKAGES, UNUSED_S, digest_of, imported_names, kept_in

BASE = "FACTOR = 2.0\n"
HELPER = """
from base import (
    FACTOR,  # of (all)
)
from coupole.kernels import kernel

@kernel
def scaled(x):
    return x * FACTOR
"""
KERNELS = """
import helper as beside
from coupole.kernels import kernel

scaled = beside.scaled

@kernel
def work(x):
    return scaled(x) + 1.0

if __name__ == "__main__":
    print(work(10.0), sum(work.stats.cache_hits.values()))
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with a kernel that takes a constant by two steps, and an unrelated module."""
    return made(tmp_path / "checkout")


def made(folder: Path) -> Path:
    folder.mkdir()
    for name, text in {"base": BASE, "helper": HELPER, "script": KERNELS, "unrelated": "A = 1\n"}.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def surroundings(**more: str) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    return {**kept, "PYTHONPATH": str(REPO), "PYTHONDONTWRITEBYTECODE": "1", **more}


def started(checkout: Path, timeout: float | None = None) -> subprocess.CompletedProcess[str]:
    place = surroundings(NUMBA_CACHE_DIR=str(checkout.parent / "cache"))
    command = [sys.executable, "script.py"]
    return subprocess.run(
        command, cwd=checkout, env=place, capture_output=True, text=True, check=True, timeout=timeout
    )


def run(checkout: Path) -> str:
    """What the kernel computes, and how often its code was there already."""
    ended = started(checkout)
    assert ended.stderr == ""
    return ended.stdout.strip()


def folders_of_code(checkout: Path) -> dict[str, Path]:
    """The newest folder of code of each module."""
    folders = sorted((checkout.parent / "cache").iterdir(), key=lambda folder: folder.stat().st_mtime)
    return {folder.name.rpartition("-")[0]: folder for folder in folders}


def set_unused(folder: Path, days: float) -> None:
    used_s = time.time() - days * 86400.0
    os.utime(folder, (used_s, used_s))


def test_code_is_used_again_here_and_in_a_copy_also_after_unrelated_changes(checkout: Path) -> None:
    assert run(checkout) == "21.0 0"
    (checkout / "unrelated.py").write_text("A = 2\n")
    set_unused(folders_of_code(checkout)["helper"], 40.0)
    assert run(checkout) == "21.0 1"
    assert folders_of_code(checkout)["helper"].stat().st_mtime > time.time() - 86400.0  # its use was noted
    assert run(made(checkout.parent / "copy")) == "21.0 1"


def test_a_constant_that_changes_two_modules_away_is_compiled_anew(checkout: Path) -> None:
    assert run(checkout) == "21.0 0"
    (checkout / "base.py").write_text("FACTOR = 3.0\n")
    assert run(checkout) == "31.0 0"
    (checkout / "base.py").write_text(BASE)
    assert run(checkout) == "21.0 1"


def test_code_that_is_torn_is_compiled_anew(checkout: Path) -> None:
    run(checkout)
    for file in (checkout.parent / "cache").rglob("*.nbc"):
        file.write_bytes(file.read_bytes()[:100])
    assert run(checkout) == "21.0 0"
    for file in (checkout.parent / "cache").rglob("*.nbi"):
        file.write_bytes(b"")
    assert run(checkout) == "21.0 0"
    assert run(checkout) == "21.0 1"


def test_who_keeps_code_and_is_stopped_meanwhile_holds_up_nobody(checkout: Path) -> None:
    run(checkout)
    for file in (checkout.parent / "cache").rglob("*.nb?"):
        file.unlink()
    with ExitStack() as locks:
        for folder in folders_of_code(checkout).values():
            lock = locks.enter_context((folder / "lock").open("w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        ended = started(checkout, timeout=60)
    assert ended.stdout == "21.0 0\n"
    assert "compiled code is not kept: another process holds" in ended.stderr
    assert run(checkout) == "21.0 0"
    assert run(checkout) == "21.0 1"


def test_code_that_nobody_used_for_long_goes_when_its_module_changes(checkout: Path) -> None:
    run(checkout)
    before = folders_of_code(checkout)
    set_unused(before["helper"], UNUSED_S / 86400.0 + 1.0)
    set_unused(before["__main__"], UNUSED_S / 86400.0 - 1.0)
    (checkout / "base.py").write_text("FACTOR = 3.0\n")
    run(checkout)
    assert not before["helper"].exists()
    assert before["__main__"].exists()
    assert len(list((checkout.parent / "cache").iterdir())) == 3


def names_by_python(source: str) -> Iterator[str]:
    for node in ast.parse(source).body:
        if isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{name.name}" for name in node.names)
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)


def test_imports_are_those_that_python_reads() -> None:
    for package in (*PACKAGES, "tools"):
        for file in (REPO / package).rglob("*.py"):
            source = file.read_text(encoding="utf-8")
            assert set(names_by_python(source)) <= set(imported_names(source)), file


def test_no_kernel_is_kept_by_numba_itself() -> None:
    for package in (*PACKAGES, "tools"):
        for file in (REPO / package).rglob("*.py"):
            assert not re.search(r"\bn?jit\([^)]*cache=True", file.read_text(encoding="utf-8")), file


def test_a_digest_is_of_all_that_a_module_imports(checkout: Path) -> None:
    before = digest_of(REPO / "coupole/motion/distances.py")
    assert before != digest_of(REPO / "coupole/motion/annealing.py")
    assert len(before) == 32


# -- the place --------------------------------------------------------------------------------------------


@pytest.fixture
def place_of_kernels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Path]:
    def place(**surroundings: str) -> Path:
        for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
            monkeypatch.delenv(name, raising=False)
        for name, value in surroundings.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
        return kept_in.__wrapped__()

    return place


def test_kernels_are_kept_in_the_cache_of_the_user(place_of_kernels: Callable[..., Path], tmp_path: Path) -> None:
    place = place_of_kernels(HOME=str(tmp_path))
    assert place == tmp_path / ".cache/coupole/kernels"
    assert place.stat().st_mode & 0o777 == 0o700
    assert place_of_kernels(HOME="/proc", XDG_CACHE_HOME=str(tmp_path)) == tmp_path / "coupole/kernels"
    assert place_of_kernels(HOME="/proc", NUMBA_CACHE_DIR=str(tmp_path / "named")) == tmp_path / "named"


def test_without_a_home_that_can_be_written_kernels_have_one_place_of_this_user(
    place_of_kernels: Callable[..., Path], tmp_path: Path
) -> None:
    (place,) = {place_of_kernels(HOME="/proc") for _ in range(2)}
    assert place == tmp_path / f"coupole-kernels-{os.getuid()}"
    assert place.stat().st_mode & 0o777 == 0o700


def test_no_code_is_loaded_from_a_place_that_others_can_write(
    place_of_kernels: Callable[..., Path], tmp_path: Path
) -> None:
    laid_out = tmp_path / f"coupole-kernels-{os.getuid()}"
    laid_out.mkdir()
    laid_out.chmod(0o777)
    place = place_of_kernels(HOME="/proc")
    assert place != laid_out
    assert place.stat().st_mode & 0o777 == 0o700
    laid_out.rmdir()
    laid_out.symlink_to(place)
    assert place_of_kernels(HOME="/proc") != laid_out
