"""The burst's loop: what counts as proven, round by round, with devices that do as the test says."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cells import wait_until
from matching_takes import take, whole_burst
from scripted_cell import Cell

from coupole.acquisition import burst_runner
from coupole.acquisition.arm_supervisor import ArmMovedError
from coupole.acquisition.frame_matching import Match, match
from coupole.devices import Frame
from coupole.errors import DeviceError, DeviceTimeout, StorageError

BURST = whole_burst(40)
"""0.5 s: ten rounds of the loop."""
MIDDLE_S = BURST.duration_s / 2


def shots_of(cell: Cell) -> set[str]:
    return {str(shot) for shot in cell.burst.shots if shot}


def test_a_clean_burst_is_proven_whole_with_every_frame_under_its_own_light() -> None:
    cell = Cell(BURST, take(BURST))
    cell.fire()
    assert {str(shot) for shot in cell.proven} == shots_of(cell)
    for shot, frame in zip(cell.proven, cell.proven_frames, strict=True):
        assert shot == cell.burst.shots[cell.what.truth[frame]]


def test_a_camera_that_fails_after_its_last_frame_is_told_and_no_frame_is_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The burst's loop has counted its frames by then, and asks no more."""
    cell = Cell(BURST, take(BURST))
    over, failed = threading.Event(), threading.Event()
    take_one, end_soon = cell.camera.next_frame, burst_runner.FrameGrabber.end_soon

    def next_frame(timeout_s: float) -> Frame | None:
        if over.is_set():
            failed.set()
            raise RuntimeError("a defect of the driver")
        return take_one(timeout_s)

    def after_the_loop(grabber: burst_runner.FrameGrabber) -> None:
        over.set()
        assert failed.wait(10.0)
        end_soon(grabber)

    monkeypatch.setattr(cell.camera, "next_frame", next_frame)
    monkeypatch.setattr(burst_runner.FrameGrabber, "end_soon", after_the_loop)
    with pytest.raises(RuntimeError, match="a defect of the driver"):
        cell.fire()
    assert {str(shot) for shot in cell.proven} == shots_of(cell)
    assert cell.done[-2:] == ["camera disarmed", "BurstEnded"]


def test_the_end_of_a_burst_does_not_wait_for_frames_that_cannot_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next burst begins only when the last call for a frame has returned."""
    cell = Cell(BURST, take(BURST))
    take_one, timeouts_s = cell.camera.next_frame, []

    def next_frame(timeout_s: float) -> Frame | None:
        timeouts_s.append(timeout_s)
        return take_one(timeout_s)

    monkeypatch.setattr(cell.camera, "next_frame", next_frame)
    cell.fire()
    assert timeouts_s[0] > 0.02, "the thread does not turn in vain while the burst runs"
    assert timeouts_s[-1] < 0.01


def test_most_of_a_burst_is_proven_while_it_runs() -> None:
    cell = Cell(BURST, take(BURST), moves_at_s=BURST.duration_s - 0.1)
    with pytest.raises(ArmMovedError):
        cell.fire()
    assert len(cell.proven) > len(shots_of(cell)) // 2


def test_frames_that_came_after_the_arms_last_word_are_not_proven() -> None:
    """It had moved by then, which was learnt five rounds later."""
    cell = Cell(BURST, take(BURST), heard_until_s=MIDDLE_S, moves_at_s=MIDDLE_S + 0.25)
    with pytest.raises(ArmMovedError):
        cell.fire()
    assert max(cell.proven_frames) < cell.confirmed
    assert cell.arrives_us(cell.confirmed - 1) <= 1e6 * MIDDLE_S
    assert len(cell.proven) > 5
    assert len(cell.proven) + len(cell.freed) == cell.arrived


def test_the_last_frames_are_not_proven_before_the_arm_was_heard_of_once_more() -> None:
    cell = Cell(BURST, take(BURST), heard_until_s=MIDDLE_S, moves_at_s=BURST.duration_s + 10.0)
    with pytest.raises(ArmMovedError):
        cell.fire()
    assert cell.awaited_news == 1
    assert max(cell.proven_frames) < cell.confirmed
    assert cell.arrives_us(cell.confirmed - 1) <= 1e6 * MIDDLE_S


def test_the_proof_gets_no_frame_that_is_newer_than_the_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading the log takes so long that frames come meanwhile."""
    cell = Cell(BURST, take(BURST), poll_takes_s=0.06)
    given: list[tuple[int, int]] = []

    def spy(log: Any, frame_ids: Any, timestamps_ns: Any, *, complete: bool, **more: Any) -> Match:
        if not complete:
            given.append((len(frame_ids), cell.frames_at_poll))
        return match(log, frame_ids, timestamps_ns, complete=complete, **more)

    monkeypatch.setattr(burst_runner, "match", spy)
    cell.fire()
    assert {str(shot) for shot in cell.proven} == shots_of(cell)
    assert max(frames for frames, _ in given) > 5
    assert all(frames <= at_poll for frames, at_poll in given)


