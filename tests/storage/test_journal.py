"""The journal and the ledger: whole lines, whatever happened to the last; typed events, old ones understood."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coupole.errors import StorageError
from coupole.plan.shot_id import Led, ShotId, ShotLabel
from coupole.storage import journal
from coupole.storage.journal import Journal, event_line
from coupole.storage.journal_events import (
    Continued,
    Event,
    FaultNoted,
    FrameProven,
    Paused,
    SessionResumed,
    SessionStarted,
    SessionStopped,
    ViewBegun,
)

FRAME = FrameProven(
    shot=ShotId("top", ShotLabel(Led(1), 0)), file="views/top.h5", index=3, frame_id=7, xxh3="0123456789abcdef"
)


def written(path: Path, events: Sequence[Event]) -> None:
    diary = Journal(path)
    for event in events:
        diary.write(event)
    diary.commit()
    diary.close()


def tags(path: Path) -> list[str]:
    return [event.event for event in journal.read_events(path)]


def test_lines_reach_the_file_with_the_commit_and_not_before(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    diary = Journal(path)
    diary.write(FRAME)
    assert path.read_bytes() == b""
    diary.commit()
    assert FRAME in list(journal.read_events(path))
    diary.close()


def test_each_line_is_one_json_object_that_begins_with_event_and_utc_time(tmp_path: Path) -> None:
    written(tmp_path / "journal.jsonl", [ViewBegun(view="top")])
    for text in (tmp_path / "journal.jsonl").read_text().splitlines():
        line = json.loads(text)
        assert list(line)[:2] == ["event", "t"]
        assert line["t"].endswith("Z")


def test_the_first_line_says_the_journals_version(tmp_path: Path) -> None:
    written(tmp_path / "journal.jsonl", [SessionStarted()])
    first = json.loads((tmp_path / "journal.jsonl").read_text().splitlines()[0])
    assert (first["event"], first["version"]) == ("journal", 2)
    assert journal.version(tmp_path / "journal.jsonl") == 2


def test_a_reopened_journal_is_not_begun_again(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    written(path, [SessionStarted()])
    written(path, [SessionResumed()])
    assert tags(path) == ["journal", "start", "resume"]


def test_lines_that_were_taken_are_written_by_append_alone(tmp_path: Path) -> None:
    diary = Journal(tmp_path / "journal.jsonl")
    diary.write(FRAME)
    taken = diary.take()
    diary.write(SessionStopped(outcome="done"))
    diary.commit()
    diary.append(taken)
    diary.close()
    assert tags(tmp_path / "journal.jsonl") == ["journal", "stop", "frame"]


def torn_journal(path: Path) -> None:
    """A journal whose last line a crash cut off."""
    written(path, [SessionStarted(), FRAME])
    os.truncate(path, path.stat().st_size - 9)


def test_a_torn_last_line_is_passed_over(tmp_path: Path) -> None:
    torn_journal(tmp_path / "journal.jsonl")
    assert tags(tmp_path / "journal.jsonl") == ["journal", "start"]


def test_a_torn_last_line_is_closed_on_reopening_and_the_next_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    torn_journal(path)
    written(path, [SessionResumed()])
    assert tags(path) == ["journal", "start", "resume"]


@pytest.mark.parametrize("hole", [b"\x00", b"\xff", b"\xff\xfe", b"\x00\x00\x00{", b"\n\x00"], ids=repr)
@pytest.mark.parametrize("count", [1, 7, 512, 4096])
def test_a_tail_of_what_a_disk_gives_for_lost_sectors_is_passed_over(
    tmp_path: Path, hole: bytes, count: int
) -> None:
    """A file system may have made the file longer before the bytes came: zeros, or 0xff on flash."""
    path = tmp_path / "journal.jsonl"
    written(path, [SessionStarted(), FRAME])
    with path.open("ab") as file:
        file.write(hole * count)
    assert tags(path) == ["journal", "start", "frame"]
    written(path, [SessionResumed(), FRAME])
    assert tags(path) == ["journal", "start", "frame", "resume", "frame"]
    assert journal.tail(path, 10**6) == list(journal.read_events(path))


def test_a_line_whose_first_sectors_are_lost_is_passed_over_and_the_next_is_read(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    written(path, [SessionStarted(), FRAME, SessionStopped(outcome="done")])
    first, start, frame, stop = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + start + bytes(len(frame) - 9) + frame[-9:] + stop)
    assert tags(path) == ["journal", "start", "stop"]


@pytest.mark.parametrize(
    "line",
    [
        '{"event":"frame","t":"","shot":"top/led0001/e0"}',
        '{"event":"frame","t":"","shot":"top/led1","file":"f","index":0,"frame_id":0,"xxh3":""}',
        '{"event":"surprise","t":""}',
        '{"event":"pause","t":"","why":"coffee"}',
        "[]",
    ],
)
def test_a_whole_line_that_is_no_event_is_refused_with_its_number(tmp_path: Path, line: str) -> None:
    path = tmp_path / "journal.jsonl"
    written(path, [SessionStarted()])
    with path.open("a") as file:
        file.write(line + "\n")
    with pytest.raises(StorageError, match="line 3 is not an event"):
        list(journal.read_events(path))


def test_a_journal_of_a_later_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    path.write_text('{"event":"journal","t":"","version":3}\n')
    with pytest.raises(StorageError, match="version 3"):
        list(journal.read_events(path))


def test_of_a_journal_of_version_1_the_end_of_a_pause_is_told_from_a_resumed_session(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    lines = [
        {"event": "start", "t": "2025-01-01T00:00:00.000Z", "simulated": True, "room_c": 22.1},
        {"event": "pause", "t": "2025-01-01T00:00:01.000Z"},
        {"event": "resume", "t": "2025-01-01T00:00:02.000Z", "after": "pause"},
        {"event": "resume", "t": "2025-01-01T00:00:03.000Z", "simulated": True},
    ]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert journal.version(path) == 1
    found = list(journal.read_events(path))
    assert list(map(type, found)) == [SessionStarted, Paused, Continued, SessionResumed]
    assert [event.t for event in found] == [line["t"] for line in lines]


@given(st.text(max_size=200), st.text(max_size=20))
def test_what_is_said_in_an_event_comes_back_from_its_line(message: str, device: str) -> None:
    event = FaultNoted(kind="DeviceLost", message=message, device=device)
    line = event_line(event)
    assert line.count("\n") == 1
    assert FaultNoted.model_validate_json(line) == event


def test_the_tail_of_a_journal_begins_with_a_whole_line(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    written(path, [FRAME] * 50)
    size = len(event_line(FRAME))
    assert journal.tail(path, 3 * size + size // 2) == [FRAME] * 3
