"""The files of a result of runs, when the process is killed or the power fails at any point: each is whole or not
there, and the same command ends with the same result."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import cells
import h5py
import pytest
import recorded_result
import write_cuts
from cells import CellFolder
from places import REPO
from write_cuts import CHANGING, RENAME, UNKNOWN, Call, Disk

from coupole.reflectance.run_job import reflectance_of

COMPILER = shutil.which("cc") or shutil.which("gcc")
SOURCE = Path(__file__).with_name("recorded_writes.c")
RECORDS = REPO / "configs/calibrations"
pytestmark = [
    pytest.mark.full,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(not COMPILER, reason="no C compiler is here to build the recorder with"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six LEDs: enough for samples, and too few for a material, so that a fit takes no time."""
    cell = CellFolder(tmp_path_factory.mktemp("cell"), speed=10.0)
    cell.rig_data["sensor"] |= {"width_px": 512, "height_px": 384, "pixel_pitch_um": 44.0}
    cell.world_settings.update(white_at_us=8000)
    cell.write(views=[cells.TOP], lights={"kind": "every", "every": 180}, darks_per_view=2)
    assert cell.acquire().code == 0
    return cell.run_folder


@pytest.fixture(scope="module")
def recorded(run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Call]]:
    """The result, and every write, sync and rename that made it."""
    folder = tmp_path_factory.mktemp("recorded")
    library, log, out = folder / "recorder.so", folder / "calls.log", folder / "disk" / "result"
    out.parent.mkdir()
    subprocess.run([str(COMPILER), "-shared", "-fPIC", "-O1", "-o", library, SOURCE, "-ldl"], check=True)
    recorder = {"LD_PRELOAD": str(library), "RECORD_ROOT": str(out.parent), "RECORD_LOG": str(log)}
    subprocess.run(job(run, out), check=True, env={**os.environ, **recorder, "PYTHONPATH": str(REPO)}, cwd=REPO)
    return out, write_cuts.read(log)


def job(run: Path, out: Path) -> list[str]:
    return [sys.executable, recorded_result.__file__, str(run), str(RECORDS), str(out)]


def differences(mine: Path, whole: Path) -> list[str]:
    """HDF5 files of a result that are not as in the whole one; those that are not there do not count."""
    wrong = []
    for path in mine.rglob("*.h5"):
        try:
            with h5py.File(path) as one, h5py.File(whole / path.relative_to(mine)) as other:
                wrong += [f"{path}: {key}" for key in other if one[key][()].tobytes() != other[key][()].tobytes()]
        except (OSError, KeyError) as error:
            wrong.append(f"{path}: {error}")
    return wrong


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def goes_on(run: Path, out: Path, whole: Path) -> None:
    about = reflectance_of(recorded_result.request_of(run, RECORDS), out)
    assert about["samples"] > 100_000
    assert differences(out, whole) == []
    assert names(out) == names(whole)


def test_wherever_it_is_cut_a_file_is_whole_or_not_there_and_the_job_goes_on(
    run: Path, recorded: tuple[Path, list[Call]], tmp_path: Path
) -> None:
    """Cut before and after every rename, and at a sample of all other points that changes with the day."""
    whole, calls = recorded
    assert [call.path for call in calls if call.op == UNKNOWN] == []
    points = [number for number, call in enumerate(calls) if call.op in CHANGING]
    renamed = [number for number, call in enumerate(calls) if call.op == RENAME]
    assert len(renamed) > 8
    seed = datetime.now(UTC).toordinal()
    chance = random.Random(seed)
    cuts = {*renamed, *(number + 1 for number in renamed), *chance.sample(points, 40)}
    to_go_on = set(chance.sample(sorted(cuts), 8))
    disk, done = Disk(whole.parent), 0
    for number in sorted(cuts):
        for call in calls[done:number]:
            disk.after(call)
        done = number
        for how in ("killed", "power"):
            folder = tmp_path / f"{number}-{how}"
            if how == "killed":
                disk.as_the_process_sees_it(folder)
            else:
                disk.after_power_failed(folder, random.Random(f"{seed} {number}"))
            out = folder / "result"
            assert differences(out, whole) == [], (number, how, seed)
            if (out / "result.json").exists():
                assert names(whole) - names(out) == set(), (number, how, seed)
            if number in to_go_on:
                goes_on(run, out, whole)
            shutil.rmtree(folder)


@pytest.mark.parametrize("sign", ["samples/*.part", "samples/*.json", "fits/*.part", "fits/sh/*.part"])
def test_killed_in_the_middle_of_a_block_it_goes_on(
    run: Path, recorded: tuple[Path, list[Call]], tmp_path: Path, sign: str
) -> None:
    out = tmp_path / "result"
    with subprocess.Popen(job(run, out), env={**os.environ, "PYTHONPATH": str(REPO)}, cwd=REPO) as process:
        while not list(out.glob(sign)) and process.poll() is None:
            time.sleep(0.0005)
        process.send_signal(signal.SIGKILL)
    assert differences(out, recorded[0]) == []
    goes_on(run, out, recorded[0])
