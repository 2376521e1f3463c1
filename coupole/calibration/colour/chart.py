"""A colour chart: its description (YAML), its patches' colours, and where its parts are in a picture.

The chart's frame has its origin in the middle of the patches. x is along the rows to the right, y up, and z out of
the face; mm.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from coupole.calibration.artefact import Described, read_described
from coupole.calibration.colour import cxf_values
from coupole.calibration.colour.chart_values import ChartValues, Unit, read_chart_values
from coupole.calibration.colour.colorimetry import lab_of
from coupole.calibration.rotations import Floats
from coupole.errors import InputError
from coupole.plan import yamlfile
from coupole.plan.base_model import FilePath, Model, Pose

_Length = Annotated[float, Field(gt=0)]
_NEUTRAL_CHROMA = 5.0
"""Largest chroma C* of patches that count as grey."""
_LEAST_PATCHES = 8
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_PLACE = re.compile(r"([A-Z])([1-9][0-9]?)")
_VALUES_ENDINGS = (".txt", ".csv", ".cgats", ".it8", ".tsv")
_USED_OF_UNKNOWN = 0.5
"""Share of the pitch that is read if the size of the chart's patches is not known."""
_LEAST_GREY_LIGHTNESS = 20.0
"""Least L* of the greys that balance the channels. In darker greys, noise and stray light dominate."""


class Edge(Model):
    """A rectangle of the chart with one straight, slanted edge between light and dark across it."""

    name: str
    centre_mm: tuple[float, float]
    size_mm: tuple[_Length, _Length]


class Chart(Described):
    """A flat chart of patches in rows and columns."""

    schema_version: Literal[1] = 1
    name: str
    rows: Annotated[int, Field(ge=1, le=100)]
    columns: Annotated[int, Field(ge=1, le=100)]
    pitch_mm: tuple[_Length, _Length]
    """Distance from the middle of a patch to the middle of the next patch, along rows and along columns."""
    patch_mm: tuple[_Length, _Length]
    """Width and height of a patch."""
    used: Annotated[float, Field(gt=0, le=0.95)] = 0.7
    """Share of a patch's width and height that is read, around its middle."""
    names: tuple[tuple[str, ...], ...] | None = None
    """Names of the patches in the file of values, row by row from the top. Without it they are A1, A2, ..., B1,
    ..."""
    values: FilePath
    """Spectra, L*a*b* or XYZ of the patches (CGATS, CSV or CxF), beside this file."""
    cxf_type: str | None = None
    """ObjectType of the objects of a CxF file that are used, if a patch is measured more than once."""
    unit: Unit = "auto"
    """Unit of spectra: percent or fraction. `auto` decides by the size of the values."""
    u_lab: Annotated[float, Field(ge=0)] = 0.3
    """Standard uncertainty of each of L*, a*, b* of a patch, from the instrument and the patch's own
    unevenness."""
    neutral: tuple[str, ...] | None = None
    """Names of the grey patches. Without it these are the patches with a chroma below 5."""
    support_from_chart: Pose | None = None
    """Pose of the chart on the support. Without it, give the chart's corners in the picture (`--corners`)."""
    without: tuple[str, ...] = ()
    """Names of patches that are not used."""
    edges: tuple[Edge, ...] = ()

    @model_validator(mode="after")
    def _possible(self) -> Chart:
        if any(patch > pitch for patch, pitch in zip(self.patch_mm, self.pitch_mm, strict=True)):
            raise ValueError(f"patches of {self.patch_mm} mm overlap at a pitch of {self.pitch_mm} mm")
        if self.names is not None and [len(row) for row in self.names] != [self.columns] * self.rows:
            raise ValueError(f"`names`: expected {self.rows} rows of {self.columns} names")
        if self.names is None and self.rows > 26:
            raise ValueError("`names` are needed for more than 26 rows")
        if len(set(self._all_names)) != len(self._all_names):
            raise ValueError("`names`: a name is given twice")
        return self

    @property
    def patch_names(self) -> tuple[str, ...]:
        """Names of the patches that are used, row by row from the top."""
        return tuple(name for name in self._all_names if name not in self.without)

    @property
    def _all_names(self) -> tuple[str, ...]:
        if self.names is not None:
            return tuple(name for row in self.names for name in row)
        return tuple(f"{chr(65 + row)}{column + 1}" for row in range(self.rows) for column in range(self.columns))

    @property
    def centres_mm(self) -> Floats:
        """[patches, 2], in the order of `patch_names`."""
        in_use = np.array([name not in self.without for name in self._all_names])
        return np.asarray(self._all_centres_mm()[in_use])

    def _all_centres_mm(self) -> Floats:
        x = (np.arange(self.columns) - (self.columns - 1) / 2.0) * self.pitch_mm[0]
        y = ((self.rows - 1) / 2.0 - np.arange(self.rows)) * self.pitch_mm[1]
        return np.asarray(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))

    @property
    def corners_mm(self) -> Floats:
        """[4, 2] middles of the corner patches, in the order top left, top right, bottom right, bottom left."""
        count, last = self.rows * self.columns, self.columns - 1
        return self._all_centres_mm()[[0, last, count - 1, count - 1 - last]]

    def patch_polygons_mm(self) -> Floats:
        """[patches, 4, 2] the parts of the patches that are read."""
        half = 0.5 * self.used * np.array(self.patch_mm)
        return np.asarray(self.centres_mm[:, None] + half * _AROUND)

    def edge_polygons_mm(self) -> Floats:
        """[edges, 4, 2]."""
        centres = np.array([edge.centre_mm for edge in self.edges]).reshape(-1, 1, 2)
        return np.asarray(
            centres + 0.5 * np.array([edge.size_mm for edge in self.edges]).reshape(-1, 1, 2) * _AROUND
        )