def test_a_frame_that_comes_after_the_last_edges_one_is_still_looked_at() -> None:
    """A surplus frame in the middle of the burst lets the count be full before the last frame is there."""
    what = take(BURST, surplus_us=(1e6 * MIDDLE_S,))
    cell = Cell(BURST, what)
    verdict = cell.fire()
    assert verdict.match.surplus.sum() == 1
    assert {str(shot) for shot in cell.proven} == shots_of(cell)


def test_a_surplus_frame_that_comes_last_of_all_is_seen() -> None:
    """It is still in transfer when the last step's frame has come."""
    clean = take(BURST)
    over_s = max(clean.frames_us[-1] / 1e6 + 0.02, (clean.edges_us[-1] + BURST.timing.on_us) / 1e6)
    last_round_s = 0.05 * np.ceil(over_s / 0.05)
    cell = Cell(BURST, take(BURST, surplus_us=(1e6 * (last_round_s + 0.009 - 0.02),)))
    verdict = cell.fire()
    assert np.flatnonzero(verdict.match.surplus).tolist() == [len(BURST.table)]
    assert {str(shot) for shot in cell.proven} == shots_of(cell)


def test_frames_that_need_all_the_time_that_the_camera_states_are_awaited() -> None:
    cell = Cell(BURST, take(BURST), delivery_s=0.045)
    verdict = cell.fire()
    assert not verdict.match.missing.any()
    assert {str(shot) for shot in cell.proven} == shots_of(cell)


def test_a_step_whose_led_drew_no_current_is_not_proven_but_told() -> None:
    what = take(BURST)
    log = what.log.copy()
    log["led_open"][10] = True
    cell = Cell(BURST, replace(what, log=log))
    verdict = cell.fire()
    assert verdict.dead == [BURST.shots[10]]
    assert BURST.shots[10] not in cell.proven


def test_a_step_that_ended_over_temperature_is_not_proven() -> None:
    what = take(BURST)
    log = what.log.copy()
    log["over_temperature"][10] = True
    cell = Cell(BURST, replace(what, log=log))
    cell.fire()
    assert BURST.shots[10] not in cell.proven


def test_an_arm_that_moves_finds_the_lights_off_before_anything_else() -> None:
    cell = Cell(BURST, take(BURST), moves_at_s=MIDDLE_S)
    with pytest.raises(ArmMovedError):
        cell.fire()
    assert cell.done[cell.done.index("started") + 1 :] == ["lights off", "camera disarmed", "BurstEnded"]


def test_a_burst_gave_light_until_the_box_had_switched_all_off() -> None:
    """As it does before Ctrl-Z suspends the program, which goes on hours later; an earlier answer says nothing."""
    for answers_s, ran_s in (((), MIDDLE_S), (((-0.2, -0.1),), MIDDLE_S), (((-0.2, -0.1), (0.03, 0.1)), 0.1)):
        cell = Cell(BURST, take(BURST), moves_at_s=MIDDLE_S, now_us=1e6)
        cell.switched_off_ns += [(round(1e9 * (1 + told)), round(1e9 * (1 + off))) for told, off in answers_s]
        with pytest.raises(ArmMovedError):
            cell.fire()
        (figures,) = cell.counted
        assert figures["table_ran_s"] == pytest.approx(ran_s, abs=0.05)


def test_an_upload_that_has_failed_is_heard_of_at_once_and_one_that_runs_is_not() -> None:
    """The arm may be in motion meanwhile, and is stopped then."""
    go_on = threading.Event()

    def fails(table: Any) -> None:
        go_on.wait(10.0)
        raise LookupError("a defect in the upload's thread")

    cell = Cell(BURST, take(BURST), on_load=fails)
    cell.runner.prepare(BURST)
    cell.runner.look_at_upload()
    go_on.set()
    with pytest.raises(LookupError):
        wait_until(cell.runner.look_at_upload, "its failure")
    cell.runner.look_at_upload()


