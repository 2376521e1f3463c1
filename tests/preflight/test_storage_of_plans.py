"""Space and speed of the disk, asked before the run."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from preflight_cases import RIG, checked, only_refusal, plan_of, rig_of

from coupole.plan.marks import MARKS
from coupole.preflight.checking import storage_of
from coupole.preflight.preflight import StorageFacts, room_bytes
from coupole.storage.run import Occupied
from coupole.storage.write_speed import measure_write_speed


def test_a_run_that_does_not_fit_on_the_disk_is_refused() -> None:
    assert RIG is not None
    need = room_bytes(1080 + 2 + MARKS, 1, RIG.frame_bytes) + RIG.storage.reserve_bytes
    assert checked(plan_of(), storage=StorageFacts(free_bytes=need)).refusals == []
    refusal = only_refusal(checked(plan_of(), storage=StorageFacts(free_bytes=need - 1)))
    assert "must stay free" in refusal


def test_the_folder_of_the_run_is_named_not_that_of_the_rig() -> None:
    refusal = only_refusal(checked(plan_of(), storage=StorageFacts(0, folder=Path("/elsewhere/runs"))))
    assert refusal.startswith("storage /elsewhere/runs: the run needs ")


def test_what_a_resumed_run_has_allocated_is_not_asked_for_again() -> None:
    assert RIG is not None
    need = room_bytes(1080 + 2 + MARKS, 1, RIG.frame_bytes) + RIG.storage.reserve_bytes
    facts = StorageFacts(need - 10**6, occupied_space=Occupied({"top": 10**6}))
    assert checked(plan_of(), storage=facts).refusals == []
    assert (
        len(checked(plan_of(), storage=replace(facts, occupied_space=Occupied({"top": 10**6 - 1}))).refusals) == 1
    )


def test_a_disk_that_cannot_be_written_is_refused_and_not_taken_for_one_without_limit(tmp_path: Path) -> None:
    occupied_space = tmp_path / "runs"
    occupied_space.write_text("a file where the folder of the runs should be")
    facts = storage_of(occupied_space / "below", rig_of())
    assert facts.write_bytes_s == 0.0
    refusal = only_refusal(checked(plan_of(), storage=replace(facts, free_bytes=10**15)))
    assert refusal == (
        f"storage {occupied_space / 'below'}: expected a folder that can be written; {occupied_space} is a file"
    )


def test_a_disk_whose_test_fails_is_refused_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(fd: int, data: object, offset: int) -> int:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "pwrite", failing)
    facts = storage_of(tmp_path, rig_of())
    assert "Input/output error" in only_refusal(checked(plan_of(), storage=replace(facts, free_bytes=10**15)))
    assert list(tmp_path.iterdir()) == []


def test_the_test_of_a_disk_leaves_nothing_and_never_writes_into_the_reserve(tmp_path: Path) -> None:
    seen: list[int] = []
    original = os.pwrite

    def counted(fd: int, data: Any, offset: int) -> int:
        seen.append(len(data))
        assert list(tmp_path.iterdir()) == []  # a file without a name: kill -9 leaves nothing
        return original(fd, data, offset)

    with mock.patch("os.pwrite", counted):
        assert measure_write_speed(tmp_path, frame_bytes=25_000_000, room_bytes=2**40) > 0.0
        assert 0 < sum(seen) <= 128 * 2**20
        seen.clear()
        assert measure_write_speed(tmp_path, room_bytes=63 * 2**20) == 0.0
    assert seen == []
    assert list(tmp_path.iterdir()) == []


def test_a_frame_that_is_no_multiple_of_a_page_is_warned_of() -> None:
    assert RIG is not None
    rig = rig_of(sensor={**RIG.sensor.model_dump(), "width_px": 500})
    assert "500 x 384 is not a multiple of 4096 bytes" in checked(plan_of(), rig).warnings[0]
