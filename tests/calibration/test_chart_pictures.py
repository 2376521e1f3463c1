"""`coupole calibrate colour` from plain pictures of a chart, which are drawn from spectra by code of the tests."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
import typer
from drawn_charts import Array, DrawnChart, colour, d50_lab, d50_xyz, varied, write_picture
from judged_charts import judge
from places import SHARED_DATA
from typer.testing import CliRunner, Result

import coupole
from coupole.calibration.colour.chart import read_chart
from coupole.calibration.colour.chart_pictures import PlainPicture, read_plain_patches
from coupole.calibration.colour.picture_workflow import see_in_pictures
from coupole.calibration.record import Record, read_record
from coupole.commands import calibrate_colour
from coupole.errors import InputError
from coupole.exchange.camera_colour import colour_of_record
from coupole.exchange.chart_photographs import read_chart_photograph

REAL_DNG = SHARED_DATA / "raw/colorchart.dng"


def calibrate(folder: Path, *arguments: str | Path) -> Result:
    app = typer.Typer()
    app.command()(calibrate_colour.colour)
    return CliRunner().invoke(app, [*map(str, arguments), "--out", str(folder), "--name", "x", "--json"])


def made(folder: Path, *arguments: str | Path) -> Record:
    result = calibrate(folder, *arguments)
    assert result.exit_code == 0, (result.output, result.exception)
    return read_record(folder / "x.yaml")


profile = coupole.calibrate_colour
"""The same without files: half of the command's time goes into its report."""


def refusal(*arguments: str | Path) -> str:
    with tempfile.TemporaryDirectory() as folder:
        result = calibrate(Path(folder), *arguments)
    assert isinstance(result.exception, InputError), (result.output, result.exception)
    return str(result.exception)


def matrix_of(record: Record) -> tuple[Array, Array]:
    """The coefficients [3, 3], and their standard uncertainties."""
    by_name = {parameter.name: parameter for parameter in record.parameters}
    cells = [[by_name[f"xyz_d50_from_balanced.{axis}{channel}"] for channel in "rgb"] for axis in "XYZ"]
    values = np.array([[cell.value for cell in row] for row in cells], float)
    return values, np.array([[cell.u for cell in row] for row in cells], float)


def remark_with(record: Record, words: str) -> str:
    return next(remark for remark in record.remarks if words in remark)


EVEN = DrawnChart(1, lamp_mm=1e5)


