"""A call of a device or a disk that never returns: the cell is safe, it is told, and the process ends."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import cells
import numpy as np
import pytest
from cells import TOP, CellFolder, Ended
from never_returning import Hang, Session, begin
from real_cells import true_dose_lux_h

from sim.world.client import World

IN_BURST, IN_MOTION = "led box.start", "robot.move_to"
SHORT_DEG = 2.0
"""By which an arm that braked at once is short of its target, at least."""
FEW_LIGHTS = {"kind": "every", "every": 60}


@pytest.fixture
def cell(tmp_path: Path) -> CellFolder:
    """One view of 18 LEDs, in a world that outlives its controllers."""
    made = CellFolder(tmp_path)
    made.rig_data["ledbox"]["settings"]["watchdog_s"] = 5.0
    made.join()
    made.write(views=[TOP], lights=FEW_LIGHTS)
    return made


def dark_and_still(world: World) -> bool:
    state = world.ask("state")
    return not (state["shining"] or state["panels"] or state["arm_moving"])


def told(cell: CellFolder, ended: Ended, *words: str) -> None:
    """Terminal and journal tell of the call; the journal has an end, the JSON the run."""
    journal = " ".join(event["message"] for event in cells.events(cell.run_folder, "fault"))
    for word in words:
        assert word in ended.err
        assert word in journal
    assert cells.events(cell.run_folder)[-1]["event"] == "stop"
    assert ended.document["run"] == str(cell.run_folder)


def can_be_resumed(cell: CellFolder) -> None:
    with cell.world():
        resumed = cell.acquire("--resume", cell.run_folder)
        if resumed.code == 4 and "confirmation by a person" in resumed.err:
            cell.confirm()
            resumed = cell.acquire("--resume", cell.run_folder)
    assert resumed.code == 0, resumed
    cells.assert_each_shot_proven_once(cell.run_folder)


more = [
    pytest.param(name, after, marks=pytest.mark.full, id=name)
    for name, after in {
        "camera.arm": "",
        "camera.configure": "",
        "camera.statistics": IN_BURST,
        "led box.load": "",
        "led box.start": "",
        "led box.edges": "",
        "led box.board_temperature_c": "",
        "robot.wait_settled": "",
        "robot.move_to": "",
        "robot.stopping_deg": "",
    }.items()
]


@pytest.mark.parametrize(
    ("name", "after", "code"),
    [
        pytest.param("disk.fdatasync", "camera.arm", 6, id="a disk before a burst"),
        pytest.param("robot.measured", "camera.configure", 4, id="an arm before a burst"),
        pytest.param("led box.load", "", 4, id="a table that is uploaded"),
        pytest.param("robot.measured", "robot.stopping_deg", 4, id="an arm before a motion"),
    ],
)
def test_what_returns_after_it_was_given_up_lights_and_moves_nothing_more(
    name: str, after: str, code: int, cell: CellFolder
) -> None:
    """The thread that was left behind ends: the cell was made safe, and nobody watches."""
    with cell.world() as world:
        before = world.ask("state")["joints_deg"]
        session = begin(cell, Hang(name, after, returns=True))
        session.wait_until_it_hangs()
        ended = session.ended()
        assert (ended.code, dark_and_still(world)) == (code, True), ended
        assert true_dose_lux_h(cell, world).max() == 0.0
        if after == "robot.stopping_deg":
            assert world.ask("state")["joints_deg"] == pytest.approx(before, abs=0.05)
    can_be_resumed(cell)


@pytest.mark.parametrize(
    ("name", "after"),
    [
        pytest.param("camera.next_frame", IN_BURST, id="camera.next_frame"),
        pytest.param("led box.poll_log", IN_BURST, id="led box.poll_log"),
        pytest.param("robot.measured", IN_MOTION, id="robot.measured in motion"),
        *more,
    ],
)
def test_a_session_ends_by_itself_when_a_call_of_a_device_never_returns(
    cell: CellFolder, name: str, after: str
) -> None:
    device, _, call = name.rpartition(".")
    with cell.world() as world:
        session = begin(cell, Hang(name, after))
        ended = session.ended()
        cells.wait_until(lambda: dark_and_still(world), "a dark cell and an arm at rest")
    assert ended.code == 4, ended
    assert f"{device}: expected the call `{call}` to return" in ended.err
    if name not in ("led box.board_temperature_c", "robot.stopping_deg"):  # before there is a run
        told(cell, ended, f"{device}: expected the call `{call}` to return")
        can_be_resumed(cell)


def asked_to_stop(session: Session, how: str, cell: CellFolder) -> None:
    if how == "stop":
        assert cells.here("stop", cell.run_folder).code in (0, 4)
    else:
        os.kill(session.process.pid or 0, signal.Signals[how])


@pytest.mark.parametrize(
    ("name", "after", "how", "code"),
    [
        ("camera.next_frame", IN_BURST, "SIGINT", 130),
        ("camera.configure", "", "SIGTERM", 143),
        ("led box.poll_log", IN_BURST, "stop", 130),
        pytest.param("robot.measured", IN_MOTION, "SIGINT", 130, marks=pytest.mark.full),
        pytest.param("camera.disarm", IN_BURST, "SIGHUP", 129, marks=pytest.mark.full),
    ],
)
def test_a_session_that_hangs_ends_when_it_is_asked_to(
    cell: CellFolder, name: str, after: str, how: str, code: int
) -> None:
    with cell.world() as world:
        session = begin(cell, Hang(name, after))
        session.wait_until_it_hangs()
        asked_to_stop(session, how, cell)
        cells.wait_until(lambda: dark_and_still(world), "a dark cell and an arm at rest")
        ended = session.ended()
    assert ended.code == code, ended
    assert cells.events(cell.run_folder, "stop")[-1]["outcome"] == "interrupted"
    can_be_resumed(cell)


@pytest.mark.parametrize("how", ["", "SIGINT"])
def test_a_device_that_hangs_while_it_is_opened_is_told_and_the_process_ends(cell: CellFolder, how: str) -> None:
    with cell.world() as world:
        session = begin(cell, Hang("camera.open"))
        session.wait_until_it_hangs()
        if how:
            asked_to_stop(session, how, cell)
        ended = session.ended()
        assert dark_and_still(world)
    assert ended.code == (130 if how else 4), ended
    if not how:
        assert "camera: expected the call `open` to return" in ended.err


def test_a_camera_that_hangs_when_it_is_closed_is_told_after_a_whole_run(cell: CellFolder) -> None:
    with cell.world():
        ended = begin(cell, Hang("camera.close")).ended()
    assert ended.code == 4, ended
    assert "`close`" in ended.err
    assert ended.document["missing"] == 0
    assert cells.events(cell.run_folder, "stop")[-1]["outcome"] == "done"
    assert (cell.run_folder / "report.html").exists()


def test_lights_that_cannot_be_switched_off_are_told_and_the_process_ends(cell: CellFolder) -> None:
    with cell.world() as world:
        ended = begin(cell, Hang("led box.lights_off", again=True)).ended()
        cells.wait_until(lambda: dark_and_still(world), "a dark cell, by the box's watchdog at the latest")
    assert ended.code == 4, ended
    told(cell, ended, "not sure that it is safe (lights off)")
    assert ended.document["unsafe"]


@pytest.mark.parametrize(
    ("name", "file"),
    [
        pytest.param("disk.pwrite", "/views/", id="frames"),
        pytest.param("disk.fdatasync", "journal", id="the journal"),
        pytest.param("disk.fsync", "/views/", id="a new view", marks=pytest.mark.full),
        pytest.param("disk.posix_fallocate", "/views/", id="the allocation of a view", marks=pytest.mark.full),
        pytest.param("disk.fsync", "/inputs/", id="the copies of inputs", marks=pytest.mark.full),
    ],
)
def test_a_session_ends_by_itself_when_its_disk_never_answers(cell: CellFolder, name: str, file: str) -> None:
    with cell.world() as world:
        ended = begin(cell, Hang(name, file=file, again=True)).ended()
        cells.wait_until(lambda: dark_and_still(world), "a dark cell and an arm at rest")
    assert ended.code == 6, ended
    assert "the disk has not answered" in ended.err
    if "inputs" not in file:
        assert ended.document["run"] == str(cell.run_folder)
        can_be_resumed(cell)


def test_frames_that_a_disk_does_not_take_leave_room_for_the_journals_last_words(cell: CellFolder) -> None:
    with cell.world():
        ended = begin(cell, Hang("disk.fdatasync", file="/views/", again=True)).ended()
    assert ended.code == 6, ended
    told(cell, ended, "the disk has not answered")
    assert ended.document["proven"] == 0


def test_a_disk_that_hangs_ends_when_the_session_is_asked_to(cell: CellFolder) -> None:
    with cell.world() as world:
        session = begin(cell, Hang("disk.pwrite", file="/views/", again=True))
        session.wait_until_it_hangs()
        asked_to_stop(session, "SIGTERM", cell)
        ended = session.ended()
        cells.wait_until(lambda: dark_and_still(world), "a dark cell and an arm at rest")
    assert ended.code == 143, ended
    can_be_resumed(cell)


def test_a_disk_that_hangs_at_the_report_is_told_after_a_whole_run(cell: CellFolder) -> None:
    with cell.world():
        ended = begin(cell, Hang("disk.fsync", file="manifest", after="led box.start", again=True)).ended()
    assert ended.code == 0, ended
    assert "could not be written" in ended.err
    assert ended.document["missing"] == 0


@pytest.mark.parametrize(
    ("words", "name", "after"),
    [
        pytest.param(("live", "PLAN", "--yes"), "camera.next_frame", "", id="live"),
        pytest.param(("devices", "--rig", "RIG"), "camera.self_test", "", id="devices"),
        pytest.param(("meter", "PLAN", "--yes"), "robot.measured", IN_MOTION, id="meter", marks=pytest.mark.full),
        pytest.param(("bench", "RIG", "--yes"), "robot.close", "", id="bench", marks=pytest.mark.full),
        pytest.param(("commission", "RIG", "--name", "A", "--yes"), "robot.measured", IN_MOTION, id="commission"),
    ],
)
def test_whatever_else_opens_a_cell_ends_too(
    cell: CellFolder, words: tuple[str, ...], name: str, after: str
) -> None:
    paths = {"PLAN": cell.plan, "RIG": cell.rig}
    with cell.world() as world:
        session = begin(cell, Hang(name, after), *(paths.get(word, word) for word in words))
        if words[0] == "bench":
            cells.wait_until(lambda: "Ctrl-C ends it" in session.words, "the bench")
            os.kill(session.process.pid or 0, signal.SIGINT)
        ended = session.ended()
        cells.wait_until(lambda: dark_and_still(world), "a dark cell and an arm at rest")
    assert ended.code == 4, ended
    assert f"the call `{name.partition('.')[2]}` to return" in ended.err


@pytest.mark.parametrize(("name", "code"), [("robot.measured", 4), ("motion.file", 6)])
def test_an_arm_whose_watching_thread_hangs_brakes_on_its_way(cell: CellFolder, name: str, code: int) -> None:
    cell.rig_data["robot"]["settings"]["attention_s"] = 0.1
    cell.write()
    with cell.world() as world:
        session = begin(cell, Hang(name, IN_MOTION))
        session.wait_until_it_hangs()
        cells.wait_until(lambda: not world.ask("state")["arm_moving"], "an arm at rest")
        there_deg = world.ask("state")["joints_deg"]
        assert session.ended().code == code
    target_deg = cells.events(cell.run_folder, "move")[-1]["joints_deg"][-1]
    assert np.abs(np.subtract(there_deg, target_deg)).max() > SHORT_DEG
