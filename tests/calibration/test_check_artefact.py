"""`coupole calibrate check-artefact` and `coupole certificate`: a second board, E_n, and a page to print."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from artefact_cells import board_checks, tile_checks
from photographed import BOARD_YAML, shoot, write_folder
from typer import Typer
from typer.testing import CliRunner, Result

from coupole.calibration.check.permissible import parse_permissible
from coupole.calibration.check.workflow import limits_of
from coupole.calibration.record import Comparison, read_record
from coupole.commands.calibrate import calibrate_app
from coupole.commands.certificate import certificate
from coupole.errors import CalibrationRefused, InputError

ARTEFACT = """\
artefact:
  name: board
  serial: {serial}
  certificate: {{number: L-{serial}, laboratory: Laboratory A, date: 2026-02-11}}
  expansion_ppm_per_k: {{value: 8.0, expanded_u: 1.0, k: 2}}
  square_mm: {{value: {side}, expanded_u: 0.0016, k: 2}}
"""
ABOUT = """\
number: C-7
laboratory: {name: Dome laboratory, address: 1 Dome Street}
place: at the laboratory
customer: {name: Museum, address: 2 Hill}
item: {name: the dome, identification: D-1}
authorised_by: {name: NN, function: head of the laboratory}
climate: {temperature_c: [20.5, 21.5], u_temperature_k: 0.2, humidity_percent: [40, 45], instrument: meter H-2}
"""


def board(folder: Path, serial: str, side: float = 16.0) -> Path:
    path = folder / f"{serial}.yaml"
    path.write_text(BOARD_YAML + ARTEFACT.format(serial=serial, side=side))
    return path


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a hand-eye record by the first board, and pictures of the second one at two positions."""
    folder = tmp_path_factory.mktemp("cell")
    pictures = write_folder(folder / "pictures")
    words = [
        "--board",
        board(folder, "CB-1"),
        "--model",
        "brown4",
        "--out",
        folder / "records",
        "--name",
        "hand-eye",
    ]
    result = CliRunner().invoke(calibrate_app, ["hand-eye", str(pictures), *map(str, words)])
    assert result.exception is None, result.output
    for seed in (4, 5):
        write_folder(folder / f"place{seed}", shoot(count=5, seed=seed))
    return folder


def check(cell: Path, description: Path, out: Path, *words: object) -> Result:
    places = [str(cell / "place4"), str(cell / "place5")]
    options = ["--records", cell / "records", "--board", description, "--out", out, "--name", "check", "--json"]
    return CliRunner().invoke(calibrate_app, ["check-artefact", *places, *map(str, [*options, *words])])


def refusal(result: Result) -> str:
    assert isinstance(result.exception, InputError), result.output
    return str(result.exception)


def test_a_second_board_agrees_with_its_certificate(cell: Path, tmp_path: Path) -> None:
    result = check(cell, board(tmp_path, "CB-2"), tmp_path, "--mpe-um", "300+L/2", "--board-c", "20")
    assert result.exception is None, result.output
    document: dict[str, Any] = json.loads(result.stdout)
    lengths = document["comparisons"]
    assert {length["position"] for length in lengths} == {"place4", "place5"}
    assert {length["name"].split(",")[0] for length in lengths} == {"row", "column", "diagonal", "other diagonal"}
    assert all(0 <= length["en"] <= 1.5 for length in lengths)
    assert max(length["certified_value"] for length in lengths) == pytest.approx(128.0)
    record = read_record(tmp_path / "check.yaml")
    assert record.kind == "artefact-check"
    assert record.artefacts[0].artefact.serial == "CB-2"
    assert {line.name for line in record.inputs} >= {"CB-2.yaml", "hand-eye.yaml", "place4/0.png"}
    page = (tmp_path / "check.html").read_text()
    assert page.index("<img") < page.index("Measured and certified")
    assert "L-CB-2, Laboratory A" in page


def test_a_board_that_is_not_what_its_certificate_says_is_found(cell: Path, tmp_path: Path) -> None:
    result = check(cell, board(tmp_path, "CB-3", 16.1), tmp_path)
    assert isinstance(result.exception, CalibrationRefused)
    assert "E_n of the mean over all values" in str(result.exception)
    assert not read_record(tmp_path / "check.yaml").is_accepted


