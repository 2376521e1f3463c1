"""`coupole calibrate colour` from beginning to end, on frames that are drawn here pixel by pixel."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import typer
from light_runs import FOCAL_PX, SIZE_PX, Taken, write_light_run
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.calibration.colour.chart import read_chart
from coupole.calibration.colour.colorimetry import de00, lab_of
from coupole.calibration.record import read_record
from coupole.commands.calibrate_colour import colour
from coupole.errors import InputError
from coupole.exchange.camera_colour import colour_of_record
from coupole.plan.cell import read_cell
from sim.objects import appearance
from sim.objects.colour_chart import DRAWN

Array = NDArray[np.float64]
REPO = Path(__file__).parents[2]
RIG = REPO / "configs/rigs/sim-colour-chart.yaml"
CHART = REPO / "configs/charts/drawn-24.yaml"
LEDS = (767, 737, 780, 754, 724, 695, 741, 711, 806, 776)
SHADED, EXPOSURE_US = 737, 8000
HEIGHT_MM = 335.0
TURN = np.radians(5.0)


def seen_from_above() -> tuple[Array, Array, Array]:
    """base_from_camera [4, 4] straight above the chart, the points of its plane under all pixels in the base frame
    [h, w, 3] and in the chart's [h, w, 2]."""
    base_from_support = read_cell(RIG).rig.support.base_from_support.matrix()
    support_from_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    support_from_camera[2, 3] = HEIGHT_MM + 2.0
    columns, rows = np.meshgrid(np.arange(SIZE_PX[0]), np.arange(SIZE_PX[1]))
    x_mm = (columns - (SIZE_PX[0] - 1) / 2) / FOCAL_PX * HEIGHT_MM
    y_mm = -(rows - (SIZE_PX[1] - 1) / 2) / FOCAL_PX * HEIGHT_MM
    points = np.stack([x_mm, y_mm, np.full_like(x_mm, 2.0)], axis=-1)
    on_chart = np.stack(
        [x_mm * np.cos(TURN) + y_mm * np.sin(TURN), y_mm * np.cos(TURN) - x_mm * np.sin(TURN)], axis=-1
    )
    in_base = points @ base_from_support[:3, :3].T + base_from_support[:3, 3]
    return base_from_support @ support_from_camera, in_base, on_chart


def reflectances(on_chart: Array) -> Array:
    """[h, w, 3] of the camera's channels: the simulator's integrals of the drawn spectra; black between them."""
    found = np.full((*on_chart.shape[:2], 3), 0.03)
    for name, drawn in DRAWN.items():
        middle = ((int(name[1]) - 3.5) * 22.0, (1.5 - (ord(name[0]) - 65)) * 22.0)
        found[(np.abs(on_chart - middle) < 9.0).all(axis=-1)] = appearance.rgb(drawn.at(WAVELENGTHS_NM))
    return found


