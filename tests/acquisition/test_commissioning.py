"""Commissioning: a right cell passes every step, and each step goes red at what it is for."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cells import Ended, finish, here, start
from commissioned_cells import ABOVE_THE_BALL_DEG, Eye, Wrapped, ball_cell, board_cell, opened_bench, with_devices
from places import REPO

from coupole.acquisition.commissioning import arm_steps, lamp_step, light_timing, session
from coupole.acquisition.commissioning.bench import Bench, Findings, StepFailedError
from coupole.acquisition.commissioning.light_directions import deviations_deg
from coupole.acquisition.commissioning.reduced_speed import REDUCED_MM_S, at_reduced_speed, greatest_speeds_deg_s
from coupole.acquisition.observer import Control
from coupole.errors import DeviceError, DeviceTimeout, Interrupted
from coupole.kinematics import link_frames
from coupole.motion.itinerary import bodies_of
from coupole.plan.cell import read_cell
from coupole.plan.rig_devices import described_arm
from coupole.preflight.commissioned import STEPS
from sim.world.client import World

SWAPPED = (180, 720)
"""LEDs of the wrong cell whose wires are swapped: on opposite sides of the dome."""


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ended]:
    """The rig of a right cell, and how its whole commissioning ended."""
    cell = board_cell(tmp_path_factory.mktemp("right"), speed=8.0)
    board = ("--board", cell.folder / "board.yaml")
    return cell.rig, here("commission", cell.rig, "--name", "A. Person", "--yes", "--json", *board)


@pytest.fixture(scope="module")
def wrong_cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Bench, Any]]:
    cell = ball_cell(tmp_path_factory.mktemp("wrong"), speed=8.0, dome={"swapped": [SWAPPED]})
    with opened_bench(cell) as bench:
        yield bench, cell


@pytest.fixture
def wrong(wrong_cell: tuple[Bench, Any]) -> Iterator[Bench]:
    """A cell with two swapped LEDs, opened; what else is wrong the test adds. The arm is back at the end."""
    bench = wrong_cell[0]
    yield replace(bench, findings=Findings())
    if np.abs(bench.joints_deg() - ABOVE_THE_BALL_DEG).max() > 0.01:
        bench.opened.robot.move_to(np.array(ABOVE_THE_BALL_DEG))
        bench.opened.robot.wait_settled()


def missed(bench: Bench) -> list[str]:
    return [one.what for one in bench.findings.limits if not one.is_met]


def test_a_right_cell_passes_every_step_and_its_record_says_who_and_with_what(right: tuple[Path, Ended]) -> None:
    _, ended = right
    assert ended.code == 0, ended.err
    assert ended.document["passed"] is True
    assert ended.document["steps"] == dict.fromkeys(STEPS, True)
    text = Path(ended.document["record"]).read_text()
    assert text.count('"person": "A. Person"') == len(STEPS)
    assert "SIM-0001" in text
    page = Path(ended.document["record"]).with_suffix(".html").read_text()
    assert "Simulated: no real cell." in page
    assert "not passed" not in page


def test_what_has_passed_is_not_done_again_and_a_changed_box_only_asks_for_its_own_steps(
    right: tuple[Path, Ended],
) -> None:
    rig, _ = right
    settings = json.loads(rig.read_text())
    settings["ledbox"]["settings"]["edge_width_us"] = 60
    other = rig.with_name("other.yaml")
    other.write_text(json.dumps(settings))
    again = here("commission", rig, "--name", "B", "--yes")
    assert again.code == 0, again.err
    assert "every step has passed" in again.err
    begun = here("commission", other, "--name", "B", typed="y\nn\n")
    assert begun.code == 130
    assert "Step lamps" in begun.err
    assert not any(f"Step {step}:" in begun.err for step in ("cycle", "axes", "stopping", "emergency-stop"))


def test_a_controller_with_another_cycle_than_the_drivers_is_found(wrong: Bench) -> None:
    robot = wrong.opened.robot
    thrice = Wrapped(robot, statistics=lambda: {"packets": 3.0 * robot.statistics()["packets"]})
    bench = with_devices(wrong, robot=thrice)
    arm_steps.cycle(bench)
    assert missed(bench) == ["deviation of the controller's cycle from 12 ms"]


def test_the_words_describe_what_the_stand_ins_own_kinematics_does(
    wrong_cell: tuple[Bench, Any], wrong: Bench
) -> None:
    eye = _eye(wrong_cell)
    bench = replace(wrong, person=eye)
    arm_steps.axes(bench)
    assert [answer.yes for answer in bench.findings.answers] == [True] * 6
    assert missed(bench) == []


def test_an_axis_that_the_rig_has_with_the_wrong_sign_is_seen_by_the_person(
    wrong_cell: tuple[Bench, Any], wrong: Bench
) -> None:
    arm = described_arm(wrong.cell.rig)
    assert arm is not None
    assert arm.arm.chain.axes[0] == "-z"
    chain = replace(arm.arm.chain, axes=("+z", *arm.arm.chain.axes[1:]))
    flipped = arm.model_copy(update={"arm": replace(arm.arm, chain=chain)})
    cell = replace(wrong.cell, rig=wrong.cell.rig.model_copy(update={"arm": flipped}))
    bench = replace(wrong, cell=cell, person=_eye(wrong_cell))
    arm_steps.axes(bench)
    assert [answer.yes for answer in bench.findings.answers] == [False]
    assert "Compare A1" in bench.findings.remedy


def test_an_axis_that_does_not_turn_as_it_is_told_is_measured(wrong: Bench) -> None:
    robot = wrong.opened.robot
    home_deg = np.array(robot.measured().joints_deg)

    def mirrored(joints_deg: Any) -> None:
        target_deg = np.array(joints_deg)
        target_deg[0] = 2.0 * home_deg[0] - target_deg[0]
        robot.move_to(target_deg)

    bench = with_devices(wrong, robot=Wrapped(robot, move_to=mirrored))
    arm_steps.axes(bench)
    assert missed(bench) == ["A1: error of its measured turn"]


def test_a_stop_that_takes_longer_than_promised_is_found(wrong: Bench) -> None:
    robot, clock = wrong.opened.robot, wrong.opened.clock

    def late() -> None:
        clock.sleep(0.5)
        robot.stop()

    bench = with_devices(wrong, robot=Wrapped(robot, stop=late))
    arm_steps.stopping(bench)
    assert missed(bench)
    assert all("angle to a stop" in what for what in missed(bench))


def test_swapped_leds_are_named_and_no_others(wrong: Bench) -> None:
    lamp_step.lamps(wrong)
    assert missed(wrong) == [
        *(f"LED {led}: angle from its place in the table" for led in SWAPPED),
        "largest deviation from the LED table",
    ]


def test_a_stop_is_heard_between_two_leds_while_their_directions_are_computed(wrong: Bench) -> None:
    control, shown = Control(), []

    def say(job: str, done: int, of: int) -> None:
        shown.append((job, done, of))
        if job.startswith("directions"):
            control.stop_by(signal.SIGINT)

    with pytest.raises(Interrupted):
        lamp_step.lamps(replace(wrong, control=control, bars=lambda: nullcontext(say)))
    assert shown[11] == ("LEDs", 12, 12)
    assert shown[12:] == [("directions, round 1 of at most 4", 1, 12)]


def test_a_dead_led_is_named(wrong_cell: tuple[Bench, Any], wrong: Bench) -> None:
    _world(wrong_cell).ask("fault", fault={"kind": "dead_led", "led": 90})
    lamp_step.lamps(wrong)
    assert "LED 90: steps in which it drew no current" in missed(wrong)


def test_a_trigger_that_comes_late_is_measured_by_its_light(wrong: Bench) -> None:
    box: Any = wrong.opened.ledbox

    def later(table: Any) -> Any:
        shifted = table.copy()
        shifted["trigger_delay_us"] += 400
        return shifted

    late: Any = Wrapped(
        box, load=lambda table: box.load(later(table)), start=lambda table: box.start(later(table))
    )  # type: ignore[attr-defined]
    bench = with_devices(wrong, ledbox=late)
    light_timing.trigger(bench)
    assert missed(bench) == ["delay from edge to exposure"]
    assert bench.findings.limits[-1].found == pytest.approx(400, abs=60)


def test_a_trigger_that_jitters_is_found(wrong: Bench) -> None:
    camera, random = wrong.opened.camera, np.random.default_rng(1)

    def jittered(timeout_s: float) -> Any:
        frame = camera.next_frame(timeout_s)
        if frame is not None:
            frame.timestamp_ns += int(random.normal(0.0, 100e3))
        return frame

    bench = with_devices(wrong, camera=Wrapped(camera, next_frame=jittered))
    light_timing.trigger(bench)
    assert missed(bench) == ["largest jitter from edge to timestamp"]


def test_a_watchdog_that_is_off_is_found_and_the_light_goes_out_all_the_same(
    wrong_cell: tuple[Bench, Any], wrong: Bench
) -> None:
    box: Any = wrong.opened.ledbox
    box._scpi.ask(":SYST:WATC 0", 0)
    light_timing.watchdog(wrong)
    assert "last light after the host's last command" in missed(wrong)
    assert "watchdogs that the box does not report" in missed(wrong)
    assert _world(wrong_cell).ask("state")["shining"] == []


def test_a_watchdog_that_the_rig_switches_off_is_refused(wrong: Bench) -> None:
    ledbox = wrong.cell.rig.ledbox
    off = ledbox.model_copy(update={"settings": {**ledbox.settings, "watchdog_s": 0}})
    cell = replace(wrong.cell, rig=wrong.cell.rig.model_copy(update={"ledbox": off}))
    with pytest.raises(StepFailedError, match="watchdog"):
        light_timing.watchdog(replace(wrong, cell=cell))


@pytest.mark.parametrize("name", ["sim.yaml", "sim-eki.yaml", "sim-ur5e.yaml"])
def test_no_point_of_the_arm_is_faster_than_reduced_speed(name: str) -> None:
    """By finite differences of all bodies' ends, in random postures, with all axes at their greatest speeds."""
    cell = read_cell(REPO / "configs/rigs" / name)
    slow = at_reduced_speed(cell.rig, bodies_of(cell.rig, cell.leds, np.zeros((0, 3, 3))))
    arm, speeds = described_arm(slow), greatest_speeds_deg_s(slow)
    assert arm is not None
    random, fastest_mm_s, dt_s = np.random.default_rng(1), 0.0, 1e-3
    ends = [(7, np.array(at)) for body in slow.tool for at in (body.from_mm, body.to_mm)]
    ends += [
        (link.link, np.array(at))
        for link in arm.links
        for part in link.capsules
        for at in (part.from_mm, part.to_mm)
    ]
    for _ in range(200):
        joints = random.uniform(*np.array(arm.arm.limits_deg).T)
        ways = random.choice([-1.0, 1.0], 6) * speeds * dt_s
        one, other = link_frames(arm.arm, joints), link_frames(arm.arm, joints + ways)
        for link, at in ends:
            way = (other[link] - one[link]) @ np.append(at, 1.0)
            fastest_mm_s = max(fastest_mm_s, float(np.linalg.norm(way[:3])) / dt_s)
    assert 0.2 * REDUCED_MM_S < fastest_mm_s <= REDUCED_MM_S


