"""A socket that somebody removes while a process serves it: programs that clean /tmp do so."""

import json
import shutil
from pathlib import Path

import cells
import pytest

from coupole.acquisition.user_socket import UserSocket, exchange


def is_answered(path: Path) -> bool:
    try:
        return exchange(path, {"command": "state"}) == {"asked": {"command": "state"}}
    except OSError:
        return False


@pytest.mark.parametrize("loss", ["socket", "folder"])
def test_a_socket_that_was_removed_is_served_again(tmp_path: Path, loss: str) -> None:
    folder = tmp_path / "runtime"
    folder.mkdir(mode=0o700)
    path = folder / "run.sock"
    with UserSocket(path, lambda asked, _: {"asked": json.loads(asked)}):
        assert is_answered(path)
        if loss == "socket":
            path.unlink()
        else:
            shutil.rmtree(folder)
        assert not is_answered(path)
        cells.wait_until(lambda: is_answered(path), "the socket is served again")
        assert folder.stat().st_mode & 0o077 == 0
    assert not path.exists()


def test_a_folder_that_became_a_file_hides_nothing_at_the_end(tmp_path: Path) -> None:
    folder = tmp_path / "runtime"
    folder.mkdir(mode=0o700)
    with UserSocket(folder / "run.sock", lambda asked, _: {}):
        shutil.rmtree(folder)
        folder.write_text("a file")
    assert folder.read_text() == "a file"
