"""Colour profiles made from Python: the work of `coupole calibrate colour` on plain pictures."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.calibration.record import Record
from coupole.errors import InputError
from coupole.scripting.analyses import AnyPath, path_list

if TYPE_CHECKING:
    from coupole.calibration.light.records import Progress
    from coupole.calibration.report import Outcome
    from coupole.calibration.request import Request


def calibrate_colour(
    pictures: AnyPath | Sequence[AnyPath],
    *,
    chart: AnyPath,
    white: AnyPath | None = None,
    corners_px: ArrayLike | None = None,
    without: Sequence[str] = (),
    srgb: bool = False,
    out: AnyPath | None = None,
) -> Record:
    """Find the colour profile of a camera from pictures of a chart, like `coupole calibrate colour PICTURE...`.

    `pictures` are files with linear values (RAW, TIFF, PNG, OpenEXR), or one folder of them. `chart` is a
    description (YAML), or a file of values (CxF, CGATS, CSV) for patches A1, A2, ..., B1, and so on. `white` is a
    picture of a white card in the chart's place. `corners_px` [4, 2] are the centres of the corner patches, column
    and row, one after the other round the chart; by default the chart is searched for. Patches `without` are left
    out. With `srgb`, the pictures have sRGB's transfer curve and no other. The record, its ICC profile, its table
    and its page are written to the folder `out`, which must not contain such files yet.

    Check `is_accepted` of the record before you use it. `record.value("xyz_d50_from_balanced.Xr")` and so on are
    the matrix. Raises InputError if the chart is not found, or if values are not linear; StorageError if a file
    cannot be written.
    """
    from coupole.calibration.report import write_outcome
    from coupole.calibration.request import Request

    now = datetime.now(UTC)
    request = Request(f"colour-{now:%Y%m%d}", now, valid_days=365)
    path = None if out is None else Path(out) / f"{request.name}.yaml"
    if path is not None and path.exists():
        raise InputError(f"{path}: exists already. Choose another folder.")
    inputs = ChartInputs(
        path_list(pictures, "pictures"),
        Path(chart),
        None if white is None else Path(white),
        None if corners_px is None else _corners(corners_px),
        tuple(without),
        srgb,
    )
    outcome = profile_of(inputs, request, Silence())
    if path is not None:
        write_outcome(path, outcome)
    return outcome.record


def _corners(corners_px: ArrayLike) -> NDArray[np.float64]:
    found = np.asarray(corners_px, float)
    if found.shape != (4, 2) or not np.isfinite(found).all():
        raise InputError(f"corners_px: expected [4, 2] pixels, found {np.asarray(corners_px).tolist()}")
    return found


# -- parts that the command shares --------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChartInputs:
    """Pictures of a chart, and the facts that are known about them."""

    pictures: Sequence[Path]
    """Files, or one folder."""
    chart: Path
    white: Path | None
    corners_px: NDArray[np.float64] | None
    """[4, 2] px; None: the chart is searched for."""
    without: Sequence[str]
    srgb: bool


class Told(Protocol):
    """Receiver of the progress of the work."""

    def status(self, words: str) -> AbstractContextManager[object]:
        """Report work whose end is not known."""

    def bar(self, words: str) -> AbstractContextManager[Progress]:
        """Report work whose parts are counted."""


class Silence:
    """Tells nobody."""

    def status(self, words: str) -> AbstractContextManager[object]:
        return nullcontext()

    def bar(self, words: str) -> AbstractContextManager[Progress]:
        return nullcontext(lambda count, total: None)


def profile_of(inputs: ChartInputs, request: Request, told: Told) -> Outcome:
    """Read the pictures, find the chart in them, and return the profile. Raises InputError."""
    from coupole.calibration.colour.chart import chart_of_values, is_values_file, read_chart
    from coupole.calibration.colour.colour_workflow import Origin, colour_outcome
    from coupole.calibration.colour.picture_workflow import see_in_pictures
    from coupole.calibration.light.frames import PlainSources
    from coupole.calibration.light.records import record_input
    from coupole.calibration.sources import About
    from coupole.exchange.chart_photographs import pictures_at, read_chart_photograph

    read_known = chart_of_values if is_values_file(inputs.chart) else read_chart
    whole_chart = read_known(inputs.chart, list(inputs.without))
    files = pictures_at(inputs.pictures, inputs.white)
    with told.status("reading pictures"):
        pictures = [read_chart_photograph(path, srgb=inputs.srgb) for path in files]
        white = None if inputs.white is None else read_chart_photograph(inputs.white, srgb=inputs.srgb)
    with told.bar("looking for the chart") as progress:
        in_pictures = see_in_pictures(pictures, whole_chart, inputs.corners_px, white, progress)
    source_files = tuple(pair for path in (*files, inputs.white) for pair in record_input(path))
    chart_files = tuple(pair for path in whole_chart.files for pair in record_input(path))
    origin = Origin(PlainSources(About(is_simulated=False), source_files), pictures[0].size_px, chart_files)
    with told.bar("patches left out") as progress:
        return colour_outcome(in_pictures.sighting, in_pictures.known_chart, origin, request, progress)
