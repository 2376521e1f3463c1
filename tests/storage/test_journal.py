"""The journal and the ledger: whole lines, whatever happened to the last."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from coupole.preflight import ledger
from coupole.storage import journal
from coupole.storage.journal import Journal


def test_lines_reach_the_file_with_the_commit_and_not_before(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    diary = Journal(path)
    diary.write("frame", shot="top/led0001/e0")
    assert path.read_bytes() == b""
    diary.commit()
    assert [event["shot"] for event in journal.read(path)] == ["top/led0001/e0"]
    diary.close()


def test_each_line_is_one_json_object_with_event_and_utc_time(tmp_path: Path) -> None:
    diary = Journal(tmp_path / "journal.jsonl")
    diary.write("view", name="top")
    diary.commit()
    diary.close()
    line = json.loads((tmp_path / "journal.jsonl").read_text())
    assert line["event"] == "view"
    assert line["t"].endswith("Z")


def test_lines_that_were_taken_are_written_by_append_alone(tmp_path: Path) -> None:
    diary = Journal(tmp_path / "journal.jsonl")
    diary.write("frame", shot="a")
    taken = diary.take()
    diary.write("stop")
    diary.commit()
    diary.append(taken)
    diary.close()
    assert [event["event"] for event in journal.read(tmp_path / "journal.jsonl")] == ["stop", "frame"]


def torn_journal(path: Path) -> None:
    """A journal whose last line a crash cut off."""
    diary = Journal(path)
    diary.write("start")
    diary.write("frame", shot="top/led0001/e0")
    diary.commit()
    diary.close()
    os.truncate(path, path.stat().st_size - 9)


def test_a_torn_last_line_is_passed_over(tmp_path: Path) -> None:
    torn_journal(tmp_path / "journal.jsonl")
    assert [event["event"] for event in journal.read(tmp_path / "journal.jsonl")] == ["start"]


def test_a_torn_last_line_is_closed_on_reopening_and_the_next_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    torn_journal(path)
    diary = Journal(path)
    diary.write("resume")
    diary.commit()
    diary.close()
    assert [event["event"] for event in journal.read(path)] == ["start", "resume"]


def test_the_ledger_sums_all_doses_of_an_object(tmp_path: Path) -> None:
    for run_name, dose in (("one", 1.7), ("two", 0.4)):
        ledger.add(tmp_path, "shroud", run=run_name, dose_lux_h=dose)
    ledger.add(tmp_path, "other", run="three", dose_lux_h=9.0)
    assert ledger.total_lux_h(tmp_path, "shroud") == pytest.approx(2.1)


def test_an_object_without_a_ledger_has_received_nothing(tmp_path: Path) -> None:
    assert ledger.total_lux_h(tmp_path, "shroud") == 0.0