def draw_run(folder: Path, brightness: float = 1500.0, *, sheet: bool = False) -> Path:
    """Frames under point lights with Lambert's law and 1/r^2; one LED is half hidden from the left part."""
    cell = read_cell(RIG)
    base_from_camera, points, on_chart = seen_from_above()
    colours = np.full((*on_chart.shape[:2], 3), 0.9) if sheet else reflectances(on_chart)
    letters = np.array(["RGB".index(letter) for letter in "GBRG"]).reshape(2, 2)
    mosaic = np.tile(letters, (SIZE_PX[1] // 2, SIZE_PX[0] // 2))
    bayer = np.take_along_axis(colours, mosaic[..., None], axis=2)[..., 0] * np.array([0.6, 1.0, 0.5])[mosaic]
    normal = cell.rig.support.base_from_support.matrix()[:3, 2]
    random = np.random.default_rng(4)
    frames = [
        Taken(f"c/dark{i}/e0", EXPOSURE_US, base_from_camera, np.full(bayer.shape, 64, np.uint16)) for i in (0, 1)
    ]
    for led in LEDS:
        row = int(np.flatnonzero(cell.leds.ids == led)[0])
        towards = cell.leds.positions_mm[row] - points
        distance = np.linalg.norm(towards, axis=-1)
        facing = -(towards @ cell.leds.normals[row]) / distance
        light = (towards @ normal) / distance * facing / distance**2 * 1500.0**2 / np.cos(np.pi / 4)
        if led == SHADED and not sheet:
            light = np.where(on_chart[..., 0] < 0.0, 0.5, 1.0) * light
        mean = 64 + brightness * bayer * light
        pixels = np.clip(np.rint(random.normal(mean, 2.0)), 0, 4095).astype(np.uint16)
        frames.append(Taken(f"c/led{led:04d}/e0", EXPOSURE_US, base_from_camera, pixels))
    return write_light_run(folder, frames)


def chart_without_edges(folder: Path) -> Path:
    """The chart's description for pixels that are too large for its edges."""
    text = CHART.read_text().split("edges:")[0].replace("drawn-24.txt", str(CHART.with_name("drawn-24.txt")))
    (folder / "chart.yaml").write_text(text.replace("u_lab", "used: 0.75\nu_lab"))
    return folder / "chart.yaml"


def calibrate(folder: Path, *arguments: str | Path) -> Result:
    app = typer.Typer()
    app.command()(colour)
    shared = ("--rig", RIG, "--out", folder, "--name", "x", "--json")
    return CliRunner().invoke(app, list(map(str, (*arguments, *shared))))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run and of the record that was made from it."""
    folder = tmp_path_factory.mktemp("colour")
    result = calibrate(folder, draw_run(folder / "run"), "--chart", chart_without_edges(folder))
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["kind"] == "colour"
    return folder


def run_of(made: Path) -> Path:
    return next(path.parent for path in (made / "run").rglob("run.json"))


def test_channels_are_the_integrals_that_the_frames_were_drawn_from(made: Path) -> None:
    rows = [line.split(",") for line in (made / "x.csv").read_text().splitlines()[2:]]
    found = np.array([row[1:4] for row in rows], float)
    wanted = np.array([appearance.rgb(drawn.at(WAVELENGTHS_NM)) for drawn in DRAWN.values()])
    assert [row[0] for row in rows] == list(DRAWN)
    ratio = found / wanted
    assert np.abs(ratio / np.median(ratio, axis=0) - 1.0).max() < 0.02
    assert np.allclose(ratio.mean(axis=0), 1.0, atol=0.02)


def test_the_record_states_errors_figures_and_what_was_left_out(made: Path) -> None:
    record = read_record(made / "x.yaml")
    assert record.is_accepted
    assert 0.3 < record.fixed["left_out.matrix.mean_de00"] < 2.0
    assert record.fixed["left_out.matrix.worst_de00"] > record.fixed["left_out.matrix.q95_de00"]
    shadow = next(remark for remark in record.remarks if "in shadow" in remark)
    assert "led0737 on A1, A2, A3" in shadow
    assert shadow.count("led") == 1
    assert {file.name for file in record.files} == {"x.icc", "x.csv"}
    assert any(line.name == "drawn-24.txt" for line in record.inputs)
    neutral = [record.value(f"neutral.{channel}") for channel in "RGB"]
    assert np.allclose(neutral, (0.6, 1.0, 0.5), atol=0.01)


def test_relit_pictures_have_the_charts_colours_by_the_record(made: Path) -> None:
    import colour as science

    known = read_chart(CHART)
    seen = np.array([appearance.rgb(drawn.at(WAVELENGTHS_NM)) for drawn in DRAWN.values()])
    by_record = colour_of_record(made / "x.yaml")
    assert by_record.xyz_from_balanced is not None
    to_d50 = science.adaptation.matrix_chromatic_adaptation_VonKries(
        np.array([0.95047, 1.0, 1.08883]), np.array([0.9642, 1.0, 0.8249]), transform="Bradford"
    )
    lab = lab_of(seen @ by_record.xyz_from_balanced.T @ to_d50.T)
    assert de00(lab, known.lab).mean() < 1.5


def test_a_white_sheet_replaces_the_known_light(made: Path, tmp_path: Path) -> None:
    sheet = draw_run(tmp_path / "white", sheet=True)
    result = calibrate(tmp_path, run_of(made), "--chart", made / "chart.yaml", "--white", sheet)
    assert result.exit_code == 0, result.output
    one, other = (read_record(folder / "x.yaml") for folder in (made, tmp_path))
    name = "xyz_d50_from_balanced.Xr"
    assert one.value(name) == pytest.approx(other.value(name), abs=0.01)
    assert 0.5 < other.fixed["figure.uniformity"] < 10.0


def test_corners_in_the_picture_place_the_chart(made: Path, tmp_path: Path) -> None:
    _, _, on_chart = seen_from_above()
    corners = [(-55.0, 33.0), (55.0, 33.0), (55.0, -33.0), (-55.0, -33.0)]
    pixels = [
        np.unravel_index(int(np.argmin(((on_chart - at) ** 2).sum(axis=-1))), on_chart.shape[:2]) for at in corners
    ]
    words = " ".join(f"{column},{row}" for row, column in pixels)
    moved = tmp_path / "chart.yaml"
    lines = (made / "chart.yaml").read_text().splitlines()
    moved.write_text("\n".join(line for line in lines if not line.startswith("support_from_chart")))
    result = calibrate(tmp_path, run_of(made), "--chart", moved, "--corners", words)
    assert result.exit_code == 0, result.output
    found = read_record(tmp_path / "x.yaml").fixed["left_out.matrix.mean_de00"]
    assert found == pytest.approx(read_record(made / "x.yaml").fixed["left_out.matrix.mean_de00"], abs=0.2)
    refused = calibrate(tmp_path / "r", run_of(made), "--chart", moved)
    assert isinstance(refused.exception, InputError)
    assert "--corners" in str(refused.exception)
    backwards = " ".join(reversed(words.split()))
    refused = calibrate(tmp_path / "r", run_of(made), "--chart", moved, "--corners", backwards)
    assert "show the chart's back" in str(refused.exception)


def test_saturated_patches_are_refused_by_name(made: Path, tmp_path: Path) -> None:
    bright = draw_run(tmp_path / "bright", brightness=6000.0)
    chart = made / "chart.yaml"
    refused = calibrate(tmp_path, bright, "--chart", chart)
    assert isinstance(refused.exception, InputError)
    assert "saturated under most lights: the patches" in str(refused.exception)
    assert "D1" in str(refused.exception)
    assert "A1" not in str(refused.exception)
