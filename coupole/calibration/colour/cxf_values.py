"""Values of a chart's patches from CxF3 files (ISO 17972-1), which today's instruments write. colour-cxf reads
them.

A patch is an object with a name. i1Profiler numbers its objects instead (`M1_Measurement12`) and gives their row
and column: such patches are named A1, A2, ... by their place. The reflectance spectrum of a patch is preferred.
Its wavelengths follow from the first one (of the spectrum, or of its colour specification) and from the increment
of the specification. Without spectra, L*a*b* or XYZ is taken, only under D50 for the 1931 observer. A file may
hold each patch several times, once for each condition of measurement (ISO 13655: M0, M1, M2). The type of the
objects says which of them are used.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from coupole.calibration.colour.chart_values import ChartValues, Unit, reflectance_fractions
from coupole.calibration.colour.colorimetry import xyz_of, xyz_of_spectra
from coupole.calibration.rotations import Floats
from coupole.errors import InputError, Problem, reason

if TYPE_CHECKING:
    from colour_cxf.cxf3 import CxF

ENDINGS = (".cxf", ".mxf", ".xml")
"""Ends of the names of CxF files; i1Profiler writes .mxf."""
_LEAST_BANDS = 10


def read_cxf_values(path: Path, unit: Unit = "auto", object_type: str | None = None) -> ChartValues:
    """Return the colours of the named objects; if a type is given, only of objects of this type.

    Raises InputError if the file is not CxF3, a patch occurs twice, spectra have no wavelengths, or colours are
    missing or under another light.
    """
    document = _parse(path)
    resources = document.resources
    collection = None if resources is None else resources.object_collection
    objects = [
        (_patch_name(item), str(item.object_type), item.color_values)
        for item in ([] if collection is None else collection.object_value)
        if item.color_values is not None
    ]
    objects = _objects_of_type(path, objects, object_type)
    specifications: dict[str, Any] = {}
    if resources is not None and resources.color_specification_collection is not None:
        specifications = {item.id: item for item in resources.color_specification_collection.color_specification}
    spectra = {name: _first_colour(values, "ReflectanceSpectrum") for name, _, values in objects}
    if all(spectrum is not None for spectrum in spectra.values()):
        return ChartValues(_colours_of_spectra(path, spectra, specifications, unit))
    return ChartValues({name: _colour(path, name, values, specifications) for name, _, values in objects})


def _parse(path: Path) -> CxF:
    from colour_cxf.cxf3 import CxF
    from xsdata.formats.dataclass.parsers import XmlParser
    from xsdata.formats.dataclass.parsers.config import ParserConfig

    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read the values of the chart: {reason(error)}") from error
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise InputError(f"{path}: expected CxF without a document type; found one")
    parser = XmlParser(config=ParserConfig(fail_on_unknown_properties=False))
    try:
        ElementTree.fromstring(content)  # the parser below takes half a document for a whole one
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of makers' own values, which are not used here
            return parser.from_bytes(content, CxF)
    except ElementTree.ParseError as error:
        line, column = error.position
        raise InputError([Problem(str(path), line, column + 1, "", f"expected CxF3; {error.msg}")]) from error
    except (LookupError, ValueError) as error:  # an unknown encoding, no CxF
        raise InputError(f"{path}: expected CxF3; {error}") from error


def _patch_name(item: Any) -> str:
    """Return the object's name. If the object has only a number, return A1, A2, ... by its place."""
    name = str(item.name)
    tags = {
        str(tag.name): str(tag.value)
        for tags_of_kind in item.tag_collection
        if tags_of_kind.name == "Location"
        for tag in tags_of_kind.tag
    }
    place = [tags.get(key, "") for key in ("Row", "Column")]
    if not re.fullmatch(rf"{re.escape(str(item.object_type))}\d+", name) or not all(map(str.isdigit, place)):
        return name
    row, column = map(int, place)
    page = tags.get("Page", "1")
    return ("" if page == "1" else f"{page}:") + (
        f"{chr(65 + row)}{column + 1}" if row < 26 else f"{row}.{column}"
    )


