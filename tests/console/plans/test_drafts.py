"""Plans that are read at the same time do not end each other's work."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import pytest

from coupole.console.plans import drafts
from coupole.console.plans.drafts import Desk, Draft
from coupole.errors import InputError


def test_waiting_does_not_count_and_what_is_superseded_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drafts, "_PATIENCE_S", 5.0)  # for a computation of nothing, beside whatever else runs

    async def all_at_once() -> list[object]:
        desk = Desk()
        too_long, quick = desk._do(time.sleep, 100), desk._do(abs, -3)
        dropped = desk.check(Draft(Path("none.yaml"), ""), lambda: False)
        try:
            return list(await asyncio.gather(too_long, quick, dropped, return_exceptions=True))
        finally:
            desk.close()

    too_long, quick, dropped = asyncio.run(all_at_once())
    assert isinstance(too_long, InputError)
    assert (quick, dropped) == (3, None)
