"""Several processes that want one kernel: one compiles it, the others load what it left."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from places import REPO

pytestmark = pytest.mark.full

PROCESSES = 4
KERNELS = """
import numpy as np
from numba import njit

@njit(cache=True)
def solved(a):
    return np.linalg.solve(a, a)

@njit(cache=True)
def steps(x):  # of a float: calls itself with an integer, another signature
    if x <= 0:
        return 0
    return steps(int(x) - 1) + 1

@njit(cache=True)
def kernel(a):
    return np.sort(solved(a).ravel()).sum()
"""
BEGIN = """
import sys
sys.path[:0] = sys.argv[1:]
from compiled_once import compile_each_kernel_once
compile_each_kernel_once()
import kernels, numpy as np
"""
USE = """
print("ready", flush=True)
sys.stdin.readline()
kernels.kernel(np.eye(3))
print(*(sum(kernel.stats.cache_misses.values()) for kernel in (kernels.kernel, kernels.solved)))
"""


def begun(folder: Path, program: str) -> subprocess.Popen[str]:
    (folder / "kernels.py").write_text(KERNELS)
    return subprocess.Popen(
        [sys.executable, "-c", BEGIN + program, str(folder), str(REPO / "tests")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache")},
    )


def test_of_processes_that_begin_together_one_compiles_each_kernel(tmp_path: Path) -> None:
    processes = [begun(tmp_path, USE) for _ in range(PROCESSES)]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    outs = [process.communicate(timeout=120.0)[0] for process in processes]
    misses = [tuple(map(int, out.split())) for out in outs]
    assert sorted(misses, reverse=True) == [(1, 1), *[(0, 0)] * (PROCESSES - 1)]


def test_a_kernel_that_calls_itself_with_another_signature_does_not_wait_for_itself(tmp_path: Path) -> None:
    process = begun(tmp_path, "print(kernels.steps(3.5))")
    try:
        assert process.communicate(timeout=120.0)[0] == "3\n"
    finally:
        process.kill()