_AROUND = np.array([(-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])


@dataclass(frozen=True)
class KnownChart:
    """A chart with the colours of its patches."""

    chart: Chart
    xyz: Floats
    """[patches, 3] under D50, Y = 1 for the perfect white."""
    files: tuple[Path, ...]
    """Files of its description and its values."""

    @property
    def lab(self) -> Floats:
        return lab_of(self.xyz)

    def without(self, names: Sequence[str]) -> KnownChart:
        """Return the same chart without some patches. Raises InputError if too few patches are left, or no grey
        one."""
        chart = self.chart.model_copy(update={"without": (*self.chart.without, *names)})
        kept_patches = np.array([name not in names for name in self.chart.patch_names])
        known_chart = KnownChart(chart, self.xyz[kept_patches], self.files)
        if len(known_chart.xyz) < _LEAST_PATCHES:
            raise InputError(
                f"colour: {len(known_chart.xyz)} patches are left without {', '.join(names)}; expected "
                f"{_LEAST_PATCHES} or more. Expose less, or light the chart more evenly"
            )
        if not known_chart.neutral:
            raise InputError(f"colour: no grey patch is left without {', '.join(names)}; expose anew")
        return known_chart

    @property
    def neutral(self) -> tuple[int, ...]:
        """Numbers of the grey patches that are bright enough to balance the channels."""
        lab = self.lab
        if self.chart.neutral is not None:
            names = self.chart.patch_names
            return tuple(names.index(name) for name in self.chart.neutral if name in names)
        grey = np.hypot(lab[:, 1], lab[:, 2]) < _NEUTRAL_CHROMA
        return tuple(map(int, np.flatnonzero(grey & (lab[:, 0] > _LEAST_GREY_LIGHTNESS))))


def read_chart(path: Path, without: Sequence[str] = ()) -> KnownChart:
    """Read a chart's description and values, and leave out the patches `without` too. Raises InputError with all
    problems: wrong keys, patches without values, too few patches, no grey patch."""
    document = yamlfile.read_document(path)
    whole = read_described(path, Chart)
    if strange := sorted({*whole.without, *without} - set(whole.model_copy(update={"without": ()}).patch_names)):
        raise InputError(f"{path}: the chart has no patch {', '.join(strange)} to leave out")
    chart = whole.model_copy(update={"without": (*whole.without, *without)})
    names = chart.patch_names
    if len(names) < _LEAST_PATCHES:
        raise InputError(f"{path}: expected {_LEAST_PATCHES} patches or more, found {len(names)}")
    if unknown := sorted(set(chart.neutral or ()) - {*names, *chart.without}):
        raise InputError([document.problem(("neutral",), f"the chart has no patch {', '.join(unknown)}")])
    values_path = document.resolve(chart.values)
    values = _values(values_path, chart.unit, chart.cxf_type)
    if missing := [name for name in names if name not in values.xyz]:
        absent = ", ".join(missing[:8]) + (f" and {len(missing) - 8} more" if len(missing) > 8 else "")
        has = ", ".join(list(values.xyz)[:6])
        raise InputError(f"{values_path}: has no values of {absent} (it has {has}, ...); set `names` in {path}")
    known_chart = KnownChart(chart, np.stack([values.xyz[name] for name in names]), (path, values_path))
    if not known_chart.neutral:
        raise InputError(f"{path}: expected a grey patch of L* above {_LEAST_GREY_LIGHTNESS:g}; found none")
    return known_chart


def is_values_file(path: Path) -> bool:
    """True for a file of values without a description, by its name."""
    return path.suffix.lower() in (*cxf_values.ENDINGS, *_VALUES_ENDINGS)


def chart_of_values(path: Path, without: Sequence[str] = ()) -> KnownChart:
    """Return a chart that is given only by its values. They are a full table of patches A1, A2, ..., B1, ..., with
    a letter for each row. The pitch is equal along rows and columns, and the middle half of each patch is read.

    Raises InputError for other names and for a missing patch, and like `read_chart`.
    """
    values = _values(path, "auto", None)
    places = {name: _PLACE.fullmatch(name) for name in values.xyz}
    strange = [name for name, place in places.items() if place is None]
    rows = sorted({place[1] for place in places.values() if place is not None})
    columns = max((int(place[2]) for place in places.values() if place is not None), default=0)
    wanted_names = [f"{row}{column + 1}" for row in rows for column in range(columns)]
    if strange or wanted_names != sorted(values.xyz, key=_by_place) or rows != list(_LETTERS[: len(rows)]):
        raise InputError(
            f"{path}: expected patches A1, A2, ..., B1, ... of all rows and columns, found "
            f"{', '.join(list(values.xyz)[:8])}; describe the chart in YAML with `rows`, `columns`, `names` and "
            "this file as `values`"
        )
    if unknown := sorted(set(without) - set(wanted_names)):
        raise InputError(f"{path}: the chart has no patch {', '.join(unknown)} to leave out")
    chart = Chart(
        name=path.stem,
        rows=len(rows),
        columns=columns,
        pitch_mm=(1.0, 1.0),
        patch_mm=(0.8, 0.8),
        used=_USED_OF_UNKNOWN / 0.8,
        values=Path(path.name),
    )
    known_chart = KnownChart(chart, np.stack([values.xyz[name] for name in wanted_names]), (path,))
    return known_chart.without(list(without))


def _by_place(name: str) -> tuple[str, int]:
    place = _PLACE.fullmatch(name)
    return (name, 0) if place is None else (place[1], int(place[2]))


def _values(path: Path, unit: Unit, cxf_type: str | None) -> ChartValues:
    if path.suffix.lower() in cxf_values.ENDINGS:
        return cxf_values.read_cxf_values(path, unit, cxf_type)
    return read_chart_values(path, unit)
