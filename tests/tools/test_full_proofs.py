"""The long proofs are run in parts: what ended well is kept and not run again; what failed is, and is told."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from places import REPO

sys.path.insert(0, str(REPO / "tools"))

import full_proofs
from full_proofs import Proof


@pytest.fixture
def count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that gets a letter from each proof that is run: `g` from the good one, `b` from the bad one."""
    path = tmp_path / "count"
    write = f"open({str(path)!r}, 'a').write"
    proofs = (
        Proof("good", "ends well", f"-c \"{write}('g'); print(3, 'of 3 | held')\""),
        Proof("bad", "fails", f"-c \"{write}('b'); raise SystemExit(2)\""),
    )
    monkeypatch.setattr(full_proofs, "PROOFS", proofs)
    monkeypatch.setattr(full_proofs, "LOGS", tmp_path)
    monkeypatch.setattr(full_proofs, "ENDED", tmp_path / "ended.jsonl")
    return path


def run(monkeypatch: pytest.MonkeyPatch, *options: str) -> int:
    monkeypatch.setattr(sys, "argv", ["full_proofs.py", *options])
    return full_proofs.main()


def test_what_ended_well_is_kept_and_what_failed_is_run_again(
    count: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch) == 1
    assert run(monkeypatch) == 1
    assert count.read_text() == "gbb"
    assert run(monkeypatch, "--only", "good") == 0
    assert count.read_text() == "gbb"
    assert run(monkeypatch, "--only", "good", "--again") == 0
    assert count.read_text() == "gbbg"
    good, bad = capsys.readouterr().out.splitlines()[-2:]
    assert "| good | 3 of 3 / held |" in good
    assert "| **exit 2** |" in bad


def test_the_table_names_what_was_not_run(
    count: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "--table") == 0
    assert capsys.readouterr().out.count("| not run |") == 2
    assert not count.exists()


def test_every_folder_of_tests_is_a_proof_and_every_command_is_there() -> None:
    names = [proof.name for proof in full_proofs.PROOFS]
    assert len(set(names)) == len(names)
    folders = {path.relative_to(REPO / "tests").parts[0] for path in (REPO / "tests").rglob("*/test_*.py")}
    assert {name.removeprefix("tests-") for name in names if name.startswith("tests-")} == folders
    for proof in full_proofs.PROOFS:
        paths = [word for word in proof.command.split() if word.startswith(("tools/", "tests/"))]
        assert paths, proof
        assert all((REPO / path).exists() for path in paths), proof
