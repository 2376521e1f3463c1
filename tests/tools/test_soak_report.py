"""What `tools/soak.py` makes of the figures of its rehearsals."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

import soak

SHOTS = 5000


def line(number: int, **other: Any) -> dict[str, Any]:
    """One rehearsal without anything wrong."""
    process = {"pid": 7, "bytes": 300_000_000, "files": 12, "threads": 4}
    counts = {"shots": SHOTS, "frames": SHOTS, "proven": SHOTS, "sessions": 1, "reshot": 0}
    nothing: dict[str, Any] = {
        name: [] for name in ("told_missing", "mislabelled", "twice", "lost", "unexplained")
    }
    settings = {"seed": 0, "faults_per_shot": 1e-3, "speed": 20.0}
    found = {
        "number": number,
        "settings": settings,
        **counts,
        "faults": {"drop_trigger": 2},
        "ended_by": {},
        **nothing,
    }
    return {**found, "controller": process, "world": {**process, "pid": 8}, **other}


GROWN = {"pid": 8, "bytes": 351_000_000, "files": 12, "threads": 4}


@pytest.mark.parametrize(
    ("last", "code", "words"),
    [
        ({}, 0, "10 drop_trigger"),
        (
            {"mislabelled": ["top/led0001/e0: lit were {3: 0.008}"]},
            1,
            "mislabelled: top/led0001/e0: lit were {3: 0.008}",
        ),
        ({"twice": ["top/led0001/e0"]}, 1, "twice: top/led0001/e0"),
        ({"lost": ["top/dark3/e0"]}, 1, "lost: top/dark3/e0"),
        ({"world": GROWN}, 1, "+51.0"),
        ({"controller": {**GROWN, "pid": 7, "bytes": 0, "files": 30}}, 1, "+18"),
    ],
    ids=["good", "mislabelled", "twice", "lost", "memory", "files"],
)
def test_it_ends_with_one_if_anything_was_wrong_or_has_grown(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    last: dict[str, Any],
    code: int,
    words: str,
) -> None:
    """It is asked for no more shots than are kept, so it rehearses nothing."""
    kept = tmp_path / "soak.jsonl"
    lines = [*(line(number) for number in range(4)), line(4, **last)]
    kept.write_text("".join(json.dumps(one) + "\n" for one in lines))
    monkeypatch.setattr(sys, "argv", ["soak.py", "--shots", str(5 * SHOTS), "--keep", str(kept)])
    assert soak.main() == code
    assert words in capsys.readouterr().out
    assert len(kept.read_text().splitlines()) == 5


def test_parts_with_other_settings_are_not_mixed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = tmp_path / "soak.jsonl"
    kept.write_text(json.dumps(line(0)) + "\n")
    monkeypatch.setattr(sys, "argv", ["soak.py", "--shots", "10", "--seed", "1", "--keep", str(kept)])
    with pytest.raises(SystemExit, match="2"):
        soak.main()