def test_an_error_beyond_the_permissible_one_is_a_limit(cell: Path, tmp_path: Path) -> None:
    result = check(cell, board(tmp_path, "CB-2"), tmp_path, "--mpe-um", "0.001", "--board-c", "20")
    assert isinstance(result.exception, CalibrationRefused)
    assert "largest error of a length over its MPE" in str(result.exception)


def test_what_is_not_independent_is_refused_by_name(cell: Path, tmp_path: Path) -> None:
    said = refusal(check(cell, board(tmp_path, "cb-1"), tmp_path))
    assert "board, serial cb-1 took part in the hand-eye record" in said
    (tmp_path / "plain.yaml").write_text(BOARD_YAML)
    assert "expected a block `artefact`" in refusal(check(cell, tmp_path / "plain.yaml", tmp_path))
    words = ["--records", cell / "records", "--board", board(tmp_path, "CB-2"), "--out", tmp_path]
    same = CliRunner().invoke(calibrate_app, ["check-artefact", str(cell / "pictures"), *map(str, words)])
    assert "was made from the same images (pictures/0.png), so the comparison would check nothing" in refusal(same)
    neither = CliRunner().invoke(calibrate_app, ["check-artefact", str(cell / "place4"), "--out", str(tmp_path)])
    assert "give one of --board and --tile" in refusal(neither)


def test_a_permissible_error_grows_with_the_length() -> None:
    assert parse_permissible("50+L/20").at(100.0) == pytest.approx(0.055)
    assert parse_permissible("50").at(100.0) == pytest.approx(0.05)
    for words in ("50+L", "a", "-1", "50+L/0", "nan"):
        with pytest.raises(InputError, match=r"expected A\+L/K"):
            parse_permissible(words)


def test_en_is_the_error_over_both_expanded_uncertainties() -> None:
    value = Comparison(
        position="p", name="n", unit="mm", certified_value=10.0, expanded_u_certified=0.3, measured_value=10.5,
        expanded_u_measured=0.4,
    )  # fmt: skip
    assert value.en == pytest.approx(1.0)


def test_drawn_artefacts_hold_and_wrong_ones_are_found(tmp_path: Path, scale: Any) -> None:
    """The small form of `tools/prove_artefacts.py`."""
    good, bad = board_checks(1, tmp_path, positions=scale(2, 5), wrong_ppm=(0.0, 400.0))
    assert np.mean([value.en <= 1.0 for value in good.comparisons]) > 0.8
    assert not all(limit.is_met for limit in limits_of(bad, {}))
    u = {parameter.u for check in (good, bad) for parameter in check.parameters}
    assert 20.0 < min(u) < max(u) < 120.0
    good, bad = tile_checks(1, places=1, wrong=(0.0, -0.03))
    assert all(value.en <= 1.0 for value in good.comparisons)
    assert not any(value.en <= 1.0 for value in bad.comparisons)


# -- the certificate --------------------------------------------------------------------------------------------


def certified(cell: Path, folder: Path, *words: object, about: str = ABOUT) -> Result:
    (folder / "about.yaml").write_text(about)
    app = Typer()
    app.command()(certificate)
    options = ["--about", folder / "about.yaml", "--out", folder / "c.html", "--json", *words]
    return CliRunner().invoke(app, [str(cell / "records"), *map(str, options)])


