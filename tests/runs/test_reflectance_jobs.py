"""Jobs of `coupole reflectance`: stopped and taken up, in workers, step by step, and refused."""

from __future__ import annotations

import shlex
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
import trimesh
from dask_cluster import cluster
from relief_cells import RECORDS, Made

from coupole.reflectance.run_job import RunRequest, reflectance_of


@pytest.fixture(scope="module")
def made(glossy: Made) -> Made:
    return glossy


def test_a_job_that_was_stopped_goes_on_and_another_is_refused(made: Made) -> None:
    cell, out, document = made
    (out / "fits/ggx_rbf/side.h5").unlink()
    ended = cells.here("reflectance", "check", out)
    assert ended.code == 2
    assert "`coupole reflectance fit" in ended.err
    before = {path: path.stat().st_mtime_ns for path in (out / "samples").iterdir()}
    again = ("reflectance", cell.run_folder, "--calibrations", RECORDS, "--out", out, "--json")
    ended = cells.here(*again)
    assert ended.code == 0, ended.err
    assert {path: path.stat().st_mtime_ns for path in (out / "samples").iterdir()} == before
    assert ended.document["mae"] == document["mae"]
    other = cells.here(*again, "--leave-out", "24,48")
    assert other.code == 2
    assert "name another folder" in other.err
    assert "normals of the mesh" in (out / "report.html").read_text()


def test_a_step_without_a_report_says_what_is_there_and_what_comes_next(made: Made, tmp_path: Path) -> None:
    out = tmp_path / "my result"
    shutil.copytree(made[1], out)
    ended = cells.here("reflectance", "fit", out)
    assert (ended.code, ended.out) == (0, f"all fits {out}\nnext: coupole reflectance check '{out}'\n")
    assert cells.here(*shlex.split(ended.out.splitlines()[1])[2:]).code == 0


def same_datasets(one: Path, other: Path) -> None:
    """Every HDF5 file of both folders, to the bit."""
    names = {str(path.relative_to(one)) for path in one.rglob("*.h5")}
    assert {str(path.relative_to(other)) for path in other.rglob("*.h5")} == names
    for name in names:
        with h5py.File(one / name) as mine, h5py.File(other / name) as its:
            assert set(mine) == set(its)
            for key in mine:
                assert mine[key][()].tobytes() == its[key][()].tobytes(), (name, key)


@pytest.mark.full
def test_two_workers_of_which_one_is_killed_give_the_same_result(made: Made, tmp_path: Path) -> None:
    """To the bit: killed while it extracts, when it may have begun a file, and another one while it fits."""
    cell, alone, document = made
    out = tmp_path / "result"
    with cluster(tmp_path, 3) as (address, workers), ThreadPoolExecutor(1) as pool:
        request = RunRequest((cell.run_folder,), calibrations=tuple(sorted(RECORDS.glob("*.yaml"))))
        job = pool.submit(reflectance_of, request, out, scheduler=address)
        for worker, sign in zip(workers, ("samples/*.part", "fits/*.h5"), strict=False):
            while not list(out.glob(sign)):
                assert not job.done(), job.result()
                time.sleep(0.01)
            worker.kill()
        about = job.result()
    assert about["mae"] == document["mae"]
    same_datasets(alone, out)
    assert not list(out.rglob("*.part"))


def test_runs_without_what_is_needed_are_refused_with_the_remedy(made: Made, tmp_path: Path) -> None:
    cell, _, _ = made

    def refused(*arguments: str | Path) -> str:
        ended = cells.here("reflectance", *arguments, "--out", tmp_path / "none")
        assert ended.code == 2
        return " ".join(ended.err.split())

    assert "no calibration record of the kind hand-eye, leds, led-power" in refused(cell.run_folder)
    assert "expected runs, or --pictures" in refused()
    uncalibrated = (cell.run_folder, "--uncalibrated")
    assert "no --calibrations" in refused(*uncalibrated, "--calibrations", RECORDS)
    assert "expected one of" in refused(*uncalibrated, "--view", "none")
    few = [word for kind in ("hand-eye", "leds") for word in ("--calibrations", RECORDS / f"{kind}.yaml")]
    assert "kind led-power is named" in refused(cell.run_folder, *few)
    records = ("--calibrations", RECORDS)
    assert "there is no" in refused(cell.run_folder, *records, "--mesh", tmp_path / "nothing.ply")
    assert "no frame under LED 1 in these runs" in refused(cell.run_folder, *records, "--leave-out", "1")
    assert "--memory" in refused(cell.run_folder, *records, "--memory", "much")
    assert not (tmp_path / "none").exists()
    elsewhere = trimesh.creation.box(bounds=[[4e3, 0, 0], [4.1e3, 10, 10]])
    elsewhere.export(tmp_path / "elsewhere.ply")
    assert "shows the mesh" in refused(cell.run_folder, *records, "--mesh", tmp_path / "elsewhere.ply")


def test_a_frame_that_is_not_the_one_that_was_proven_is_refused(made: Made, tmp_path: Path) -> None:
    cell, _, _ = made
    run = shutil.copytree(cell.run_folder, tmp_path / "run")
    with h5py.File(run / "views/top.h5", "r+") as file:
        data = file["entry/instrument/detector/data"]
        led = int(np.flatnonzero(file["entry/instrument/detector/frames"]["led"] == 480)[0])
        data[led, 100, 100] ^= 1
    ended = cells.here("reflectance", run, "--calibrations", RECORDS, "--out", tmp_path / "result")
    assert ended.code == 6
    assert "top/led0480/e0 differs from what was proven" in " ".join(ended.err.split())
    assert not list((tmp_path / "result/samples").glob("top*"))