@pytest.fixture(scope="module")
def even(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a chart and its picture under even light: `chart.yaml`, `chart.tif`."""
    folder = tmp_path_factory.mktemp("even")
    write_picture(folder / "chart.tif", EVEN.picture())
    EVEN.write_chart(folder)
    return folder


@pytest.fixture(scope="module")
def uneven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same under a near lamp, through a lens that vignettes, and a white card: `white.tif`."""
    folder = tmp_path_factory.mktemp("uneven")
    drawn = uneven_chart()
    write_picture(folder / "chart.tif", drawn.picture())
    write_picture(folder / "white.tif", drawn.picture(white=True))
    drawn.write_chart(folder)
    return folder


def uneven_chart() -> DrawnChart:
    return replace(EVEN, lamp_mm=500.0, vignetting=0.35)


# -- what is found --------------------------------------------------------------------------------------------


def test_the_matrix_is_that_of_the_spectra_and_as_good_as_colour_sciences(even: Path, tmp_path: Path) -> None:
    record = made(tmp_path, even / "chart.tif", "--chart", even / "chart.yaml")
    matrix, u = matrix_of(record)
    assert np.abs((matrix - EVEN.true_matrix()) / u).max() < 3.5
    assert 0.001 < u.min() < u.max() < 0.04
    balanced = EVEN.signals(EVEN.spectra) / EVEN.true_white()
    lab, xyz = d50_lab(d50_xyz(EVEN.spectra)), d50_xyz(EVEN.spectra)
    plain = colour.matrix_colour_correction(balanced, xyz)
    errors = [colour.delta_E(lab, d50_lab(balanced @ one.T), method="CIE 2000") for one in (matrix, plain)]
    assert np.sqrt(np.mean(errors[0] ** 2)) < 1.1 * np.sqrt(np.mean(errors[1] ** 2))
    assert np.abs(matrix - plain).max() < 0.15
    found = [line.split(",") for line in (tmp_path / "x.csv").read_text().splitlines()[2:]]
    seen = np.array([line[1:4] for line in found], float)
    assert np.abs(seen / balanced - 1.0).max() < 0.06
    assert {file.name for file in record.files} == {"x.icc", "x.csv"}
    assert {line.name for line in record.inputs} >= {"chart.tif", "chart.yaml", "values.csv"}
    page = (tmp_path / "x.html").read_text()
    assert "dE00, left out" in page
    assert "B4" in page
    assert colour_of_record(tmp_path / "x.yaml").xyz_from_balanced is not None


def test_the_light_is_taken_off_by_a_white_card_and_found_without_it(uneven: Path) -> None:
    chart, white = uneven / "chart.yaml", uneven / "white.tif"
    by_card = profile(uneven / "chart.tif", chart=chart, white=white)
    by_patches = profile(uneven / "chart.tif", chart=chart)
    truth = uneven_chart().true_matrix()
    (sure, u_sure), (matrix, u) = matrix_of(by_card), matrix_of(by_patches)
    assert np.abs((sure - truth) / u_sure).max() < 3.5
    assert np.abs((matrix - truth) / u).max() < 3.5
    assert (u > u_sure).all()
    assert "light over the chart" in {parameter.dominated_by for parameter in by_patches.parameters}
    widths = [float(remark_with(one, "differ").split("%")[0].split()[-1]) for one in (by_card, by_patches)]
    assert widths[0] > 25.0
    assert widths[1] == pytest.approx(widths[0], abs=12.0)
    assert matrix_of(profile(uneven, chart=chart, white=white))[0] == pytest.approx(sure)


@pytest.mark.parametrize("with_white", [True, False])
def test_intervals_and_the_bound_for_new_colours_hold(with_white: bool, scale: Any) -> None:
    """The small form of `tools/prove_chart_pictures.py`."""
    charts = [judge(varied(seed), with_white=with_white) for seed in range(20, 20 + scale(3, 30))]
    errors = np.array([chart.errors for chart in charts])
    assert np.mean(np.abs(errors) <= charts[0].factor) > 0.8
    assert 0.4 < np.sqrt(np.mean(errors**2)) < 1.6
    assert np.mean([chart.within_bound for chart in charts]) > 0.85


def test_python_gives_the_record_and_the_files_of_the_command(uneven: Path, tmp_path: Path) -> None:
    chart, white = uneven / "chart.yaml", uneven / "white.tif"
    options = ("--chart", chart, "--white", white, "--without", "A1", "--corners", corner_words(uneven_chart()))
    by_command = made(tmp_path / "command", uneven / "chart.tif", *options)
    corners_px = [tuple(map(float, pair.split(","))) for pair in corner_words(uneven_chart()).split()]
    record = coupole.calibrate_colour(
        uneven / "chart.tif",
        chart=chart,
        white=white,
        corners_px=corners_px,
        without=["A1"],
        out=tmp_path / "python",
    )
    assert record.parameters == by_command.parameters
    assert (record.inputs, record.is_accepted) == (by_command.inputs, by_command.is_accepted)
    name = record.name
    written = {path.name for path in (tmp_path / "python").iterdir()}
    assert written == {f"{name}{suffix}" for suffix in (".yaml", ".icc", ".csv", ".html", ".png")}
    with pytest.raises(InputError, match="exists already"):
        coupole.calibrate_colour(uneven / "chart.tif", chart=chart, out=tmp_path / "python")
    with pytest.raises(InputError, match=r"corners_px: expected \[4, 2\] pixels"):
        coupole.calibrate_colour(uneven / "chart.tif", chart=chart, corners_px=[1, 2])


def test_a_turned_chart_is_found_by_its_colours_and_told(tmp_path: Path) -> None:
    drawn = replace(EVEN, turn_deg=180.0)
    picture = write_picture(tmp_path / "p.tif", drawn.picture())
    chart = drawn.write_chart(tmp_path)
    record = profile(picture, chart=chart)
    assert "the chart is turned; its top left patch is at" in remark_with(record, "turned")
    given = profile(picture, chart=chart, corners_px=np.rint(np.roll(drawn.corners_px, 1, axis=0)[::-1]))
    assert matrix_of(given)[0] == pytest.approx(matrix_of(record)[0], abs=0.01)
    assert remark_with(given, "turned")
    mirrored = write_picture(tmp_path / "m.tif", drawn.picture()[:, ::-1])
    assert "seen mirrored" in refusal(mirrored, "--chart", chart)


def test_saturated_patches_are_left_out_and_told(tmp_path: Path) -> None:
    drawn = replace(EVEN, exposure=1.25)
    picture = write_picture(tmp_path / "p.tif", drawn.picture())
    record = made(tmp_path, picture, "--chart", drawn.write_chart(tmp_path))
    assert "p.tif on " in remark_with(record, "saturated, and left out")
    assert "D1" in remark_with(record, "saturated, and left out")
    assert "D1" not in (tmp_path / "x.csv").read_text()
    matrix, u = matrix_of(record)
    assert np.abs((matrix - EVEN.true_matrix()) / u).max() < 5.0  # of fewer patches
    cut = np.minimum(drawn.picture(), 0.9)  # as a converter does that keeps room above white
    cut_record = profile(write_picture(tmp_path / "c.tif", cut), chart=tmp_path / "chart.yaml")
    assert "D1" in remark_with(cut_record, "saturated, and left out")
    too_bright = write_picture(tmp_path / "b.tif", replace(EVEN, exposure=12.0).picture())
    assert "leave the picture or are saturated" in refusal(
        too_bright, "--chart", tmp_path / "chart.yaml", "--corners", corner_words(EVEN)
    )


def corner_words(drawn: DrawnChart) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in drawn.corners_px)