def test_after_a_push_the_upload_that_lights_off_ended_is_made_anew() -> None:
    def ended(table: Any) -> None:
        if len(table) == len(following.table) and not tried:
            tried.append(len(table))
            raise DeviceError("led box", expected="time", happened="lights off", remedy="")

    tried: list[int] = []
    following = whole_burst(12)
    cell = Cell(BURST, take(BURST), moves_at_s=MIDDLE_S, on_load=ended)
    with pytest.raises(ArmMovedError):
        cell.fire(following)
    cell.moves_at_s, cell.arrived = np.inf, 0
    cell.proven.clear()
    cell.fire(following)
    assert tried
    assert {str(shot) for shot in cell.proven} == shots_of(cell)


def test_a_burst_that_becomes_known_in_the_middle_is_uploaded_before_the_end() -> None:
    following = whole_burst(12)
    cell = Cell(BURST, take(BURST))
    asked_s: list[float] = []

    def known() -> Any:
        asked_s.append(cell.burst_us * 1e-6)
        return following if asked_s[-1] > MIDDLE_S else None

    cell.runner.fire(BURST, known)
    assert MIDDLE_S < asked_s[-1] < BURST.duration_s, "and not asked for again"
    wait_until(lambda: cell.box.uploads[-1] == len(following.table), "its upload")


def test_a_choice_that_the_disk_refuses_ends_the_burst_and_the_cell_is_made_safe_first() -> None:
    def refused() -> None:
        raise StorageError("the journal: no space left")

    cell = Cell(BURST, take(BURST))
    with pytest.raises(StorageError):
        cell.runner.fire(BURST, refused)
    assert cell.done[cell.done.index("started") + 1] == "made safe"
    assert cell.counted, "its light is counted"


def test_the_last_records_are_asked_for_as_soon_as_the_table_is_over() -> None:
    cell = Cell(BURST, take(BURST))
    looks_s: list[float] = []
    poll_log = cell.box.poll_log

    def look() -> Any:
        looks_s.append(cell.burst_us * 1e-6)
        return poll_log()

    cell.box.poll_log = look  # type: ignore[method-assign]
    cell.fire()
    after_s = [look_s for look_s in looks_s if look_s >= BURST.duration_s]
    assert after_s[0] < BURST.duration_s + 0.002
    assert len(looks_s) < 20, "it does not look all the time"


def test_a_box_that_logs_nothing_more_is_a_time_out_and_the_cell_is_made_safe_first() -> None:
    what = take(BURST)
    cell = Cell(BURST, replace(what, edges_us=np.where(np.arange(len(what.edges_us)) < 20, what.edges_us, np.inf)))
    with pytest.raises(DeviceTimeout, match=f"20 of {len(BURST.table)} steps are in its log"):
        cell.fire()
    assert cell.done[cell.done.index("started") + 1] == "made safe"


REFUSED = DeviceError("led box", expected="to begin", happened="it did not", remedy="None.")


@pytest.mark.parametrize("error", [REFUSED, ZeroDivisionError("a defect")], ids=repr)
def test_a_burst_that_cannot_begin_leaves_a_safe_cell(error: Exception) -> None:
    cell = Cell(BURST, take(BURST), start_fails=error)
    with pytest.raises(type(error)):
        cell.fire()
    assert cell.done == ["camera armed", "started", "made safe", "BurstEnded"]


def test_marks_of_what_is_taken_again_are_seen_before_they_are_freed() -> None:
    burst = BURST.only({label for label in BURST.labels[10:20] if label})
    cell = Cell(burst, take(burst))
    cell.fire()
    unkept = [step for step, label in enumerate(burst.labels) if label is None]
    assert len(unkept) >= 2
    assert cell.marks_seen == unkept
    assert len(cell.proven) == 10


def test_slots_of_frames_without_proof_are_freed() -> None:
    what = take(BURST, surplus_us=(1e6 * MIDDLE_S + 3000.0,))
    cell = Cell(BURST, what)
    cell.fire()
    assert len(cell.freed) == len(what.truth) - len(cell.proven)
