"""Runs that end in the middle, and what `--resume` makes of them: nothing lost, nothing taken twice."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import SIDE, TOP, CellFolder, Ended, Stored
from expected_pictures import mislabelled
from in_part import in_part

from coupole.preflight.job import read_job
from coupole.storage.run import Run
from sim.world.client import World

MANY_LIGHTS = {"kind": "every", "every": 4}
"""270 LEDs: a burst of 2.8 s."""
OTHER_SIDE = {**SIDE, "lights": cells.SOME_LIGHTS}
"""The view after that burst: it is only completed."""
SPEED = 2.0


@dataclass(frozen=True)
class Killed:
    """A run whose controller was killed in the middle of its first burst."""

    folder: Path
    run: Path
    world_pids: list[int]

    def copy(self, folder: Path) -> tuple[CellFolder, Path]:
        """The cell, its run and its files once more, to go on with."""
        shutil.copytree(self.folder, folder, dirs_exist_ok=True)
        return _self_contained_cell(folder, write=False), folder / self.run.relative_to(self.folder)


def _self_contained_cell(folder: Path, *, write: bool = True) -> CellFolder:
    """A cell whose plan, rig, dome and mesh lie beside each other and name each other without a path."""
    cell = CellFolder(folder, speed=SPEED, write_now=write)
    cell.rig_data["dome"]["leds"] = "coupole.csv"
    cell.rig_data["storage"]["folder"] = "storage"
    cell.plan_data["object"]["mesh"] = "relief.ply"
    if write:
        shutil.copy(cells.REPO / "configs/domes/coupole.csv", folder)
        shutil.copy(cells.COARSE_RELIEF, folder)
        cell.write(views=[TOP, OTHER_SIDE], lights=MANY_LIGHTS, order="as_written")
    return cell


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Killed:
    folder = tmp_path_factory.mktemp("killed")
    cell = _self_contained_cell(folder)
    process = cell.start_acquire(anew=True)
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 20, "proven frames")
    worlds = cells.children(process.pid)
    process.kill()
    cells.finish(process)
    return Killed(folder, run, worlds)


def _labels(run: Path) -> dict[str, list[str]]:
    """Of each view's frames."""
    found: dict[str, list[str]] = cells.about(run)["labels"]
    return found


def _proven(run: Path) -> dict[str, dict[str, Any]]:
    return {event["shot"]: event for event in cells.events(run, "frame")}


def _pixels_of(run: Path, shots: Any) -> dict[str, bytes]:
    frames: dict[str, Stored] = cells.stored(run)
    return {shot: frames[shot].pixels.tobytes() for shot in shots}


# -- kill -9 --------------------------------------------------------------------------------------------------


def test_a_killed_run_has_kept_part_of_a_burst(killed: Killed) -> None:
    assert 20 < len(_proven(killed.run)) < len(_labels(killed.run)["top"])
    assert cells.events(killed.run, "stop") == []
    found = cells.here("status", killed.run, "--json").document
    assert (found["state"], found["faults"]) == ("interrupted", [])
    assert "it was killed, or the power failed" in found["reason"]
    assert found["go_on"] == f"coupole acquire --resume {killed.run}"
    assert found["frames_left"] == sum(map(len, _labels(killed.run).values())) - len(_proven(killed.run))


def test_verify_says_five_of_a_run_that_is_not_complete(killed: Killed) -> None:
    verified = cells.here("verify", killed.run, "--json")
    assert verified.code == 5
    assert verified.document["bad"] == []
    assert verified.document["ok"] is False


def test_the_world_of_a_killed_controller_ends_with_it(killed: Killed) -> None:
    assert killed.world_pids
    cells.wait_until(lambda: not any(map(cells.alive, killed.world_pids)), "the world's end")


@dataclass(frozen=True)
class Resumed:
    """A killed run that was brought to its end, and what it held before that."""

    cell: CellFolder
    run: Path
    ended: Ended
    proven_before: dict[str, dict[str, Any]]
    bytes_before: dict[str, bytes]


