"""`coupole live`: what viewers get, what they may choose, and that none of them can hold anything up."""

from __future__ import annotations

import io
import json
import re
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import cells
import numpy as np
import pytest
from cells import CellFolder
from PIL import Image
from text_cells import text_cell

from coupole.commands.running import cell_or_job
from coupole.plan.cell import Cell
from coupole.preflight.job import Job


class Viewer:
    """A browser's part, without the browser."""

    def __init__(self, url: str) -> None:
        self.url = url

    def get(self, path: str) -> bytes:
        with urlopen(self.url + path, timeout=cells.PATIENCE_S) as reply:
            body: bytes = reply.read()
        return body

    def figures(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.get("figures"))
        return found

    def choose(self, wanted: Any, **headers: str) -> None:
        headers = {"X-Coupole-Live": "1", **headers}
        with urlopen(Request(self.url + "choose", json.dumps(wanted).encode(), headers), timeout=cells.PATIENCE_S):
            pass

    def picture(self, mark: str = "") -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO(self.get(f"picture?mark={mark}"))))


@contextmanager
def live(what: Path, *options: str) -> Iterator[tuple[Viewer, subprocess.Popen[str]]]:
    process = cells.start("live", what, "--yes", *options)
    assert process.stderr is not None
    for line in process.stderr:
        if found := re.search(r"http://\S+/", line):
            break
    else:
        pytest.fail(f"no page was served; exit code {process.wait()}")
    try:
        yield Viewer(found[0]), process
    finally:
        process.send_signal(signal.SIGINT)
        cells.finish(process)


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    """Of a simulated cell's camera."""
    with live(CellFolder(tmp_path_factory.mktemp("live")).plan, "--fps", "8") as (viewer, _):
        yield viewer


@pytest.fixture
def viewer(camera: Viewer) -> Viewer:
    """The same, under LED 500."""
    camera.choose({"led": 500, "exposure_us": 8000})
    cells.wait_until(
        lambda: (s := camera.figures()["shown"]) and (s["led"], s["exposure_us"]) == (500, 8000), "a frame"
    )
    return camera


def test_the_page_asks_for_nothing_elsewhere(viewer: Viewer) -> None:
    page = viewer.get("").decode()
    assert "<title>" in page
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//""", page)


def test_a_viewer_sees_the_picture_and_its_histograms(viewer: Viewer) -> None:
    shown = viewer.figures()["shown"]
    assert shown["led"] == 500
    assert set(shown["histograms"]) == {"R", "G1", "G2", "B"}
    assert sum(shown["histograms"]["R"]) == 128 * 96 / 4
    assert shown["dose_lux_h"] > 0
    picture = viewer.picture()
    assert picture.shape == (48, 64, 3)
    assert picture.std() > 2  # the dark support, lit from one side


def test_saturated_pixels_are_shown_in_red(viewer: Viewer) -> None:
    viewer.choose({"exposure_us": 800_000})
    cells.wait_until(lambda: viewer.figures()["shown"]["exposure_us"] == 800_000, "the longer exposure")
    assert viewer.figures()["shown"]["saturated"]["G1"] > 0.3

    def red(mark: str) -> float:
        r, g, b = np.moveaxis(viewer.picture(mark).astype(int), -1, 0)
        return float(np.mean((r > 200) & (g < 90) & (b < 90)))

    assert red("saturation") > 0.3
    assert red("") == 0


def test_edges_in_focus_are_shown_in_green(viewer: Viewer) -> None:
    marked, plain = viewer.picture("focus").astype(int), viewer.picture().astype(int)
    changed = np.abs(marked - plain).max(axis=2) > 60
    assert 0 < changed.mean() < 0.5


def test_a_viewer_chooses_light_and_exposure(viewer: Viewer) -> None:
    before = viewer.figures()["shown"]["brightest"]
    viewer.choose({"led": None, "exposure_us": 4000})
    cells.wait_until(lambda: viewer.figures()["shown"]["title"] == "no light", "a dark frame")
    assert viewer.figures()["shown"]["exposure_us"] == 4000
    assert viewer.figures()["shown"]["brightest"] < 0.3 * before  # the support is dark, read noise is not nothing


@pytest.mark.parametrize(
    ("wanted", "why"),
    [
        ({"led": 5000}, "led: expected one of the dome's"),
        ({"exposure_us": 0}, "exposure_us: expected a whole number"),
        ({"exposure_us": 10_000_000}, "exposure_us: expected a whole number"),
        ([1], "expected an object"),
    ],
    ids=["led", "zero", "too-long", "list"],
)
def test_what_the_cell_must_not_do_is_refused(viewer: Viewer, wanted: Any, why: str) -> None:
    with pytest.raises(HTTPError) as refused:
        viewer.choose(wanted)
    assert refused.value.code == 400
    assert why in refused.value.read().decode()


@pytest.mark.parametrize("headers", [{"X-Coupole-Live": "0"}, {"Host": "example.org"}], ids=["no-header", "host"])
def test_another_sites_page_cannot_switch_lights(viewer: Viewer, headers: dict[str, str]) -> None:
    before = viewer.figures()["choice"]
    with pytest.raises(HTTPError) as refused:
        viewer.choose({"led": 3}, **headers)
    refused.value.close()
    assert viewer.figures()["choice"] == before


