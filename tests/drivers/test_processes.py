"""Processes that drivers start: they answer an arm, and must not wait for what only the driver needs."""

from __future__ import annotations

import subprocess
import sys

import pytest
from places import REPO


@pytest.mark.parametrize("process", ["drivers.kuka.rsi.loop", "drivers.ur.worker"])
def test_a_process_that_answers_an_arm_imports_little(process: str) -> None:
    code = f"import {process}, sys; print(*sys.modules)"
    ended = subprocess.run([sys.executable, "-c", code], cwd=REPO, capture_output=True, text=True, check=True)
    assert not {"numpy", "pydantic", "numba", "scipy"} & set(ended.stdout.split())