def test_several_pictures_are_one_profile(even: Path, tmp_path: Path) -> None:
    for number, turn in enumerate((0.0, 180.0, 90.0)):
        write_picture(tmp_path / f"p{number}.tif", replace(EVEN, turn_deg=turn, exposure=0.5).picture())
    write_picture(tmp_path / "q.png", np.full((480, 640, 3), 0.2))
    record = profile(tmp_path, chart=even / "chart.yaml")
    matrix, u = matrix_of(record)
    assert np.abs((matrix - EVEN.true_matrix()) / u).max() < 3.5
    assert "left out: q.png: the chart was not found" in remark_with(record, "q.png")
    assert "fewer than three" not in " ".join(record.remarks)
    tinted = write_picture(tmp_path / "p3.tif", EVEN.picture() * (1.0, 0.8, 0.6))
    assert "differs in colour" in refusal(even / "chart.tif", tinted, "--chart", even / "chart.yaml")


def test_values_alone_are_a_chart_of_letters_for_rows(even: Path, tmp_path: Path) -> None:
    record = made(tmp_path, even / "chart.tif", "--chart", even / "values.csv")
    by_description = profile(even / "chart.tif", chart=even / "chart.yaml")
    assert matrix_of(record)[0] == pytest.approx(matrix_of(by_description)[0], abs=0.02)
    odd = tmp_path / "odd.csv"
    odd.write_text((even / "values.csv").read_text().replace("B3,", "skin,"))
    assert "expected patches A1, A2" in refusal(even / "chart.tif", "--chart", odd)
    missing = tmp_path / "missing.csv"
    missing.write_text("".join((even / "values.csv").read_text().splitlines(keepends=True)[:-1]))
    assert "of all rows and columns" in refusal(even / "chart.tif", "--chart", missing)


def test_openexr_and_floating_point_are_linear_and_may_say_what_is_saturated(even: Path, tmp_path: Path) -> None:
    values = EVEN.picture().astype(np.float32)
    full = (values > 0.5).any(axis=2).astype(np.float32)
    channels = {name: np.ascontiguousarray(values[..., n]) for n, name in enumerate("RGB")} | {"saturated": full}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(tmp_path / "p.exr"))
    record = profile(tmp_path / "p.exr", chart=even / "chart.yaml")
    assert "D1" in remark_with(record, "saturated, and left out")
    floating = write_picture(tmp_path / "f.tiff", EVEN.picture(), bits=32)
    matrix, u = matrix_of(profile(floating, chart=even / "chart.yaml"))
    assert np.abs((matrix - EVEN.true_matrix()) / u).max() < 3.5


