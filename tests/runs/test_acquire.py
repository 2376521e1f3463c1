"""A plan run from end to end on the simulated cell: what is said, what is stored, and that it is true."""

from __future__ import annotations

import hashlib
import json
import termios
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cells
import h5py
import numpy as np
import pytest
from at_a_terminal import Typist, at_a_terminal
from cells import SIDE, TOP, CellFolder, Ended
from expected_pictures import Expectation, mislabelled

TWO_LIGHTS = {"kind": "ids", "ids": [0, 700]}


@dataclass(frozen=True)
class Clean:
    """A run of two views under 54 lights, with nothing going wrong."""

    cell: CellFolder
    ended: Ended
    run: Path


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Clean:
    cell = CellFolder(tmp_path_factory.mktemp("clean"))
    cell.write(views=[TOP, SIDE])
    ended = cells.command("acquire", cell.plan, "--json")
    return Clean(cell, ended, cell.run_folder)


# -- what a clean run says ------------------------------------------------------------------------------------


def test_a_clean_run_ends_with_zero(clean: Clean) -> None:
    assert clean.ended.code == 0, clean.ended.err


def test_a_clean_run_says_its_figures_in_one_json_document(clean: Clean) -> None:
    found = clean.ended.document
    assert found["run"] == str(clean.run)
    counts = {key: found[key] for key in ("shots", "proven", "missing", "reshot", "bad")}
    assert counts == {"shots": 108, "proven": 108, "missing": 0, "reshot": 0, "bad": 0}
    assert found["bytes"] == 2 * 66 * 128 * 96 * 2
    assert all(type(found[key]) is int for key in (*counts, "bytes"))


def test_a_run_is_never_shorter_than_its_ideal_and_efficiency_is_their_ratio(clean: Clean) -> None:
    found = clean.ended.document
    assert 0 < found["ideal_s"] <= found["duration_s"]
    assert found["efficiency"] == pytest.approx(found["ideal_s"] / found["duration_s"], abs=2e-3)


def test_json_leaves_standard_error_to_errors(clean: Clean) -> None:
    """And to what whoever waits is told: on a cold or busy machine cell and run compile for seconds."""
    compiles = ("the simulated cell compiles its code", "compiling the functions that the run will call")
    assert [line for line in clean.ended.err.splitlines() if not line.startswith(compiles)] == []


# -- what a clean run leaves ----------------------------------------------------------------------------------


def test_a_run_that_ended_leaves_no_thread_of_its_own(cell: CellFolder) -> None:
    cell.write(views=[TOP], lights=TWO_LIGHTS)
    before = set(threading.enumerate())
    assert cells.here("acquire", cell.plan, "--json").code == 0
    cells.wait_until(lambda: not set(threading.enumerate()) - before, "the end of the run's threads")


def test_every_shot_is_proven_once_and_verify_finds_it_whole(clean: Clean) -> None:
    cells.assert_each_shot_proven_once(clean.run)


def test_the_journal_tells_each_view_from_move_to_seal(clean: Clean) -> None:
    kinds = [event["event"] for event in cells.events(clean.run)]
    told = [kind for kind in kinds if kind != "frame"]
    assert told == ["journal", "start", *["view", "move", "settled", "begin", "burst", "seal"] * 2, "stop"]
    assert kinds.count("frame") == 2 * 66


def test_the_run_file_keeps_plan_rig_and_files_with_their_hashes(clean: Clean) -> None:
    about = json.loads((clean.run / "run.json").read_text())
    for what, path in (("plan", clean.cell.plan), ("rig", clean.cell.rig)):
        assert about[what]["text"] == path.read_text()
    for entry in (about["plan"], about["rig"], *about["files"]):
        assert entry["sha256"] == hashlib.sha256(Path(entry["path"]).read_bytes()).hexdigest()
    assert {Path(entry["path"]).name for entry in about["files"]} == {"coupole.csv", "relief.ply"}


def test_a_simulated_run_says_so_in_run_file_journal_and_frames(clean: Clean) -> None:
    assert json.loads((clean.run / "run.json").read_text())["simulated"] is True
    assert cells.events(clean.run, "start")[0]["simulated"] is True
    with h5py.File(clean.run / "views/top.h5", "r") as file:
        assert file["entry"].attrs["simulated"]


def test_a_simulated_run_gives_the_object_no_dose_in_the_ledger(clean: Clean) -> None:
    assert not (clean.cell.folder / "storage/ledger").exists()
    assert not (clean.cell.folder / "ledger").exists()


