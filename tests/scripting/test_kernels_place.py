"""What is compiled has a place, also where neither the package nor a home can be written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import os
import coupole
print(os.environ.get("NUMBA_CACHE_DIR", ""))
"""


@pytest.mark.parametrize("home", ["/nonexistent", "/proc", ""])
def test_kernels_have_a_place_of_their_own_without_home_or_a_package_that_can_be_written(
    home: str,
) -> None:
    program = "import os; os.access = lambda *_: False\n" + PROGRAM
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    ended = subprocess.run(
        [sys.executable, "-c", program],
        env={**environment, "HOME": home},
        capture_output=True,
        text=True,
        check=True,
    )
    place = Path(ended.stdout.strip())
    assert place.name.startswith("coupole-kernels-")
    assert place.stat().st_mode & 0o777 == 0o700
    place.rmdir()


def test_kernels_stay_where_they_are_if_that_can_be_written() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
    )
    assert ended.stdout.strip() == ""