def test_directions_of_light_are_found_from_a_matte_ball_and_a_flat_tile_tells_none() -> None:
    random = np.random.default_rng(3)
    lights = random.normal((0.0, 0.0, 2.0), 1.0, (20, 3))
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    normals = random.normal(size=(3, 500))
    normals /= np.linalg.norm(normals, axis=0)
    normals[2] = abs(normals[2])
    ball = np.clip(lights @ normals, 0.0, None) * 1000.0
    order = np.arange(20)
    order[[4, 15]] = 15, 4
    angles_deg, spread = deviations_deg(ball[order], lights)
    apart_deg = np.degrees(np.arccos(lights[4] @ lights[15]))
    assert angles_deg[[4, 15]] == pytest.approx(apart_deg, abs=1.0)
    assert np.delete(angles_deg, [4, 15]).max() < 1.0
    assert spread > lamp_step._LEAST_SPREAD
    tile = lights @ np.tile([[0.0], [0.0], [1.0]], 500) * 1000.0
    assert deviations_deg(tile, lights)[1] < lamp_step._LEAST_SPREAD


def _world(wrong: tuple[Bench, Any]) -> World:
    endpoints: Any = wrong[0].opened.world_endpoints
    return World(endpoints)


def _eye(wrong: tuple[Bench, Any]) -> Eye:
    world = _world(wrong)
    return Eye(wrong[1], lambda: list(world.ask("state")["joints_deg"]))


