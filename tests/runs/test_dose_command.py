"""`coupole dose` where standard streams or the ledger are not what they should be."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cells
import pytest


def dose(data: Path, *words: str, streams: str = "") -> cells.Ended:
    """The command, its ledgers in `data`; `streams` are redirections of a shell."""
    ended = subprocess.run(
        ["sh", "-c", f'exec "$@" {streams}', "sh", sys.executable, "-m", "coupole", "dose", *words],
        cwd=cells.REPO,
        env={**os.environ, "XDG_DATA_HOME": str(data)},
        capture_output=True,
        text=True,
        timeout=cells.PATIENCE_S,
        check=False,
    )
    return cells.Ended(ended.returncode, ended.stdout, ended.stderr)


def test_without_standard_error_the_document_is_whole(tmp_path: Path) -> None:
    ended = dose(tmp_path, "vase", "--json", streams="2>&-")
    assert (ended.code, json.loads(ended.out)["object"]) == (0, "vase")


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_full_standard_output_is_told_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unbuffered: str
) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    ended = dose(tmp_path, "vase", "--json", streams=">/dev/full")
    assert ended.code == 6
    told = ended.err.strip().splitlines()
    assert told[-1] == "standard output: No space left on device; the text printed there is not complete"
    assert "Traceback" not in ended.err


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ([], "cannot read the dose ledger: a pipe or a device, expected a file"),
        (["--add", "1", "--note", "a"], "cannot read the dose ledger: a pipe or a device, expected a file"),
    ],
    ids=["read", "written"],
)
def test_a_ledger_that_is_a_pipe_is_refused_and_not_waited_for(tmp_path: Path, words: list[str], why: str) -> None:
    ledger = tmp_path / "coupole/ledger"
    ledger.mkdir(parents=True)
    os.mkfifo(ledger / "vase.jsonl")
    ended = dose(tmp_path, "vase", *words)
    assert ended.code == 6
    assert why in ended.err


@pytest.mark.parametrize(
    "words",
    [["--add", "inf", "--note", "a"], ["--budget", "inf", "--name", "Ada"], ["--warn-above", "inf"]],
    ids=["light", "budget", "warning"],
)
def test_light_without_end_is_no_figure(tmp_path: Path, words: list[str]) -> None:
    ended = dose(tmp_path, "vase", *words)
    assert ended.code == 2
    assert "of 0 lux.h or more, found inf" in ended.err
    assert not list(tmp_path.rglob("*.jsonl"))


def test_a_ledger_that_begins_now_says_so(tmp_path: Path) -> None:
    """Also one whose file was moved away: its light would be forgotten without a word."""
    assert "there is none yet. If the object ever received light" in dose(tmp_path, "vase").err
    assert "it was begun now" in dose(tmp_path, "vase", "--add", "1", "--note", "a").err
    assert "ledger is in this folder" not in dose(tmp_path, "vase", "--add", "1", "--note", "b").err
    (tmp_path / "coupole/ledger/vase.jsonl").rename(tmp_path / "elsewhere.jsonl")
    ended = dose(tmp_path, "vase", "--add", "1", "--note", "c")
    assert (ended.code, "it was begun now" in ended.err) == (0, True)