def test_the_runs_dose_is_what_preflight_foresaw_and_the_journal_tells(clean: Clean) -> None:
    foreseen = cells.here("check", clean.cell.plan, "--no-paths", "--json").document["dose_lux_h"]
    assert clean.ended.document["dose_lux_h"] == pytest.approx(foreseen, rel=1e-6)
    begun, ended = (cells.events(clean.run, kind) for kind in ("begin", "burst"))
    assert [event["given_lux_h"] for event in ended] == [pytest.approx(event["planned_lux_h"]) for event in begun]
    assert np.sum([event["given_lux_h"] for event in ended], axis=0).max() == pytest.approx(foreseen, rel=1e-6)
    status = cells.here("status", clean.run, "--json").document
    assert status["dose_lux_h"] == pytest.approx(foreseen, rel=1e-6)


def test_frames_read_with_plain_hdf5_are_those_of_the_journal(clean: Clean) -> None:
    frames = cells.stored(clean.run)
    for event in cells.events(clean.run, "frame"):
        frame = frames[event["shot"]]
        assert event["xxh3"] == f"{int(frame.record['xxh3']):016x}"
        assert event["frame_id"] == frame.record["frame_id"]
        assert event["file"] == f"views/{event['shot'].split('/')[0]}.h5"


def test_frames_lie_in_one_contiguous_page_aligned_dataset(clean: Clean) -> None:
    with h5py.File(clean.run / "views/top.h5", "r") as file:
        data = file["entry/instrument/detector/data"]
        assert data.dtype == np.uint16
        assert data.shape[1:] == (96, 128)
        assert data.chunks is None
        assert data.id.get_offset() % 4096 == 0
        assert file["entry/data/data"] == data


def test_every_label_is_true_of_what_its_frame_shows(clean: Clean) -> None:
    assert mislabelled(clean.cell, clean.run) == []


def test_a_frame_under_a_wrong_label_would_be_found(clean: Clean) -> None:
    """The check above has teeth: shown the neighbour's frame it names the neighbour."""
    frames = cells.stored(clean.run)
    expected = Expectation(clean.cell, frames["top/led0000/e0"].base_from_camera)
    assert expected.led_of(frames["top/led0020/e0"].pixels) == 20


def test_the_report_of_a_run_stands_in_its_folder(clean: Clean) -> None:
    report = (clean.run / "report.html").read_text()
    assert report.startswith("<!doctype html>")
    assert "top/led" in report


def test_a_byte_that_changed_on_disk_fails_verify_with_six_and_names_the_shot(cell: CellFolder) -> None:
    cell.write(lights=TWO_LIGHTS)
    assert cell.acquire().code == 0
    event = next(e for e in cells.events(cell.run_folder, "frame") if e["shot"] == "top/led0700/e0")
    path = cell.run_folder / event["file"]
    with h5py.File(path, "r") as file:
        offset = file["entry/instrument/detector/data"].id.get_offset() + event["index"] * 128 * 96 * 2
    with path.open("r+b") as file:
        file.seek(offset + 1000)
        byte = file.read(1)[0]
        file.seek(offset + 1000)
        file.write(bytes([byte ^ 1]))
    verified = cells.here("verify", cell.run_folder, "--json")
    assert verified.code == 6
    assert verified.document["ok"] is False
    assert len(verified.document["bad"]) == 1
    assert "top/led0700/e0" in verified.document["bad"][0]
    assert "1 thing is not right (above); " in verified.err


# -- what the operator sees -----------------------------------------------------------------------------------


def test_without_a_terminal_the_run_is_told_in_plain_lines(cell: CellFolder) -> None:
    cell.write(lights=TWO_LIGHTS)
    ended = cells.command("acquire", cell.plan)
    assert ended.code == 0
    assert ended.out == ""
    assert "\x1b" not in ended.err
    assert "done: 2 of 2 shots proven, 0 re-shot" in ended.err


@contextmanager
def with_keys(cell: CellFolder) -> Iterator[Typist]:
    """`acquire` on a terminal of its own, once it listens to keys; at its end the terminal is as it was."""
    with at_a_terminal("acquire", cell.plan) as typist:
        modes = termios.tcgetattr(typist.terminal_fd)
        typist.waits_for("keys: p pauses")
        yield typist
        cells.wait_until(lambda: cells.events(cell.run_folder, "stop"), "the end")
        cells.wait_until(lambda: termios.tcgetattr(typist.terminal_fd) == modes, "the terminal as it was")


def test_on_a_terminal_there_are_bars_with_view_and_rates(cell: CellFolder) -> None:
    """The key p, pressed twice, pauses and goes on."""
    cell.write(lights={"kind": "every", "every": 4})
    with with_keys(cell) as typist:
        typist.types("p")
        cells.wait_until(lambda: cells.events(cell.run_folder, "pause"), "the pause")
        typist.types("p")
        assert typist.process.wait(cells.PATIENCE_S) == 0
    for words in ("\x1b[", "view top", "frames/s", "MB/s", "lux.h", " left", "continued", "282/282"):
        assert words in typist.shown.decode()