@pytest.fixture(scope="module")
def resumed(killed: Killed, tmp_path_factory: pytest.TempPathFactory) -> Resumed:
    cell, run = killed.copy(tmp_path_factory.mktemp("resumed"))
    proven = _proven(run)
    kept = _pixels_of(run, proven)
    return Resumed(cell, run, cell.acquire("--resume", run), proven, kept)


def test_a_killed_run_is_resumed_to_completeness(resumed: Resumed) -> None:
    assert resumed.ended.code == 0, resumed.ended.err
    found = resumed.ended.document
    assert (found["run"], found["proven"], found["missing"]) == (str(resumed.run), 270 + 54, 0)
    cells.assert_each_shot_proven_once(resumed.run)


def test_what_was_proven_before_a_kill_is_not_taken_again(resumed: Resumed) -> None:
    after = _proven(resumed.run)
    assert {shot: after[shot] for shot in resumed.proven_before} == resumed.proven_before
    resumed_burst = cells.events(resumed.run, "burst")[0]
    marks = 10  # they are fired with every burst
    assert resumed_burst["steps"] <= len(_labels(resumed.run)["top"]) - len(resumed.proven_before) + marks


def test_bytes_that_were_proven_before_a_kill_stay_as_they_were(resumed: Resumed) -> None:
    assert _pixels_of(resumed.run, resumed.proven_before) == resumed.bytes_before


def test_labels_stay_true_over_a_kill_and_a_resume(resumed: Resumed) -> None:
    resumed.cell.plan_data["object"]["mesh"] = str(resumed.cell.folder / "relief.ply")
    resumed.cell.rig_data["dome"]["leds"] = str(resumed.cell.folder / "coupole.csv")
    assert mislabelled(resumed.cell, resumed.run) == []


