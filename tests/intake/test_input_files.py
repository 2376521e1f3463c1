"""Files are read once: whoever asks again gets the same bytes, and what happened meanwhile is told once."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from coupole.intake.input_files import InputFiles


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "plan.yaml"
    path.write_bytes(b"exposure_us: 8000\n")
    return path


def edited(path: Path) -> None:
    path.write_bytes(b"exposure_us: 9000\n")


def replaced(path: Path) -> None:
    path.with_name("new").write_bytes(b"exposure_us: 16000\n")
    path.with_name("new").replace(path)


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def made_a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (edited, "was changed"),
        (replaced, "was changed"),
        (emptied, "was changed"),
        (Path.unlink, "does not exist any more"),
        (made_a_folder, "is not a file any more"),
    ],
)
def test_a_file_that_changes_is_told_once_and_its_bytes_stay(
    path: Path, change: Callable[[Path], None], told: str
) -> None:
    files, was = InputFiles(), path.read_bytes()
    assert files.read_bytes(path) == was
    assert files.changes() == []
    change(path)
    assert files.read_bytes(path) == was
    assert files.sha256(path) == hashlib.sha256(was).hexdigest()
    assert files.there(path)
    assert files.changes() == [f"{path} {told}"]
    assert files.changes() == []


def test_a_file_that_is_touched_or_written_again_as_it_was_has_not_changed(path: Path) -> None:
    files = InputFiles()
    files.read_bytes(path)
    os.utime(path, (1, 1))
    path.write_bytes(path.read_bytes())
    assert files.changes() == []


def test_a_link_that_is_led_elsewhere_changes_nothing(path: Path, tmp_path: Path) -> None:
    link, other = tmp_path / "link.yaml", tmp_path / "other.yaml"
    link.symlink_to(path)
    other.write_bytes(b"exposure_us: 16000\n")
    files = InputFiles()
    files.read_bytes(link)
    link.unlink()
    link.symlink_to(other)
    assert files.read_bytes(link) == b"exposure_us: 8000\n"
    assert files.changes() == [f"{link} was changed"]


def test_a_folder_is_not_read(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="not a file"):
        InputFiles().read_bytes(tmp_path)
