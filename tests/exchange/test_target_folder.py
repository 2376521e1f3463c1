"""What stays of an export that ends with an error."""

from __future__ import annotations

from pathlib import Path

import pytest

from coupole.errors import InputError
from coupole.exchange.target_folder import writing_into


def export(folder: Path, *files: Path) -> None:
    with writing_into(folder):
        for file in files:
            file.write_text("told")
        raise InputError("no such view")


def refused_in(folder: Path, *files: Path) -> None:
    with pytest.raises(InputError, match="no such view"):
        export(folder, *files)


def test_a_refused_export_leaves_no_folder_that_it_has_made(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    refused_in(tmp_path / "mine/new/inner")
    assert list(tmp_path.rglob("*")) == [tmp_path / "mine"]
    refused_in(tmp_path / "mine")
    assert (tmp_path / "mine").is_dir()


def test_a_folder_that_has_something_in_it_stays(tmp_path: Path) -> None:
    refused_in(tmp_path / "new/inner", tmp_path / "new/file")
    assert list(tmp_path.rglob("*")) == [tmp_path / "new", tmp_path / "new/file"]