def test_a_torn_last_line_of_the_journal_does_not_count(killed: Killed, tmp_path: Path) -> None:
    cell, run = killed.copy(tmp_path)
    journal = run / "journal.jsonl"
    whole = journal.read_bytes()
    last = whole.rstrip(b"\n").rpartition(b"\n")[2]
    assert b'"frame"' in last
    journal.write_bytes(whole[: -len(last) // 2])
    assert cell.acquire("--resume", run).code == 0
    cells.assert_each_shot_proven_once(run)


def test_a_run_without_its_last_line_takes_that_shot_again(killed: Killed, tmp_path: Path) -> None:
    """Its frame stands in the file as proven, but only the journal's word counts."""
    cell, run = killed.copy(tmp_path)
    journal = run / "journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    lost = json.loads(lines[-1])["shot"]
    journal.write_bytes(b"".join(lines[:-1]))
    assert cell.acquire("--resume", run).code == 0
    cells.assert_each_shot_proven_once(run)
    assert lost in cells.stored(run)


# -- what is resumed must be what was begun -------------------------------------------------------------------


@pytest.mark.parametrize("name", ["plan.yaml", "rig.yaml", "relief.ply", "coupole.csv"])
def test_a_run_is_not_resumed_with_a_changed_file(killed: Killed, tmp_path: Path, name: str) -> None:
    cell, run = killed.copy(tmp_path)
    before = (run / "journal.jsonl").read_bytes()
    changed = tmp_path / name
    match changed.suffix:
        case ".yaml":
            data = json.loads(changed.read_text())
            data |= {"gain_db": 3} if name == "plan.yaml" else {"sensor": {**data["sensor"], "black_dn": 65}}
            changed.write_text(json.dumps(data))
        case ".csv":
            changed.write_text(changed.read_text().replace("0,0,", "0,1,", 1))
        case _:
            data = bytearray(changed.read_bytes())
            data[1000] ^= 1
            changed.write_bytes(data)
    ended = cell.acquire("--resume", run)
    assert ended.code == 2
    assert name in ended.err
    assert (run / "journal.jsonl").read_bytes() == before


def test_a_refused_change_is_named_with_both_values(killed: Killed, tmp_path: Path) -> None:
    cell, run = killed.copy(tmp_path)
    cell.plan.write_text(cell.plan.read_text().replace('"exposure_us": 8000', '"exposure_us": 9000'))
    assert "exposure.exposure_us was 8000, is 9000" in cell.acquire("--resume", run).err


def test_comments_another_order_and_another_place_of_a_file_are_no_change(killed: Killed, tmp_path: Path) -> None:
    cell, run = killed.copy(tmp_path)
    (tmp_path / "mesh").mkdir()
    shutil.move(tmp_path / "relief.ply", tmp_path / "mesh/other.ply")
    data = json.loads(cell.plan.read_text())
    data["object"]["mesh"] = "mesh/other.ply"
    again = json.dumps(dict(reversed(data.items())), indent=3)
    cell.plan.write_text(f"# the same, said again\n{again}\n")
    (tmp_path / "coupole.csv").write_text("# checked in May\n" + (tmp_path / "coupole.csv").read_text())
    Run(run).refuse_changes(read_job(cell.plan).inputs)


@pytest.mark.parametrize("text", in_part(["", "name: another\n", "[" * 50], "name: another\n"))
def test_a_run_goes_on_with_its_own_copies_whatever_became_of_the_rig_it_began_with(
    killed: Killed, tmp_path: Path, text: str
) -> None:
    cell, run = killed.copy(tmp_path)
    about = run / "run.json"
    about.write_text(about.read_text().replace(str(killed.folder), str(tmp_path)))  # it began here
    cell.rig.write_text(text)
    resumed = cells.here("acquire", "--resume", run, "--yes", "--json")
    assert resumed.code == 0, resumed


def test_a_folder_that_is_no_run_is_not_resumed(cell: CellFolder) -> None:
    assert cell.acquire("--resume", cell.folder).code == 2


def test_a_complete_run_is_resumed_at_once_and_shoots_nothing(cell: CellFolder) -> None:
    cell.write(lights={"kind": "ids", "ids": [3, 4]})
    first = cell.acquire()
    assert first.code == 0
    run = cell.run_folder
    before = cells.events(run)
    ended = cell.acquire("--resume", run)
    assert ended.code == 0
    assert (ended.document["proven"], ended.document["missing"]) == (2, 0)
    assert ended.document["dose_lux_h"] == pytest.approx(first.document["dose_lux_h"], rel=1e-6)
    assert "opening the devices" not in cells.command("acquire", "--resume", run).err
    assert [event["event"] for event in cells.events(run)[len(before) :]] == ["resume", "stop"] * 2
    assert cells.here("verify", run).code == 0
    cells.assert_each_shot_proven_once(run)


# -- the operator stops it ------------------------------------------------------------------------------------


@pytest.fixture
def standing(tmp_path: Path) -> Iterator[tuple[CellFolder, World]]:
    """A cell whose world outlives its controllers."""
    cell = CellFolder(tmp_path, speed=SPEED)
    cell.join()
    cell.write(lights=MANY_LIGHTS)
    with cell.world() as world:
        yield cell, world


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.full),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.full),
    ],
)
def test_a_stopped_run_ends_with_its_signal_leaves_the_cell_safe_and_is_resumed(
    standing: tuple[CellFolder, World], number: signal.Signals, code: int
) -> None:
    cell, world = standing
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 20, "proven frames")
    process.send_signal(number)
    ended = cells.finish(process)
    assert cells.safe(world)
    assert ended.code == code
    assert ended.document["exit_code"] == code
    assert cells.events(run, "stop")[-1]["outcome"] == "interrupted"
    found = cells.here("status", run, "--json").document
    assert (found["state"], found["faults"]) == ("interrupted", [])
    assert f"({number.name})" in found["reason"]
    told = cells.here("status", run).err
    assert "fault" not in told
    assert f"coupole acquire --resume {run}" in told
    page = (run / "report.html").read_text()
    assert "class=bad" not in page
    assert f"<code>coupole acquire --resume {run}</code>" in page
    assert cell.acquire("--resume", run).code == 0
    cells.assert_each_shot_proven_once(run)


