"""`tools/install`: the command on the PATH, completed by a real shell."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import cells
import pytest

COMPLETE = """
set -e
export PATH="$HOME/.local/bin:$PATH"
source "$HOME/.local/share/bash-completion/completions/coupole"
COMP_WORDS=(coupole "$@") COMP_CWORD=$# COMPREPLY=()
$(complete -p coupole | sed 's/.*-F \\([^ ]*\\).*/\\1/') coupole
echo "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("home")
    done = run(folder, cells.REPO / "tools/install")
    assert f"linked {folder}/.local/bin/coupole" in done.stderr
    return folder


def run(home: Path, *words: str | Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "HOME": str(home), "XDG_DATA_HOME": "", "XDG_CONFIG_HOME": ""}
    return subprocess.run(
        [str(word) for word in words], cwd=cells.REPO, env=environment, capture_output=True, text=True, check=True
    )


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (["st"], "status stop"),
        pytest.param(["export", "somewhere", "--to", "pt"], "ptm", marks=pytest.mark.full),
        pytest.param(["plan", "new", "ch"], "charuco", marks=pytest.mark.full),
        (["acquire", "configs/plans/demo."], "configs/plans/demo.yaml"),
        (["acquire", "configs/rigs/sim-ur5"], ""),
    ],
    ids=["command", "format", "template", "plan", "a rig is no plan"],
)
def test_the_shell_completes_words_and_values(home: Path, words: list[str], completed: str) -> None:
    assert run(home, "bash", "-c", COMPLETE, "bash", *words).stdout.strip() == completed


def test_the_command_is_found_and_all_is_taken_away_again(home: Path) -> None:
    assert run(home, home / ".local/bin/coupole", "--version").stdout.startswith("coupole 0.")
    (home / ".local/bin/coupole").unlink()
    (home / ".local/bin/coupole").write_text("of somebody else")
    with pytest.raises(subprocess.CalledProcessError) as refused:
        run(home, cells.REPO / "tools/install")
    assert "is not of this checkout" in refused.value.stderr
    run(home, cells.REPO / "tools/install", "--remove")
    assert [path.name for path in home.rglob("*") if path.is_file()] == ["coupole"], "but for what is not ours"