def test_a_device_that_failed_because_the_program_stood_still_is_not_blamed(
    wrong: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def act(bench: Bench) -> None:
        bench.control.hold("the program did not run for 3.0 s")
        raise DeviceTimeout("led box", expected="time for INIT", happened="lights off", remedy="See why.")

    monkeypatch.setitem(session.ACTS, "watchdog", act)
    bench = replace(wrong, control=Control())
    with pytest.raises(Interrupted, match="the program did not run for 3"):
        session._run_step("watchdog", bench, bench.cell, "A. Person")


@pytest.mark.parametrize(
    "spoilt",
    [
        DeviceTimeout(
            "led box", expected="time for INIT", happened="the lights were switched off", remedy="See why."
        ),
        StepFailedError("the arm did not reach its target"),
        None,
    ],
    ids=["a device fails", "the step fails", "a figure is wrong"],
)
def test_a_step_that_the_person_stops_has_no_result(
    wrong: Bench, monkeypatch: pytest.MonkeyPatch, spoilt: Exception | None
) -> None:
    def act(bench: Bench) -> None:
        bench.control.stop_by(signal.SIGTERM)
        bench.findings.at_most("LED 3: steps in which it drew no current", 1, 0, "")
        if spoilt is not None:
            raise spoilt

    monkeypatch.setitem(session.ACTS, "lamps", act)
    bench = replace(wrong, control=Control())
    with pytest.raises(Interrupted) as interruption:
        session._run_step("lamps", bench, bench.cell, "A. Person")
    assert interruption.value.exit_code == 128 + signal.SIGTERM


@pytest.mark.parametrize(("is_stopped", "error"), [(True, Interrupted), (False, DeviceError)])
def test_a_flash_whose_record_does_not_come_is_the_boxs_failure_unless_it_was_stopped(
    wrong: Bench, *, is_stopped: bool, error: type[Exception]
) -> None:
    """A stop switches the box off, which forgets the step's record."""
    box: Any = wrong.opened.ledbox
    control = Control()

    def forgets() -> Any:
        if is_stopped:
            control.stop_by(signal.SIGINT)
        return box.poll_log()[:0]

    bench = replace(with_devices(wrong, ledbox=Wrapped(box, poll_log=forgets)), control=control)
    with pytest.raises(error):
        lamp_step.lamps(bench)


def test_a_stop_in_a_motion_keeps_the_earlier_result_and_notes_no_fault_of_the_arm(
    right: tuple[Path, Ended],
) -> None:
    rig, ended = right
    record = Path(ended.document["record"])
    before = record.read_text()
    process = start("commission", rig, "--name", "B", "--yes", "--only", "axes")
    assert process.stderr is not None
    assert any("A1 turns by" in line for line in process.stderr)
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    stopped = finish(process)
    assert stopped.code == 130, stopped.err
    assert record.read_text() == before
    assert here("arm", rig, "home", "--yes").code == 0


def test_coupole_stop_ends_a_commissioning_in_its_motion(right: tuple[Path, Ended]) -> None:
    rig, _ = right
    process = start("commission", rig, "--name", "B", "--yes", "--only", "axes")
    assert process.stderr is not None
    assert any("A1 turns by" in line for line in process.stderr)
    stopped = here("stop", rig)
    assert stopped.code == 0, stopped.err
    assert process.poll() is not None, "it has ended when the answer is given"
    assert f"stopped: commission, B {rig}; its process {process.pid} has ended" in " ".join(stopped.err.split())
    assert finish(process).code == 130
