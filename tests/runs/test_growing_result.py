"""The result of the views so far, while a run goes on: any command opens it, and says from how many views."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cells
import h5py
import numpy as np
import pytest
from beside_runs import acquired_run, begun, cell_of_three_views, files, result_of, same_result
from cells import CellFolder
from PIL import Image

from coupole.errors import StorageError
from coupole.pages import palettes
from coupole.reflectance import light_paths
from coupole.reflectance.beside.follower import process_run
from coupole.reflectance.beside.growing import Growth, fit_so_far
from coupole.reflectance.beside.looking_ahead import look_ahead
from coupole.reflectance.beside.page_maker import PageMaker
from coupole.reflectance.beside.view_drawing import Drawing
from coupole.reflectance.extraction import extraction
from coupole.reflectance.light_paths import Ahead
from coupole.reflectance.run_job import RunRequest, extract_beside, reflectance_of
from coupole.reflectance.run_result import RunResult, read_view_samples
from coupole.storage.growing_pictures import PICTURES, GrowingPictures, PictureShown, ViewPictures, read_growing
from coupole.storage.processing import FOLDER

pytestmark = [pytest.mark.timeout(900), pytest.mark.usefixtures("hurried")]
MEMORY_BYTES = 2_000_000_000
PAGE_PROGRAM = "coupole.exchange.look.page_beside"


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


def values_of(result: Path, picture: PictureShown) -> np.ndarray:
    """[n] the values that the colours of the pixels stand for, by the scale that is told."""
    image = Image.open(result / PICTURES / picture.file)
    assert image.size == (picture.width_px, picture.height_px)
    codes = np.asarray(image)
    return (codes[codes > 0] - 1.0) / (palettes.LEVELS - 1) * (picture.high - picture.low) + picture.low


def picture_of(result: Path, view: str, title: str) -> PictureShown:
    (shown,) = (view_shown for view_shown in read_growing(result).of_views if view_shown.view == view)
    return next(picture for picture in shown.pictures if picture.title == title)


def test_pictures_grow_and_say_on_how_many_frames_they_rest(acquired: CellFolder, tmp_path: Path) -> None:
    run, result = acquired.run_folder, tmp_path / "result"
    drawing = Drawing(result, GrowingPictures(result, is_simulated=True), 3)
    extract_beside(run, "top", result)
    drawing.first_look("top")
    (first,) = read_growing(result).of_views
    assert (first.kind, first.fitted_views, first.views) == ("first-look", 1, 3)
    assert first.frames == len(read_view_samples(result / "samples/top.h5").leds)
    before = {picture.title: (result / PICTURES / picture.file).read_bytes() for picture in first.pictures}
    extract_beside(run, "side", result)
    drawing.first_look("side")
    growth = Growth.of_views(run, result, ("top", "side"), 3)
    fit_so_far(growth, MEMORY_BYTES, lambda *_: None, Ahead())
    drawing.so_far(growth.folder, lambda: True)
    growing = read_growing(result)
    assert growing.is_simulated
    assert [view.view for view in growing.of_views] == ["top", "side"]
    second = growing.of_views[0]
    assert (second.kind, second.fitted_views) == ("so-far", 2)
    assert first.frames < second.frames < 2 * first.frames + 1
    titles = ["Normals", "Uncertainty of normals", "Base colour (kd)", "Uncertainty of base colour"]
    assert [picture.title for picture in second.pictures][:4] == titles
    for picture in second.pictures[:4]:
        assert (result / PICTURES / picture.file).read_bytes() != before[picture.title]
    shows_what_was_fitted(growth.folder, result)


def shows_what_was_fitted(folder: Path, result: Path) -> None:
    """Colours and medians, against the result's own files, which are read with nothing but h5py."""
    with h5py.File(folder / "fits/ggx_normal.h5") as fit, h5py.File(folder / "samples/top.h5") as samples:
        rows = np.searchsorted(fit["triangles"][()], samples["triangles"][()])
        variances = fit["covariance"][()][rows][:, [0, 2, 5]]
        seen, normals = samples["seen"][()], fit["normals"][()][rows]
    u_deg, u_percent = np.degrees(np.sqrt(variances[:, 0] + variances[:, 1])), 100 * np.sqrt(variances[:, 2])
    for title, unit, truth in (
        ("Uncertainty of normals", "degrees", u_deg),
        ("Uncertainty of base colour", "%", u_percent),
    ):
        picture = picture_of(result, "top", title)
        assert picture.unit == unit
        assert picture.median == pytest.approx(np.nanmedian(truth))
        of_pixels = truth[seen[seen >= 0]]
        of_pixels = np.sort(of_pixels[np.isfinite(of_pixels)].clip(picture.low, picture.high))
        step = (picture.high - picture.low) / (palettes.LEVELS - 1)
        assert np.sort(values_of(result, picture)) == pytest.approx(of_pixels, abs=0.51 * step)
    picture = picture_of(result, "top", "Normals")
    colours = np.asarray(Image.open(result / PICTURES / picture.file)).astype(float)
    shown = colours[colours[..., 3] > 0][:, :3] / 255 * 2 - 1
    known = seen[seen >= 0][np.isfinite(normals[seen[seen >= 0], 0])]
    upwards = -normals[known, 2]  # the cell's base hangs upside down
    assert np.sort(shown[:, 2]) == pytest.approx(np.sort(upwards), abs=0.005)


