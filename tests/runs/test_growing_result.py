"""The result of the views so far, while a run goes on: any command opens it, and says from how many views."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from beside_runs import acquired_run, begun, cell_of_three_views, files, result_of, same_result
from cells import CellFolder

from coupole.reflectance import light_paths
from coupole.reflectance.beside.growing import Growth, fit_so_far
from coupole.reflectance.beside.looking_ahead import look_ahead
from coupole.reflectance.extraction import extraction
from coupole.reflectance.light_paths import Ahead
from coupole.reflectance.run_job import RunRequest, extract_beside, reflectance_of
from coupole.reflectance.run_result import RunResult

pytestmark = [pytest.mark.timeout(900), pytest.mark.usefixtures("hurried")]
MEMORY_BYTES = 2_000_000_000


@pytest.fixture(scope="module")
def acquired(tmp_path_factory: pytest.TempPathFactory) -> CellFolder:
    """A run that is only read; as of real objects, inter-reflection is subtracted from its samples."""
    return acquired_run(tmp_path_factory.mktemp("acquired"), interreflection=True)


def said_by(*arguments: str | Path) -> dict[str, Any]:
    ended = cells.here(*arguments, "--json")
    assert ended.code == 0, ended.err
    document: dict[str, Any] = ended.document
    return document


def relit(folder: Path, picture: Path) -> dict[str, Any]:
    return said_by("reflectance", "relight", folder, "--direction", "0,0,1", "--to", picture)


def has_samples(result: Path) -> bool:
    return any((result / "samples").glob("*.json"))


def fitted_views(result: Path) -> int:
    return int(json.loads((result / "beside/progress.json").read_text())["fitted_views"])


def exports_say_that_it_grows(so_far: Path, out: Path) -> None:
    assert cells.here("export", so_far, "--to", "ply").code == 2  # its folder is removed when all is done
    said_by("export", so_far, "--to", "ply", "--out", out)
    (ply,) = out.glob("*.ply")
    assert b"made from 2 of 3 views so far" in ply.read_bytes()[:4096]


def is_told_when_it_is_replaced(so_far: Path, out: Path) -> None:
    """A reader holds the folder that was there; a result of more views takes its place."""
    folder = so_far.resolve()
    shutil.rmtree(folder / "samples")
    so_far.unlink()
    refused = cells.here("export", folder, "--to", "ply", "--out", out, "--json")
    assert refused.code == 2, refused
    assert "a result of more views has replaced it" in refused.err


def test_without_room_on_the_disk_none_is_made(
    acquired: CellFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames and samples of the views to come are more important."""
    result = tmp_path / "result"
    extract_beside(acquired.run_folder, "top", result)
    growth = Growth.of_views(acquired.run_folder, result, ("top",), 3)
    view_bytes = (acquired.run_folder / "views/top.h5").stat().st_size
    total = shutil.disk_usage(result)
    for free_bytes, has_room in ((2**30 + 2 * view_bytes, False), (2**30 + 20 * view_bytes, True)):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free_bytes: total._replace(free=free))
        assert growth.has_room() == has_room


def test_a_run_that_goes_on_has_a_result_of_its_views_so_far(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    process, _ = begun(cell)
    cells.wait_until(lambda: len(cells.events(cell.run_folder, "view")) == 2, "the second view")
    assert cells.here("pause", cell.run_folder).code == 0  # the second may not be lit, the third is not begun
    result = result_of(cell)
    cells.wait_until(lambda: has_samples(result), "samples of a view")
    cells.wait_until(lambda: fitted_views(result), "the result of the views so far")
    assert said_by("status", cell.run_folder)["processing"]["fitted_views"] in (1, 2)
    folder, picture = (result / "so-far").resolve(), tmp_path / "some.npy"
    so_far = relit(result, picture)["so_far"]
    assert so_far["views"] in (1, 2)
    assert np.isfinite(np.load(picture)).any()
    views = len(RunResult(folder).views)
    page = said_by("show", folder, "--out", tmp_path / "some.html")
    words = f"from {views} of 3 views so far"
    assert words in page["about"]["told"]["So far"]
    assert words in (folder / "report.html").read_text()
    assert cells.here("go-on", cell.run_folder).code == 0
    ended = cells.finish(process)
    assert ended.document["reflectance"]["is_whole"], ended.err
    assert not (result / "so-far").is_symlink()
    assert not (result / "beside").exists()
    assert "so_far" not in relit(result, picture)
    afterwards = tmp_path / "afterwards"
    said_by("reflectance", cell.run_folder, "--out", afterwards)
    same_result(result, afterwards)


def test_no_ray_is_left_for_the_time_after_the_last_frame(
    acquired: CellFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While its frames arrive: what each view sees, what hides LEDs from it, and all paths of light."""
    run, result, ahead = acquired.run_folder, tmp_path / "result", Ahead()

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError

    for view in ("top", "side", "low"):
        look_ahead(run, view, ahead)
        with monkeypatch.context() as since:
            for name in ("seen_surface", "lamp_codes"):
                since.setattr(extraction, name, refuse)
            extract_beside(run, view, result)
    with monkeypatch.context() as since:
        for name in ("scene_of", "seen_from", "direct_irradiance"):
            since.setattr(light_paths, name, refuse)
        assert reflectance_of(RunRequest((run,)), result, ahead=ahead)["subtracted"]
    reflectance_of(RunRequest((run,)), tmp_path / "afterwards")
    same_result(result, tmp_path / "afterwards")


def test_what_is_known_ahead_and_given_up_changes_no_bit_of_the_result(
    acquired: CellFolder, tmp_path: Path
) -> None:
    run, result = acquired.run_folder, tmp_path / "result"
    ahead, views = Ahead(), ("top", "side")
    for view, is_wanted in zip(views, (lambda: False, iter([True, False, False]).__next__), strict=True):
        look_ahead(run, view, ahead, is_wanted)
        extract_beside(run, view, result)
    before = {name: path.read_bytes() for name, path in files(result).items()}
    growth = Growth.of_views(run, result, views, 3)
    assert growth.has_room()

    class GivenUpError(Exception):
        pass

    def give_up(detail: str, done_count: int, of: int) -> None:
        if detail == "contradictions":
            raise GivenUpError

    with pytest.raises(GivenUpError):
        fit_so_far(growth, MEMORY_BYTES, give_up, ahead)
    assert {name: path.read_bytes() for name, path in files(result).items()} == before
    assert not (result / "so-far").is_symlink()
    fit_so_far(growth, MEMORY_BYTES, lambda *_: None, ahead)
    assert [view.view for view in RunResult(result / "so-far").views] == ["side", "top"]
    assert json.loads((result / "so-far/result.json").read_text())["so_far"] == {"views": 2, "of": 3}
    assert {name: (result / name).read_bytes() for name in before} == before
    exports_say_that_it_grows(result / "so-far", tmp_path / "exported")
    with pytest.raises(GivenUpError):  # as after a resume: the same views again
        fit_so_far(Growth.of_views(run, result, views, 3), MEMORY_BYTES, give_up, ahead)
    assert [view.view for view in RunResult(result / "so-far").views] == ["side", "top"]
    is_told_when_it_is_replaced(result / "so-far", tmp_path / "exported again")
    reflectance_of(RunRequest((run,)), result, ahead=ahead)
    reflectance_of(RunRequest((run,)), tmp_path / "afterwards")
    same_result(result, tmp_path / "afterwards")
