"""A journal that is read while it grows."""

from __future__ import annotations

from pathlib import Path

from coupole.storage.journal import Follower, Journal, read_events
from coupole.storage.journal_events import Paused, ViewBegun


def test_each_event_is_told_once_and_none_before_its_line_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    follower = Follower(path)
    assert follower.news() == []
    journal = Journal(path)
    journal.write(ViewBegun(view="top"))
    journal.commit()
    found = follower.news()
    with path.open("ab") as file:
        file.write(b'{"event":"pause","t":"2026-01-02T03:04:05')
    assert follower.news() == []
    with path.open("ab") as file:
        file.write(b'+00:00"}\n')
    found += follower.news()
    assert isinstance(found[-1], Paused)
    assert follower.news() == []
    assert found == list(read_events(path))