def test_a_page_that_cannot_be_made_is_told_and_the_next_one_is_made(acquired: CellFolder, tmp_path: Path) -> None:
    run, result = acquired.run_folder, tmp_path / "result"
    growing = GrowingPictures(result, is_simulated=True)
    extract_beside(run, "top", result)
    growth = Growth.of_views(run, result, ("top",), 3)
    fit_so_far(growth, MEMORY_BYTES, lambda *_: None, Ahead())
    maker = PageMaker(PAGE_PROGRAM, growing, 3)
    for folder, words in ((tmp_path / "none", "none"), (growth.folder, "")):
        maker.want(folder, 1)
        maker.look()
        made = cells.wait_until(lambda: looked_at(maker, result), "the end of its program")
        assert words in made
    page = read_growing(result).page
    assert page is not None
    assert (page.fitted_views, page.views) == (1, 3)
    assert "made from 1 of 3 views so far" in (result / PICTURES / page.file).read_text()
    assert not list((result / PICTURES).glob(".*"))
    orphan = [sys.executable, "-m", PAGE_PROGRAM, "1", str(growth.folder), str(tmp_path / "page.html")]
    assert subprocess.run(orphan, check=False).returncode == 1, "its parent is another one, so its own is dead"
    assert not (tmp_path / "page.html").exists()


def looked_at(maker: PageMaker, result: Path) -> str:
    """What is told, once a page is there or cannot be made."""
    try:
        maker.look()
    except StorageError as error:
        return str(error)
    return "made" if read_growing(result).page else ""


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


def test_a_view_is_drawn_while_its_frames_arrive_and_the_result_is_the_same(
    acquired: CellFolder, tmp_path: Path
) -> None:
    """Of the second view, 40 of 45 frames under LEDs are there; then the run goes on."""
    run, result = tmp_path / acquired.run_folder.name, tmp_path / "result"
    shutil.copytree(acquired.run_folder, run)
    journal = run / "journal.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    lit = [number for number, line in enumerate(lines) if json.loads(line).get("shot", "").startswith("side/led")]
    end = lit[39] + 1
    journal.write_text("".join(lines[:end]))
    told: list[dict[str, Any]] = []
    of_killed_process = result / FOLDER / "early" / "samples"
    of_killed_process.mkdir(parents=True)
    for name in ("side.h5", "side.json", "top.h5"):
        (of_killed_process / name).write_text("{}")
    with ThreadPoolExecutor(1) as pool:
        ended = pool.submit(process_run, run, result, told.append, lambda work: work())
        try:
            early = cells.wait_until(lambda: drawn_early(result, "side"), "a look at the second view")
        finally:  # otherwise the process would wait for ever
            with journal.open("a") as file:
                file.write("".join(lines[end:]))
        assert ended.result(), told
    assert (early.kind, early.arrived_frames, early.frames) == ("first-look", 40, 40)
    assert [picture.title for picture in early.pictures][:2] == ["Normals", "Uncertainty of normals"]
    assert not [document for document in told if document.get("progress", {}).get("undrawn")]
    assert not of_killed_process.parent.exists()
    said_by("reflectance", run, "--out", tmp_path / "afterwards")
    same_result(result, tmp_path / "afterwards")


def drawn_early(result: Path, view: str) -> ViewPictures | None:
    return next((shown for shown in read_growing(result).of_views if shown.view == view), None)