def test_a_certificate_has_what_the_standard_lists(cell: Path, tmp_path: Path) -> None:
    result = certified(cell, tmp_path)
    assert result.exception is None, result.output
    document = json.loads((tmp_path / "c.json").read_text())
    assert document == json.loads(result.stdout)
    assert document["chain"][0]["traceability"] == [
        "board board, serial CB-1: certificate L-CB-1 of Laboratory A, 2026-02-11"
    ]
    assert document["chain"][0]["gaps"] == []
    by_name = {figure["name"]: figure for figure in document["results"][0]["parameters"]}
    record = read_record(cell / "records/hand-eye.yaml")
    fx = next(parameter for parameter in record.parameters if parameter.name == "fx_px")
    assert by_name["fx_px"]["expanded_u"] == pytest.approx(by_name["fx_px"]["k"] * fx.u)
    page = (tmp_path / "c.html").read_text()
    for words in (
        "Certificate of calibration C-7", "Dome laboratory, 1 Dome Street", "at the laboratory", "Museum, 2 Hill",
        "the dome, D-1", "relate only to the items calibrated", "NN, head of the laboratory",
        "20.5 to 21.5 C, u 0.2 K", "meter H-2", "unbroken", record.sha256, "End of certificate",
    ):  # fmt: skip
        assert words in page, words
    assert "SIMULATED" not in page


def test_a_broken_chain_is_told_and_not_issued(cell: Path, tmp_path: Path) -> None:
    from coupole.calibration.record import seal_record, write_record

    record = read_record(cell / "records/hand-eye.yaml")
    content = {
        key: getattr(record, key) for key in type(record).model_fields if key not in ("schema_version", "sha256")
    }
    folder = tmp_path / "records"
    write_record(folder / "bare.yaml", seal_record(**content | {"artefacts": (), "simulated": True}))
    (tmp_path / "about.yaml").write_text(ABOUT)
    app = Typer()
    app.command()(certificate)
    words = [folder, "--about", tmp_path / "about.yaml", "--out", tmp_path / "c.html"]
    result = CliRunner().invoke(app, list(map(str, words)))
    assert isinstance(result.exception, CalibrationRefused)
    assert "hand-eye hand-eye: not traceable: no certificate" in str(result.exception)
    page = (tmp_path / "c.html").read_text()
    assert "SIMULATED DATA" in page
    assert "Not to be issued" in page


def test_a_figure_that_drifts_by_more_than_its_uncertainty_is_told(cell: Path, tmp_path: Path) -> None:
    from datetime import timedelta

    from coupole.calibration.record import seal_record, write_record

    record = read_record(cell / "records/hand-eye.yaml")
    content = {
        key: getattr(record, key) for key in type(record).model_fields if key not in ("schema_version", "sha256")
    }
    moved = tuple(
        p.model_copy(update={"value": (p.value or 0.0) - 20 * p.u}) if p.name == "fx_px" else p
        for p in record.parameters
    )
    for name, parameters in (("moved", moved), ("same", record.parameters)):
        earlier = {"parameters": parameters, "created": record.created - timedelta(seconds=1), "name": name}
        write_record(tmp_path / name / f"{name}.yaml", seal_record(**content | earlier))
    told = certified(cell, tmp_path, "--earlier", tmp_path / "moved")
    assert "expired by drift: fx_px changed by" in str(told.exception)
    (tmp_path / "c.html").unlink()
    (tmp_path / "c.json").unlink()
    assert certified(cell, tmp_path, "--earlier", tmp_path / "same").exception is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[20.5, 21.5]", "[21.5, 20.5]"), "the lower value first"),
        (("number: C-7\n", ""), "number"),
        (("place:", "plaice:"), "plaice"),
    ],
)
def test_wrong_statements_are_refused(cell: Path, tmp_path: Path, change: tuple[str, str], message: str) -> None:
    said = refusal(certified(cell, tmp_path, about=ABOUT.replace(*change)))
    assert "about.yaml:" in said
    assert message in said
    assert not (tmp_path / "c.html").exists()


def test_the_examples_of_the_docs_can_be_read() -> None:
    from places import REPO

    from coupole.calibration.certificate.statements import read_description
    from coupole.calibration.lens.board import read_board
    from coupole.calibration.light.spectralon import read_tile

    folder = REPO / "configs/artefacts"
    example = read_board(folder / "board.yaml").artefact
    assert example is not None
    assert example.serial == "EXAMPLE-BOARD-2"
    assert read_tile(folder / "tile.yaml").of_channel("B").reflectance == pytest.approx(0.988, abs=1e-3)
    assert read_description(folder / "certificate.yaml").number == "EXAMPLE-C-1"
