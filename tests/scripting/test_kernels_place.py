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
NOWHERE = "import os; os.access = lambda *_: False\n"
"""As if nothing could be written, which root cannot be kept from otherwise."""


def place_of_kernels(program: str, **surroundings: str) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    command = [sys.executable, "-c", program]
    ended = subprocess.run(command, env=environment | surroundings, capture_output=True, text=True, check=True)
    return ended.stdout.strip()


@pytest.mark.parametrize("home", ["/nonexistent", "/proc", ""])
def test_kernels_have_one_place_of_this_user_without_home_or_a_package_that_can_be_written(
    home: str, tmp_path: Path
) -> None:
    places = {place_of_kernels(NOWHERE + PROGRAM, HOME=home, TMPDIR=str(tmp_path)) for _ in range(2)}
    (place,) = map(Path, places)
    assert place == tmp_path / f"coupole-kernels-{os.getuid()}"
    assert place.stat().st_mode & 0o777 == 0o700


def test_no_code_is_loaded_from_a_place_that_others_can_write(tmp_path: Path) -> None:
    laid_out = tmp_path / f"coupole-kernels-{os.getuid()}"
    laid_out.mkdir()
    laid_out.chmod(0o777)
    place = Path(place_of_kernels(NOWHERE + PROGRAM, HOME="", TMPDIR=str(tmp_path)))
    assert place != laid_out
    assert place.stat().st_mode & 0o777 == 0o700
    laid_out.rmdir()
    laid_out.symlink_to(place)
    assert place_of_kernels(NOWHERE + PROGRAM, HOME="", TMPDIR=str(tmp_path)) != str(laid_out)


def test_kernels_stay_where_they_are_if_that_can_be_written() -> None:
    assert place_of_kernels(PROGRAM) == ""
