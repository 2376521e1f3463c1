"""CxF3 files of patches, as instruments write them and as they may be wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coupole.calibration.colour.chart import read_chart
from coupole.calibration.colour.chart_values import read_chart_values
from coupole.calibration.colour.colorimetry import lab_of
from coupole.calibration.colour.cxf_values import read_cxf_values
from coupole.errors import InputError

NM = np.arange(380, 731, 10)
SPECTRA = {"A1": np.linspace(0.05, 0.9, len(NM)), "A2": np.linspace(0.8, 0.1, len(NM))}


def words(values: np.ndarray) -> str:
    return " ".join(f"{value:.5f}" for value in values)


def cxf(objects: str, *, increment: str = ' Increment="10"', light: str = "D50", prefix: str = "cc") -> str:
    """A document with one specification of spectra and one of colours."""
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<cc:CxF xmlns:cc="http://colorexchangeformat.com/CxF3-core" xmlns:own="urn:maker">\n'
        "<cc:FileInformation><cc:Creator>a test</cc:Creator></cc:FileInformation>\n"
        f"<cc:Resources><cc:ObjectCollection>{objects}</cc:ObjectCollection>\n"
        '<cc:ColorSpecificationCollection><cc:ColorSpecification Id="spectra"><cc:MeasurementSpec>'
        "<cc:MeasurementType>Spectrum_Reflectance</cc:MeasurementType>"
        f'<cc:WavelengthRange StartWL="380"{increment}/></cc:MeasurementSpec></cc:ColorSpecification>'
        '<cc:ColorSpecification Id="colours"><cc:TristimulusSpec>'
        f"<cc:Illuminant>{light}</cc:Illuminant><cc:Observer>2_Degree</cc:Observer>"
        "</cc:TristimulusSpec></cc:ColorSpecification></cc:ColorSpecificationCollection></cc:Resources>\n"
        '<cc:CustomResources><own:Prism Paper="matt"/></cc:CustomResources></cc:CxF>\n'
    )
    return text.replace("cc:", f"{prefix}:").replace("xmlns:cc", f"xmlns:{prefix}")


def spectrum(values: np.ndarray) -> str:
    return f'<cc:ReflectanceSpectrum ColorSpecification="spectra">{words(values)}</cc:ReflectanceSpectrum>'


def colour(space: str, **values: float) -> str:
    inner = "".join(f"<cc:{name}>{value}</cc:{name}>" for name, value in values.items())
    return f'<cc:Color{space} ColorSpecification="colours">{inner}</cc:Color{space}>'


def patch(name: str, colours: str, kind: str = "Standard", more: str = "") -> str:
    return (
        f'<cc:Object ObjectType="{kind}" Name="{name}" Id="{kind}{name}">'
        f"<cc:ColorValues>{colours}</cc:ColorValues>{more}</cc:Object>\n"
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "chart.cxf"


@pytest.fixture
def by_csv(tmp_path: Path) -> dict[str, np.ndarray]:
    """The same spectra by the other reader."""
    rows = [f"{name},{words(values).replace(' ', ',')}" for name, values in SPECTRA.items()]
    (tmp_path / "same.csv").write_text("\n".join(["name," + ",".join(map(str, NM)), *rows]) + "\n")
    return dict(read_chart_values(tmp_path / "same.csv").xyz)


@pytest.mark.parametrize("prefix", ["cc", "ns0"])
def test_spectra_are_those_of_a_csv(prefix: str, file: Path, by_csv: dict[str, np.ndarray]) -> None:
    file.write_text(
        cxf("".join(patch(n, spectrum(v)) for n, v in SPECTRA.items()), prefix=prefix).replace(
            "<cc:", f"<{prefix}:"
        )
    )
    found = read_cxf_values(file).xyz
    assert list(found) == list(SPECTRA)
    assert all(np.allclose(found[name], by_csv[name], atol=1e-9) for name in SPECTRA)


def test_i1profilers_numbered_objects_are_told_by_place_and_condition(
    file: Path, by_csv: dict[str, np.ndarray]
) -> None:
    objects = '<cc:Object ObjectType="Target" Name="Target1" Id="t"><cc:DeviceColorValues><cc:ColorRGB>'
    objects += "<cc:R>1</cc:R><cc:G>2</cc:G><cc:B>3</cc:B></cc:ColorRGB></cc:DeviceColorValues></cc:Object>"
    for kind, factor in (("M1_Measurement", 0.9), ("M2_Measurement", 1.0)):
        for number, values in enumerate(SPECTRA.values()):
            place = {"Page": "1", "Row": "0", "Column": str(number), "SampleID": "-1"}
            tags = "".join(f'<cc:Tag Name="{name}" Value="{value}"/>' for name, value in place.items())
            location = f'<cc:TagCollection Name="Location">{tags}</cc:TagCollection>'
            objects += patch(f"{kind}{number + 1}", spectrum(factor * values), kind, location)
    file.write_text(cxf(objects))
    with pytest.raises(
        InputError, match="A1 is given twice; choose one of the types M1_Measurement, M2_Measurement"
    ):
        read_cxf_values(file)
    found = read_cxf_values(file, object_type="M2_Measurement").xyz
    assert all(np.allclose(found[name], by_csv[name], atol=1e-9) for name in SPECTRA)
    with pytest.raises(InputError, match="no objects of type M3; it has M1_Measurement, M2_Measurement"):
        read_cxf_values(file, object_type="M3")


def test_lab_and_xyz_are_taken_under_d50_alone(file: Path) -> None:
    lab, xyz = colour("CIELab", L=50, A=20, B=-10), colour("CIEXYZ", X=20, Y=18, Z=22)
    file.write_text(cxf(patch("A1", lab) + patch("A2", xyz)))
    found = read_cxf_values(file).xyz
    assert lab_of(found["A1"][None])[0] == pytest.approx([50.0, 20.0, -10.0], abs=1e-9)
    assert found["A2"] == pytest.approx([0.20, 0.18, 0.22])
    file.write_text(cxf(patch("A1", lab), light="D65"))
    with pytest.raises(InputError, match="expected A1 under D50 for the observer 2_Degree; found D65"):
        read_cxf_values(file)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<html/>", "expected"),
        (cxf(""), r"expected objects with colours \(ColorValues\); found none"),
        (cxf(patch("A1", spectrum(SPECTRA["A1"])), increment=""), "A1 has no wavelengths"),
        (cxf(patch("A1", spectrum(SPECTRA["A1"][:5]))), "10 bands or more; A1 has 5"),
        (cxf(patch("A1", spectrum(2.0 * SPECTRA["A1"]))), "may be percent or a fraction"),
        (cxf(patch("A1", "")), "A1 has no ReflectanceSpectrum"),
        (cxf(patch("A1", spectrum(SPECTRA["A1"]).replace("0.07429", "dark"))), "finite numbers for A1"),
        (cxf(patch("A1", spectrum(SPECTRA["A1"]).replace("0.07429", "NaN"))), "finite numbers for A1"),
        (cxf(patch("A1", colour("CIELab", A=20, B=-10))), "finite numbers for A1; found None"),
        (cxf("").replace("UTF-8", "none-such"), "expected CxF3"),
        (cxf(patch("A1", spectrum(SPECTRA["A1"])))[:700], r"chart\.cxf:\d+:\d+: expected CxF3"),
        ('<!DOCTYPE x [<!ENTITY a "b">]>' + cxf(""), "without a document type"),
    ],
)
def test_what_is_no_chart_in_cxf_is_refused(text: str, message: str, file: Path) -> None:
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_cxf_values(file)


def test_a_charts_description_may_name_a_cxf_file(file: Path, tmp_path: Path) -> None:
    greys = {
        f"{row}{column}": 0.1 + 0.08 * n for n, (row, column) in enumerate((r, c) for r in "AB" for c in "1234")
    }
    file.write_text(cxf("".join(patch(n, spectrum(np.full(len(NM), grey))) for n, grey in greys.items())))
    (tmp_path / "chart.yaml").write_text(
        "schema_version: 1\nname: greys\nrows: 2\ncolumns: 4\npitch_mm: [20, 20]\npatch_mm: [18, 18]\n"
        "values: chart.cxf\ncxf_type: Standard\n"
    )
    chart = read_chart(tmp_path / "chart.yaml")
    assert chart.xyz[:, 1] == pytest.approx(list(greys.values()), abs=1e-6)
