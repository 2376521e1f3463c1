"""An image cube, for `coupole identify`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coupole.commands.identify_options import ImageOptions, ReportOptions
from coupole.commands.identify_report import origin_of
from coupole.errors import InputError, StorageError, reason

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rich.console import Console

    from coupole.appearance.spectra.envi_cube import Cube
    from coupole.heritage.analysis.references import References
    from coupole.heritage.pigment_maps.image_identification import ImageFinding

_AREA = re.compile(r"(\d+):(\d+),(\d+):(\d+)")
_STATE = ".identify"


def identify_cube(
    console: Console,
    path: Path,
    library: Path,
    classes: Path | None,
    references: References,
    options: ImageOptions,
    report: ReportOptions,
) -> dict[str, Any]:
    """Make the maps and the report of a cube, print them, and return the content of `--json`."""
    from coupole.appearance.spectra.envi_cube import CubeOptions, open_cube
    from coupole.heritage.pigment_maps.image_identification import identify_image
    from coupole.heritage.result_pages import image_page
    from coupole.heritage.result_pages.class_maps import map_document
    from coupole.storage.durable import make_folder
    from coupole.viewing.terminal import step_bars

    if report.report is None:
        raise InputError(f"{path}: an image needs --report with a folder, in which its maps are written")
    if options.scale is not None and not options.scale > 0:
        raise InputError(f"--scale {options.scale:g}: expected a number above 0, such as 10000")
    cube = open_cube(path, CubeOptions(options.scale, options.wavelength_unit))
    mask = _mask_of(cube, options)
    try:
        make_folder(report.report)
    except OSError as error:
        raise StorageError(f"{report.report}: {reason(error)}") from error
    with step_bars(console) as say:
        finding = identify_image(
            cube, references, report.report / _STATE, say, mask=mask, most_regions=options.regions
        )
        say("write", 0, 1)
        origin = origin_of(report, [cube.header, cube.data], library, classes, references, cube.fields)
        page = image_page.write(report.report, finding, cube, origin)
        say("write", 1, 1)
    if cube.left_out:
        console.print(f"{len(cube.left_out)} bands are left out, as the header's bbl says", markup=False)
    _show(console, finding, page)
    return {"page": str(page.resolve()), **map_document(finding, cube)}


def _mask_of(cube: Cube, options: ImageOptions) -> NDArray[Any] | None:
    """[rows, columns] True for pixels that are identified; None if all pixels are. Raises InputError."""
    import numpy as np

    looks = np.ones((cube.rows, cube.columns), bool)
    if options.mask is not None:
        looks &= _read_mask(options.mask, cube)
    if options.area is not None:
        match = _AREA.fullmatch(options.area.replace(" ", ""))
        ends = [int(number) for number in match.groups()] if match else [0, 0, 0, 0]
        first_row, end_row, first_column, end_column = ends
        if not (first_row < end_row <= cube.rows and first_column < end_column <= cube.columns):
            raise InputError(
                f"--area {options.area}: expected rows and columns FIRST:END,FIRST:END within 0:{cube.rows},"
                f"0:{cube.columns}"
            )
        inside = np.zeros_like(looks)
        inside[first_row:end_row, first_column:end_column] = True
        looks &= inside
    return looks


def _read_mask(path: Path, cube: Cube) -> NDArray[Any]:
    import numpy as np
    from PIL import Image

    from coupole.intake.regular_file import open_regular

    try:
        with open_regular(path) as file, Image.open(file) as picture:
            mask = np.asarray(picture.convert("L")) > 0
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected a picture: {reason(error)}") from error
    if mask.shape != (cube.rows, cube.columns):
        raise InputError(
            f"{path}: expected a picture of {cube.columns} x {cube.rows} pixels, as the cube has; found "
            f"{mask.shape[1]} x {mask.shape[0]}"
        )
    return mask


def _show(console: Console, finding: ImageFinding, page: Path) -> None:
    from rich.table import Table

    total = max(finding.looked_at, 1)
    table = Table("class", "pixels", "share", box=None)
    order = [*range(4, len(finding.names)), 3, 2, 1]
    for code in order:
        if pixels := finding.pixels_of(code):
            table.add_row(finding.names[code], f"{pixels:,}", f"{pixels / total:.1%}")
    console.print(table)
    console.print(f"{len(finding.regions)} regions; page: {page}", markup=False)
