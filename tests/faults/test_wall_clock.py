"""Runs over midnight, a leap second, and both changes of summer time: what is written has UTC, in its order."""

from __future__ import annotations

import sys
import time
from datetime import UTC, datetime, timedelta, tzinfo
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import cells
import pytest
from cells import CellFolder
from failing_calls import Failure, acquire, cell_in
from happenings import AnyTime
from in_part import in_part

PARIS = "Europe/Paris"
MOMENTS = {
    "midnight of a year that ends with a leap second": (datetime(2017, 1, 1, tzinfo=UTC), 1.0),
    "an hour is left out in Paris": (datetime(2027, 3, 28, 1, 0, tzinfo=UTC), 0.0),
    "an hour is had twice in Paris": (datetime(2027, 10, 31, 1, 0, tzinfo=UTC), 0.0),
}
"""When, and for how long a clock that follows UTC then has the same seconds again."""
SHARE_S = timedelta(milliseconds=1)


class SetClock(datetime, metaclass=AnyTime):
    """`datetime` of a clock that stands just before a moment until it comes, and goes on from there."""

    moment: datetime
    again_s: float
    came_s: float | None

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
        if cls.came_s is None:
            return (cls.moment - SHARE_S).astimezone(tz)
        return (cls.moment + timedelta(seconds=time.monotonic() - cls.came_s - cls.again_s)).astimezone(tz)

    @classmethod
    def comes(cls, _device: str, method: str, _clock: Any) -> None:
        """In the middle of the first burst."""
        if method == "poll_log" and cls.came_s is None:
            cls.came_s = time.monotonic()


def _set_clock(cell: CellFolder, monkeypatch: pytest.MonkeyPatch, moment: datetime, again_s: float) -> None:
    SetClock.moment, SetClock.again_s, SetClock.came_s = moment, again_s, None
    for name, module in list(sys.modules.items()):
        if name.startswith(("coupole", "drivers")) and vars(module).get("datetime") is datetime:
            monkeypatch.setattr(module, "datetime", SetClock)


@pytest.mark.parametrize("name", in_part(MOMENTS, next(iter(MOMENTS))))
def test_a_run_over_a_moment_of_the_calendar_is_whole_and_in_order(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    moment, again_s = MOMENTS[name]
    request.addfinalizer(time.tzset)
    monkeypatch = request.getfixturevalue("monkeypatch")
    monkeypatch.setenv("TZ", PARIS)
    time.tzset()
    cell = cell_in(tmp_path)
    with cell.world({"kind": "drop_trigger", "edge": 9}):
        _set_clock(cell, monkeypatch, moment, again_s)
        ended = acquire(cell, cast("Failure", SetClock.comes))
    assert ended.code == 0, ended
    run = cell.run_folder
    assert run.name.startswith(f"{moment - SHARE_S:%Y%m%dT%H%M}59Z")
    times = {event["event"]: datetime.fromisoformat(event["t"]) for event in cells.events(run)}
    assert times["settled"] > times["start"] - SHARE_S
    assert times["start"] < moment
    assert times["stop"] > moment
    order = [datetime.fromisoformat(event["t"]) for event in cells.events(run)]
    back_s = [(a - b).total_seconds() for a, b in pairwise(order) if a > b]
    assert len(back_s) == (again_s > 0.0)
    assert max(back_s, default=0.0) <= again_s
    cells.assert_each_shot_proven_once(run)
    assert cells.here("status", run, "--json").document["state"] == "done"