def test_an_offset_of_the_greys_is_told(even: Path, tmp_path: Path) -> None:
    veiled = write_picture(tmp_path / "p.tif", EVEN.picture() + np.array([0.003, 0.008, 0.004]))
    record = profile(veiled, chart=even / "chart.yaml")
    assert "offset of +" in remark_with(record, "stray light")
    clean = profile(even / "chart.tif", chart=even / "chart.yaml")
    assert not any("stray light" in remark for remark in clean.remarks)


def test_edges_of_the_chart_give_the_sharpness_or_say_why_not(even: Path, tmp_path: Path) -> None:
    text = (even / "chart.yaml").read_text().replace("values.csv", str(even / "values.csv"))
    edges = "edges:\n  - {name: white, centre_mm: [-64.0, -33.0], size_mm: [4.0, 14.0]}\n"
    (tmp_path / "chart.yaml").write_text(text + edges)
    record = profile(even / "chart.tif", chart=tmp_path / "chart.yaml")
    assert 0.2 < record.fixed["figure.mtf50"] < 1.0
    (tmp_path / "chart.yaml").write_text(text + edges.replace("-64.0, -33.0", "-55.0, -33.0"))
    record = profile(even / "chart.tif", chart=tmp_path / "chart.yaml")
    assert "sharpness is not stated: " in remark_with(record, "sharpness")
    assert "figure.mtf50" not in record.fixed


@pytest.mark.skipif(not REAL_DNG.is_file(), reason="no raw file beside the project")
def test_a_real_chart_in_a_raw_file_has_its_published_colours(
    tmp_path: Path,
) -> None:
    published = colour.SDS_COLOURCHECKERS["BabelColor Average"]
    bands = next(iter(published.values())).wavelengths
    lines = ["name," + ",".join(f"{nm:.0f}" for nm in bands)]
    for number, spectrum in enumerate(published.values()):
        name = f"{'ABCD'[number // 6]}{number % 6 + 1}"
        lines.append(f"{name}," + ",".join(f"{value:.5f}" for value in spectrum.values))
    (tmp_path / "values.csv").write_text("\n".join(lines) + "\n")
    record = profile(REAL_DNG, chart=tmp_path / "values.csv")
    assert record.fixed["left_out.matrix.mean_de00"] < 4.0
    assert "black level" in remark_with(record, "offset of")


def test_noise_that_neighbours_share_counts_in_full() -> None:
    random = np.random.default_rng(5)
    square = np.array([[(10.0, 10.0), (69.0, 10.0), (69.0, 69.0), (10.0, 69.0)]])
    means, stated = [], []
    for _ in range(60):
        noise = cv2.GaussianBlur(random.normal(0.0, 0.1, (80, 80, 3)), (0, 0), 1.5)
        picture = PlainPicture("p", (0.5 + noise).astype(np.float32), np.zeros((80, 80), np.bool_))
        plain = read_plain_patches(picture, square, ["A1"])
        means.append(plain.reading.mean[0])
        stated.append(plain.reading.u[0])
    assert np.mean(stated) == pytest.approx(np.std(means), rel=0.2)


def test_a_patch_left_out_takes_no_part_in_finding_the_light(even: Path, tmp_path: Path) -> None:
    values = EVEN.picture()
    x, y = EVEN.corners_px[0].astype(int)
    values[y - 30 : y + 30, x - 30 : x + 30] *= 0.8
    picture = read_chart_photograph(write_picture(tmp_path / "p.tif", values))
    sighting = see_in_pictures([picture], read_chart(even / "chart.yaml"), None, None, lambda *_: None).sighting
    assert sighting.signals_without is not None
    truth = EVEN.signals(EVEN.spectra)
    relative = [
        (signals.mean / truth)[0] / np.median(signals.mean / truth, axis=0)
        for signals in (sighting.signals, sighting.signals_without[0])
    ]
    assert relative[1].mean() == pytest.approx(0.8, abs=0.06)
    assert relative[0].mean() > relative[1].mean() + 0.02


# -- what is refused ------------------------------------------------------------------------------------------


def srgb_of(values: Array) -> Array:
    """Codes 0 to 1."""
    inside = np.clip(values, 0.0, 1.0)
    return np.where(inside <= 0.0031308, 12.92 * inside, 1.055 * inside ** (1.0 / 2.4) - 0.055)