def test_the_key_q_stops_the_run_safely_and_is_named_as_what_stopped_it(cell: CellFolder) -> None:
    cell.write(lights={"kind": "every", "every": 4})
    with with_keys(cell) as typist:
        cells.wait_until(lambda: cells.events(cell.run_folder, "frame"), "a frame")
        typist.types("q")
        assert typist.process.wait(cells.PATIENCE_S) == 130
    assert cells.events(cell.run_folder, "stop")[-1]["outcome"] == "interrupted"
    assert "the key q" in typist.shown.decode()
    assert cell.acquire("--resume", cell.run_folder).code == 0
    cells.assert_each_shot_proven_once(cell.run_folder)


# -- kinds of plans -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("plan", "shots"),
    [
        ({"lights": TWO_LIGHTS, "exposure": {"kind": "bracket", "exposures_us": [2000, 4000, 8000]}}, 6),
        ({"lights": TWO_LIGHTS, "repeats": 3}, 6),
        ({"lights": {"kind": "panels"}}, 4),
        ({"lights": {"kind": "none"}}, 0),
        ({"lights": TWO_LIGHTS, "trigger": "software"}, 2),
        ({"lights": {"kind": "panels", "panels": [2]}, "trigger": "software"}, 1),
    ],
    ids=["bracket", "repeats", "panels", "none", "software", "software-panel"],
)
def test_each_kind_of_plan_is_run_to_completeness(cell: CellFolder, plan: dict[str, Any], shots: int) -> None:
    if plan.get("trigger") == "software":  # the host must answer within 60 ms of the world's time
        cell.world_settings["speed"] = 1.0
    cell.write(**plan)
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert (ended.document["shots"], ended.document["proven"]) == (shots, shots)
    cells.assert_each_shot_proven_once(cell.run_folder)
    if "panels" not in plan["lights"]["kind"]:
        assert mislabelled(cell, cell.run_folder) == []


def test_each_exposure_of_a_bracket_is_as_bright_as_it_is_long(cell: CellFolder) -> None:
    cell.write(lights=TWO_LIGHTS, exposure={"kind": "bracket", "exposures_us": [2000, 4000, 8000]})
    assert cell.acquire().code == 0
    frames = cells.stored(cell.run_folder)
    light = [frames[f"top/led0700/e{k}"].pixels.mean() - cells.BLACK_DN for k in range(3)]
    assert light[1] / light[0] == pytest.approx(2, rel=0.03)
    assert light[2] / light[0] == pytest.approx(4, rel=0.03)
    assert [frames[f"top/led0700/e{k}"].record["exposure_us"] for k in range(3)] == [2000, 4000, 8000]


def test_a_panel_is_seen_in_its_frames_and_off_afterwards(cell: CellFolder) -> None:
    cell.join()
    cell.write(lights={"kind": "panels", "panels": [1, 3]})
    with cell.world() as world:
        assert cell.acquire().code == 0
        assert world.ask("state")["panels"] == []
    frames = cells.stored(cell.run_folder)
    assert all(frames[f"top/panel{n}/e0"].pixels.mean() > cells.BLACK_DN + 100 for n in (1, 3))


# -- where runs go, and how far they are ----------------------------------------------------------------------


def test_output_is_the_parent_folder_of_the_run(cell: CellFolder) -> None:
    cell.write(lights=TWO_LIGHTS)
    ended = cell.acquire("--output", cell.folder / "elsewhere")
    run = Path(ended.document["run"])
    assert run.parent == cell.folder / "elsewhere"
    assert run.name.endswith("Z-small")
    assert not (cell.folder / "storage").exists()


def test_status_tells_progress_while_the_run_goes_on(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path, speed=1.0)
    cell.write(lights={"kind": "every", "every": 4})
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 10, "proven frames")
    during = cells.here("status", run, "--json").document
    assert cells.finish(process).code == 0
    assert (during["state"], during["go_on"]) == ("running", "")
    assert 0 < during["proven"] < during["shots"] == 270
    assert during["missing"] == during["shots"] - during["proven"]


def test_status_after_the_run_says_done(clean: Clean) -> None:
    found = cells.here("status", clean.run, "--json").document
    assert (found["state"], found["shots"], found["proven"], found["missing"]) == ("done", 108, 108, 0)


# -- what is not begun ----------------------------------------------------------------------------------------


def test_a_view_out_of_reach_is_refused_with_three_before_anything_is_written(cell: CellFolder) -> None:
    cell.write(views=[TOP, {**TOP, "name": "far", "target_mm": [0, 0, 900]}])
    ended = cell.acquire()
    assert ended.code == 3
    assert "view far" in ended.err
    assert ended.document["exit_code"] == 3
    assert not (cell.folder / "storage").exists()


def test_a_misspelt_key_is_refused_with_two_and_its_place(cell: CellFolder) -> None:
    cell.write(darks_per_veiw=3)
    ended = cell.acquire()
    assert ended.code == 2
    line = next(n for n, text in enumerate(cell.plan.read_text().splitlines(), 1) if "veiw" in text)
    assert f"plan.yaml:{line}:" in ended.err