def test_a_viewer_that_hangs_holds_nobody_up(viewer: Viewer) -> None:
    address = urlsplit(viewer.url)
    with closing(socket.create_connection(("127.0.0.1", address.port or 0))) as hanging:
        hanging.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        with suppress(OSError):  # the page may have hung up on it by then
            for _ in range(50):
                hanging.send(f"GET {address.path}picture HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        number = viewer.figures()["shown"]["number"]
        cells.wait_until(lambda: viewer.figures()["shown"]["number"] > number + 5, "more frames")


def test_the_cell_is_safe_when_the_live_view_ends(cell: CellFolder) -> None:
    cell.join()
    with cell.world() as world:
        with live(cell.plan, "--led", "500", "--fps", "20") as (viewer, _):
            cells.wait_until(lambda: viewer.figures()["shown"], "the first frame")
        cells.wait_until(lambda: cells.safe(world), "a safe cell")


def test_a_cell_without_trigger_cable_is_looked_through_too(tmp_path: Path) -> None:
    cell = text_cell(tmp_path)
    cell.join()
    with cell.world() as world:
        with live(cell.plan, "--led", "26", "--fps", "5") as (viewer, _):
            cells.wait_until(lambda: _title(viewer) == "LED 26", "a picture under LED 26")
            bright = viewer.figures()["shown"]["brightest"]
            viewer.choose({"led": None})
            cells.wait_until(lambda: _title(viewer) == "no light", "a dark picture")
            assert viewer.figures()["shown"]["brightest"] < 0.3 * bright
        cells.wait_until(lambda: cells.safe(world), "a safe cell")


def _title(viewer: Viewer) -> str:
    shown = viewer.figures()["shown"]
    return str(shown["title"]) if shown else ""


def _if_done(shown: dict[str, Any]) -> dict[str, Any] | None:
    return shown if shown["run"].startswith("done") else None


def test_a_run_is_watched_through_its_folder_and_never_slowed(cell: CellFolder) -> None:
    cell.write(lights={"kind": "every", "every": 3})
    acquiring = cell.start_acquire()
    run = cell.run_folder
    with live(run) as (viewer, _):
        shown = cells.wait_until(lambda: viewer.figures()["shown"], "a frame of the run")
        assert shown["title"].startswith("top/led")
        assert viewer.picture().std() > 5
        assert re.fullmatch(r"(running|done), \d+ of 360 shots proven", shown["run"])
        with pytest.raises(HTTPError) as refused:
            viewer.choose({"led": 3})
        refused.value.close()
        ended = cells.finish(acquiring)
        cells.wait_until(lambda: "last frame" in viewer.figures()["remark"], "word that the run has ended")
        last = cells.wait_until(lambda: _if_done(viewer.figures()["shown"]), "the end in the figures")
        assert last["run"] == "done, 360 of 360 shots proven"
        assert last["dose_lux_h"] == pytest.approx(ended.document["dose_lux_h"])
    assert ended.code == 0, ended.err
    assert ended.document["proven"] == 360


def test_a_camera_that_is_unplugged_ends_the_live_view_with_four(cell: CellFolder) -> None:
    cell.faults({"kind": "unplug_camera", "at_edge": 5})
    process = cells.start("live", cell.rig, "--yes", "--fps", "20")
    ended = cells.finish(process)
    assert ended.code == 4
    assert "camera: expected" in ended.err


def test_a_live_view_that_was_suspended_by_ctrl_z_does_not_light_again_and_says_so(cell: CellFolder) -> None:
    with cell.world() as world:
        cell.join()
        with live(cell.plan) as (viewer, process):
            viewer.choose({"led": 640, "exposure_us": 8000})
            cells.wait_until(lambda: world.ask("state")["shining"], "a lamp")
            process.send_signal(signal.SIGTSTP)
            cells.wait_until(lambda: cells.state_of(process.pid) == "T", "a stopped process")
            assert not world.ask("state")["shining"]
            process.send_signal(signal.SIGCONT)
            ended = cells.finish(process)
        assert ended.code == 130
        assert "which then ends" in ended.err
        assert "suspended by Ctrl-Z" in ended.err
        assert "cannot pause, so it was ended" in ended.err
        assert not world.ask("state")["shining"]


def test_a_shipped_rig_or_plan_is_named_by_one_word() -> None:
    rig, plan = cell_or_job(Path("sim")), cell_or_job(Path("demo"))
    assert isinstance(rig, Cell)
    assert isinstance(plan, Job)
    assert (rig.rig.name, plan.plan.name) == (plan.cell.rig.name, "demo")


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 143), pytest.param(signal.SIGHUP, 129, marks=pytest.mark.full)]
)
def test_a_live_view_that_is_ended_by_a_signal_ends_with_its_code(
    cell: CellFolder, number: signal.Signals, code: int
) -> None:
    heard = {"preexec_fn": lambda: signal.signal(number, signal.SIG_DFL)} if number == signal.SIGHUP else {}
    process = cells.start("live", cell.rig, "--yes", **heard)  # a terminal's hang-up may be ignored all round here
    assert process.stderr is not None
    while "live at http" not in process.stderr.readline():
        assert process.poll() is None
    process.send_signal(number)
    assert cells.finish(process).code == code
