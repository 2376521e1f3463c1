"""Blocks that the workers of a test's cluster do."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
from triangle_cases import noisy_case

from coupole.errors import InputError
from coupole.reflectance.triangle_fit import fit_triangles


def materials(pids: Path, rows: tuple[int, int]) -> np.ndarray:
    """[b, 11] of some triangles, slowly; who does them is left in a folder."""
    (pids / str(os.getpid())).touch()
    time.sleep(0.05)
    samples, _ = noisy_case(2)
    found = fit_triangles(samples.of_triangles(np.arange(*rows)), np.ones(240, bool), 30.0, threads=1)
    return np.column_stack([found.normals, found.kd, found.ks, found.alpha, found.residual])


def refuse(_block: int) -> None:
    raise InputError("told by a worker")