def _objects_of_type(
    path: Path, objects: Sequence[tuple[str, str, Any]], object_type: str | None
) -> list[tuple[str, str, Any]]:
    """Return the objects of the type, each name once."""
    types = list(dict.fromkeys(of_type for _, of_type, _ in objects))
    if object_type is not None and object_type not in types:
        raise InputError(f"{path}: has no objects of type {object_type}; it has {', '.join(types) or 'none'}")
    matching = [item for item in objects if object_type in (None, item[1])]
    if not matching:
        raise InputError(f"{path}: expected objects with colours (ColorValues); found none")
    names = [name for name, _, _ in matching]
    if twice := next((name for name in names if names.count(name) > 1), None):
        hint = (
            f"choose one of the types {', '.join(types)} by `cxf_type`" if len(types) > 1 else "keep one of them"
        )
        raise InputError(f"{path}: the patch {twice} is given twice; {hint}")
    return matching


def _first_colour(values: Any, kind: str) -> Any | None:
    """Return the first colour of a kind, by the name of its element."""
    return next((item for item in values.choice if type(item).__name__.lower() == kind.lower()), None)


def _colours_of_spectra(
    path: Path, spectra: dict[str, Any], specifications: dict[str, Any], unit: Unit
) -> dict[str, Floats]:
    colours = {}
    tables = {name: _numbers(path, name, spectrum.value) for name, spectrum in spectra.items()}
    fractions = reflectance_fractions(path, np.concatenate(list(tables.values())), unit)
    ends = np.cumsum([len(values) for values in tables.values()])
    for (name, spectrum), values in zip(spectra.items(), np.split(fractions, ends[:-1]), strict=True):
        nm = _wavelengths_nm(path, name, spectrum, specifications.get(spectrum.color_specification))
        colours[name] = xyz_of_spectra(nm, values[None])[0]
    return colours


def _numbers(path: Path, name: str, values: Sequence[Any]) -> Floats:
    """[n]. Raises InputError for a value that is not a number or is missing, because the parser keeps such
    values."""
    try:
        numbers = np.asarray(values, float)
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: expected finite numbers for {name}; found {' '.join(map(str, values))[:60]}")
    return numbers


def _wavelengths_nm(path: Path, name: str, spectrum: Any, specification: Any) -> Floats:
    measurement = getattr(specification, "measurement_spec", None)
    band_range = getattr(measurement, "wavelength_range", None)
    start = spectrum.start_wl if spectrum.start_wl is not None else getattr(band_range, "start_wl", None)
    increment = getattr(band_range, "increment", None)
    if start is None or not increment:
        raise InputError(
            f"{path}: the spectrum of {name} has no wavelengths; expected StartWL, and the Increment of its "
            "specification"
        )
    if len(spectrum.value) < _LEAST_BANDS:
        raise InputError(
            f"{path}: expected spectra of {_LEAST_BANDS} bands or more; {name} has {len(spectrum.value)}"
        )
    return np.asarray(float(start) + float(increment) * np.arange(len(spectrum.value)), float)


def _colour(path: Path, name: str, values: Any, specifications: dict[str, Any]) -> Floats:
    """Return XYZ from L*a*b* or XYZ. Raises InputError if both are missing, or if they are for another light or
    observer."""
    lab = _first_colour(values, "ColorCielab")
    colour = lab if lab is not None else _first_colour(values, "ColorCiexyz")
    if colour is None:
        raise InputError(f"{path}: {name} has no ReflectanceSpectrum, ColorCIELab or ColorCIEXYZ")
    tristimulus = getattr(specifications.get(colour.color_specification), "tristimulus_spec", None)
    light = getattr(getattr(tristimulus, "illuminant_or_custom_illuminant", None), "value", None)
    observer = getattr(getattr(tristimulus, "observer", None), "value", None)
    conditions = [getattr(value, "value", None) for value in (light, observer)]
    if conditions != ["D50", "2_Degree"]:
        raise InputError(
            f"{path}: expected {name} under D50 for the observer 2_Degree; found {conditions[0]}, {conditions[1]}"
        )
    if lab is not None:
        return np.asarray(xyz_of(_numbers(path, name, [lab.l, lab.a, lab.b])[None])[0])
    return np.asarray(_numbers(path, name, [colour.x, colour.y, colour.z]) / 100.0)