def test_pictures_for_displays_are_refused_unless_their_curve_is_stated(even: Path, tmp_path: Path) -> None:
    chart = ("--chart", even / "chart.yaml")
    encoded = write_picture(tmp_path / "p.png", srgb_of(EVEN.picture()), bits=8)
    why = refusal(encoded, *chart)
    assert (
        "p.png: its values are not linear: on the greys they are proportional to light to the power of 0." in why
    )
    assert "--srgb" in why
    matrix, u = matrix_of(profile(encoded, chart=even / "chart.yaml", srgb=True))
    assert np.abs((matrix - EVEN.true_matrix()) / u).max() < 3.5
    assert "to the power of 1.6" in refusal(even / "chart.tif", *chart, "--srgb")
    jpeg = tmp_path / "p.jpg"
    assert cv2.imwrite(str(jpeg), cv2.imread(str(encoded)))
    assert "a JPEG is encoded for displays" in refusal(jpeg, *chart)
    few_greys = ("--without", "D2,D3,D4,D5,D6")
    assert "8 bits, and the chart has too few greys" in refusal(encoded, *chart, *few_greys)


def test_another_chart_or_place_is_refused(even: Path, tmp_path: Path) -> None:
    other = replace(EVEN, seed=77)
    why = refusal(even / "chart.tif", "--chart", other.write_chart(tmp_path))
    assert "miss the chart's colours by" in why
    shifted = corner_words(EVEN).split()
    shifted[0] = shifted[3]
    assert "--corners" in refusal(
        even / "chart.tif", "--chart", even / "chart.yaml", "--corners", " ".join(shifted)
    )
    flat = write_picture(tmp_path / "flat.tif", np.full((480, 640, 3), 0.3))
    why = refusal(flat, "--chart", even / "chart.yaml")
    assert "flat.tif: the chart was not found: expected a sharp picture of the whole chart, 4 rows of 6" in why
    assert "--corners" in why


def test_bad_white_cards_are_refused(uneven: Path, even: Path, tmp_path: Path) -> None:
    arguments = (uneven / "chart.tif", "--chart", uneven / "chart.yaml", "--white")
    white = uneven_chart().picture(white=True)
    bright = write_picture(tmp_path / "bright.tif", 3.0 * white)
    assert "--white bright.tif: saturated" in refusal(*arguments, bright)
    assert "the light is not smooth" in refusal(*arguments, uneven / "chart.tif")
    small = write_picture(tmp_path / "small.tif", white[::2, ::2])
    assert "expected pictures of one camera" in refusal(*arguments, small)
    half = white.copy()
    half[:, 320:] *= 0.2
    assert "the light is not smooth" in refusal(*arguments, write_picture(tmp_path / "half.tif", half))


def test_files_and_options_that_do_not_belong_are_refused(even: Path, tmp_path: Path) -> None:
    chart = ("--chart", even / "chart.yaml")
    assert "no such run or picture" in refusal(tmp_path / "none.tif", *chart)
    assert "expected a run, or a folder with pictures of the chart" in refusal(tmp_path, *chart)
    (tmp_path / "text.tif").write_text("no picture")
    assert "cannot be decoded" in refusal(tmp_path / "text.tif", *chart)
    assert cv2.imwrite(str(tmp_path / "grey.png"), np.full((480, 640), 900, np.uint16))
    assert "has one channel" in refusal(tmp_path / "grey.png", *chart)
    assert "--dark: belongs to a run" in refusal(even / "chart.tif", *chart, "--dark", tmp_path / "dark.yaml")
    assert "--emission: belongs to a run" in refusal(even / "chart.tif", *chart, "--emission", "paper")
    assert "found" in refusal(even / "chart.tif", *chart, "--corners", "1,2 3")
    assert "no patch Z9" in refusal(even / "chart.tif", *chart, "--without", "Z9")


def test_json_has_the_bound_for_new_colours_in_the_record(even: Path, tmp_path: Path) -> None:
    result = calibrate(tmp_path, even / "chart.tif", "--chart", even / "chart.yaml")
    assert json.loads(result.stdout)["accepted"]
    fixed = read_record(tmp_path / "x.yaml").fixed
    for form in ("matrix", "root_polynomial"):
        name = form.replace("_", "-")
        assert fixed[f"left_out.{name}.q95_de00"] <= fixed[f"left_out.{name}.bound_de00"]
    assert fixed["left_out.bound_share"] == pytest.approx(0.95)