def test_a_run_stopped_while_the_arm_moves_stops_the_arm(standing: tuple[CellFolder, World]) -> None:
    cell, world = standing
    process = cell.start_acquire()
    cells.wait_until(lambda: world.ask("state")["arm_moving"], "the arm's motion")
    process.send_signal(signal.SIGINT)
    ended = cells.finish(process)
    assert cells.safe(world)
    assert ended.code == 130
    assert cells.frame_lines(cell.run_folder) == 0


def test_a_run_that_is_being_acquired_is_not_resumed_by_another(standing: tuple[CellFolder, World]) -> None:
    cell, _ = standing
    cell.write(lights=cells.SOME_LIGHTS, repeats=4)
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
    process.send_signal(signal.SIGUSR1)
    cells.wait_until(lambda: cells.events(run, "pause"), "the pause")
    other = cell.acquire("--resume", run)
    process.send_signal(signal.SIGUSR1)
    assert cells.finish(process).code == 0
    assert other.code == 2
    assert "another process is acquiring into this run" in other.err
    cells.assert_each_shot_proven_once(run)


# -- the controller dies, the cell goes on --------------------------------------------------------------------


def test_leds_go_dark_by_the_boxs_watchdog_when_the_controller_is_killed(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path, speed=1.0)
    cell.rig_data["ledbox"]["settings"]["watchdog_s"] = 2.0
    cell.join()
    cell.write(lights={"kind": "every", "every": 2})
    with cell.world() as world:
        process = cell.start_acquire()
        run = cell.run_folder
        cells.wait_until(lambda: cells.frame_lines(run) > 20, "proven frames")
        process.kill()
        cells.finish(process)
        killed_s = world.ask("state")["t_s"]
        dark_since_s = _dark_since_s(world)
        assert dark_since_s < killed_s + 2.5  # the burst would have gone on for 4 s
        cells.wait_until(lambda: cells.safe(world), "a safe cell")


def _dark_since_s(world: World, for_s: float = 0.3) -> float:
    """World time of the first of many looks in a row in which nothing shone; LEDs flash at 100 Hz."""
    looks: list[float] = []

    def dark_for_long() -> bool:
        state = world.ask("state")
        looks.append(state["t_s"])
        if state["shining"]:
            looks.clear()
        return bool(looks) and looks[-1] - looks[0] > for_s and len(looks) > 10

    cells.wait_until(dark_for_long, "darkness")
    return looks[0]


def test_the_arm_comes_to_rest_when_the_controller_is_killed_in_a_motion_that_the_journal_has(
    standing: tuple[CellFolder, World],
) -> None:
    cell, world = standing
    process = cell.start_acquire()
    cells.wait_until(lambda: world.ask("state")["arm_moving"], "the arm's motion")
    process.kill()
    cells.finish(process)
    cells.wait_until(lambda: cells.safe(world), "the arm at rest")
    kinds = [event["event"] for event in cells.events(cell.run_folder)]
    assert kinds[-3:] == ["start", "view", "move"], "what the arm is about to do is on the disk before it moves"
    assert cells.here("status", cell.run_folder, "--json").document["state"] == "interrupted"


@pytest.mark.parametrize("name", ["run.json", "inputs/plan.yaml"])
def test_a_run_whose_own_files_were_changed_names_them_and_no_command_that_does_not_help(
    killed: Killed, tmp_path: Path, name: str
) -> None:
    _, run = killed.copy(tmp_path)
    about = json.loads((run / "run.json").read_text())
    path = run / name if name == "run.json" else run / about["plan"]["stored"]
    text = path.read_text()
    changed = text.replace("8000", "9000")
    assert changed != text
    path.write_text(changed)
    refused = cells.here("acquire", "--resume", run, "--yes")
    assert refused.code == 2
    said = " ".join(refused.err.split())
    assert f"{path.relative_to(run)}: is not what manifest.sha256 lists" in said
    assert "put the old files back" in said
    assert "own copies by" not in said
