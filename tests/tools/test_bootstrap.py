"""What the scripts do before they start: compiled functions of another commit are not used."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_compiled_functions_are_kept_for_their_commit_alone(tmp_path: Path) -> None:
    for room in ("coupole/__pycache__", "drivers", "sim", "tools"):
        (tmp_path / room).mkdir(parents=True)
    shutil.copy(ROOT / "tools/bootstrap.sh", tmp_path / "tools")
    kept = tmp_path / "coupole/__pycache__/fit.nbi"

    def bash(line: str) -> None:
        subprocess.run(["bash", "-euc", line], cwd=tmp_path, check=True, capture_output=True)

    def commit() -> None:
        bash("git -c user.name=one -c user.email=one@example.org commit -q --allow-empty -m one")

    bash("git init -q")
    commit()
    kept.touch()
    bash("source tools/bootstrap.sh; forget_stale_kernels")
    assert not kept.exists()  # nobody knows of which commit it was
    kept.touch()
    bash("source tools/bootstrap.sh; forget_stale_kernels")
    assert kept.exists()
    commit()
    bash("source tools/bootstrap.sh; forget_stale_kernels")
    assert not kept.exists()
