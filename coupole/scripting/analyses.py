"""Analyses called from Python: the work of the commands of the same names, which returns values."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from coupole.calibration.record import Record
from coupole.errors import InputError
from coupole.heritage.analysis.identification import PigmentFinding
from coupole.heritage.comparison.state_comparison import Comparison
from coupole.scan.registration.registering import Registration
from coupole.scripting.opened_result import Result

if TYPE_CHECKING:
    from coupole.appearance.spectra.spectra_library import LibrarySpectrum
    from coupole.calibration.lens.board import Board
    from coupole.calibration.lens.images import Found
    from coupole.calibration.sources import Sources
    from coupole.heritage.analysis.references import References

CalibrationRecord = Record
AnyPath = str | os.PathLike[str]
Progress = Callable[[str, int, int], None]
"""Function called with the name of a step, the number of its finished parts, and the number of all its parts."""
PRINTED_U_PPM = 5000.0
"""Standard uncertainty of a board's scale if only the nominal side of its squares is known."""


def fit_reflectance(
    runs: AnyPath | Sequence[AnyPath],
    out: AnyPath,
    *,
    mesh: AnyPath | None = None,
    calibrations: Sequence[AnyPath] = (),
    left_out: Sequence[int] = (),
    texels: bool | float = False,
    memory_bytes: int = 2_000_000_000,
    progress: Progress | None = None,
) -> Result:
    """Fit the materials of an object to proven frames of its runs, like `coupole reflectance RUN --out OUT`.

    `mesh` and `calibrations` (records, or folders of them) replace the mesh and records of the runs' plans.
    `left_out` are LEDs that are kept for the check (by default every twelfth). `texels` adds materials of single
    pixels, or of texels of a width in mm on the surface. A job that was stopped continues when it is called again.

    Raises InputError if there are no runs, or if the records do not belong to them; StorageError,
    ChecksumMismatch.
    """
    from coupole.calibration.record import records_named
    from coupole.reflectance.result_pages import run_reflectance_page
    from coupole.reflectance.run_job import RunRequest
    from coupole.reflectance.texels.texel_size import TexelSize
    from coupole.reflectance.whole_result import fit_runs
    from coupole.scripting.opened_result import open_result

    request = RunRequest(
        tuple(path_list(runs, "runs")),
        None if mesh is None else Path(mesh),
        records_named(path_list(calibrations)),
        tuple(map(int, left_out)),
        memory_bytes=memory_bytes,
    )
    size = None if texels is False else TexelSize(None if texels is True else float(texels))
    fit_runs(request, Path(out), None, progress or _silent, texels=size)
    run_reflectance_page.write(Path(out))
    result = open_result(out)
    assert isinstance(result, Result)
    return result


def calibrate_camera(
    images: AnyPath | Sequence[AnyPath],
    *,
    board: AnyPath | tuple[int, int] | None = None,
    square_mm: float | None = None,
    model: Literal["pinhole", "radial", "brown4", "brown5"] = "brown5",
    progress: Progress | None = None,
) -> CalibrationRecord:
    """Find lens and distortion from 8 to 60 pictures of a board, like `coupole calibrate camera`.

    `images` is a folder of pictures, or runs. `board` is a description (YAML; by default `board.yaml` of the
    folder), or, for a plain chessboard, its numbers of inner corners (columns and rows), together with the side of
    its squares, `square_mm`. The record has parameters with standard uncertainties, their covariance and remarks.
    Check `is_accepted` before you use it.

    Raises InputError if there is no board or too few pictures of it; CalibrationRefused.
    """
    from coupole.calibration.lens.workflow import camera_from
    from coupole.calibration.request import Request

    plain_board = plain_chessboard(board, square_mm) if isinstance(board, tuple) else None
    if plain_board is None and square_mm is not None:
        raise InputError("square_mm: only for a plain board of columns and rows")
    path = Path(board) if board is not None and not isinstance(board, tuple) else None
    sources, _, sightings = sight_board(
        path_list(images, "runs, or one folder of pictures"),
        path,
        None,
        plain_board,
        partial(progress or _silent, "looking for the board"),
    )
    now = datetime.now(UTC)
    return camera_from(sightings, sources, model, Request(f"camera-{now:%Y%m%d}", now))[1].record


def identify(
    spectra: AnyPath | Sequence[AnyPath],
    *,
    library: AnyPath,
    classes: AnyPath | None = None,
    unit: Literal["auto", "percent", "fraction"] = "auto",
    progress: Progress | None = None,
) -> tuple[PigmentFinding, ...]:
    """Find the class of pigments of each reflectance spectrum, like `coupole identify`.

    `spectra` are files of an instrument or tables, or folders of them; `library` has the spectra of known
    pigments, and `classes` names the class of each spectrum (by default the table that comes with Coupole). Raises
    InputError.
    """
    from coupole.appearance.spectra.spectra_library import read_library

    if unit not in ("auto", "percent", "fraction"):
        raise InputError(f"unit {unit!r}: expected auto, percent or fraction")
    measured_spectra = [
        spectrum for path in path_list(spectra, "spectra") for spectrum in read_library(path, unit=unit)
    ]
    return identify_spectra(
        measured_spectra,
        references_of(Path(library), None if classes is None else Path(classes)),
        progress or _silent,
    )


def register(
    scans: Sequence[AnyPath],
    *,
    unit: str = "mm",
    targets: AnyPath | None = None,
    control: AnyPath | None = None,
    seen_from: str | None = None,
    trust_poses: bool = False,
    progress: Progress | None = None,
) -> Registration:
    """Find the poses of two or more scans from their overlaps, like `coupole register`.

    `scans` are files: PLY, STL, OBJ, PTX, PTS, E57, or text with x y z. Their `unit` is mm, cm, m, um or in; E57
    is always in m. `targets` is a table of the targets in the scans, and `control` is a table of targets whose
    positions are known. `seen_from` tells where the scanner was in each scan's frame: origin, +x, -x, +y, -y, +z,
    -z or none; by default it is found. With `trust_poses` the search starts from the poses that PTX and E57
    state.

    Raises InputError if no two scans overlap; ExtraMissing.
    """
    from coupole.scan.registration import registering
    from coupole.scan.registration.control import TargetTables
    from coupole.scan.registration.viewpoint import STANDS

    stand = next((candidate for candidate in STANDS if candidate == seen_from), None)
    if seen_from is not None and stand is None:
        raise InputError(f"--seen-from {seen_from}: expected one of {', '.join(STANDS)}")
    return registering.register(
        path_list(scans),
        unit,
        stand=stand,
        tables=TargetTables(
            None if targets is None else Path(targets), None if control is None else Path(control)
        ),
        trust_poses=trust_poses,
        say=progress or _silent,
    )


def compare(
    before: AnyPath,
    after: AnyPath,
    *,
    unit: str = "mm",
    noise_mm: float | None = None,
    is_aligned: bool = False,
    progress: Progress | None = None,
) -> Comparison:
    """Find significant changes of shape and colour between two states of an object, like `coupole compare`.

    Both are meshes or clouds (PLY, STL, OBJ) in `unit`, or folders of a result of reflectance. `noise_mm` is the
    standard deviation of a point (by default it is estimated from the scatter); with `is_aligned` both states are
    already in one frame. Raises InputError, ExtraMissing.
    """
    from coupole.heritage.comparison import state_comparison
    from coupole.scan.scan import UNITS

    if unit not in UNITS:
        raise InputError(f"--unit {unit}: expected one of {', '.join(UNITS)}")
    if noise_mm is not None and not 0 < noise_mm < 1e3:
        raise InputError(f"--noise-mm {noise_mm:g}: expected a standard deviation above 0 mm")
    return state_comparison.compare(
        Path(before), Path(after), unit, noise_mm, is_aligned=is_aligned, say=progress or _silent
    )


# -- parts that the commands share ------------------------------------------------------------------------------


def references_of(library: Path, classes: Path | None) -> References:
    """Return the library's spectra with their classes. Raises InputError if a file is wrong, or if there is no
    table of classes."""
    from coupole.appearance.spectra.spectra_library import read_library
    from coupole.heritage.analysis.pigment_classes import read_classes, shipped_classes
    from coupole.heritage.analysis.references import make_references

    spectra = read_library(library)
    table = read_classes(classes) if classes is not None else shipped_classes(spectra)
    if not table:
        raise InputError(
            f"{library}: no table of classes comes with Coupole for this library; name one with --classes: "
            "lines of name and class"
        )
    return make_references(spectra, table)


def identify_spectra(
    spectra: Sequence[LibrarySpectrum], references: References, progress: Progress
) -> tuple[PigmentFinding, ...]:
    """Return a finding for each spectrum. Raises InputError, with file and line."""
    from coupole.heritage.analysis import identification
    from coupole.heritage.analysis.references import trimmed_spectrum

    findings = []
    for count, spectrum in enumerate(spectra):
        progress("identify", count, len(spectra))
        findings.append(identification.identify(trimmed_spectrum(spectrum), references))
    progress("identify", len(spectra), len(spectra))
    return tuple(findings)


def plain_chessboard(corners: tuple[int, int], square_mm: float | None) -> Board:
    """Return a chessboard with this number of inner corners, columns and rows. Raises InputError if there can be
    no such board."""
    from coupole.calibration.lens.board import Board

    columns, rows = corners
    if square_mm is None:
        raise InputError(f"--board {columns}x{rows}: expected the side of its squares too, --square MM")
    if not all(3 <= count <= 200 for count in corners):
        raise InputError(f"--board {columns}x{rows}: expected 3 to 200 inner corners each way")
    return Board(kind="chessboard", corners=corners, square_mm=square_mm, scale_u_ppm=PRINTED_U_PPM)


def sight_board(
    paths: list[Path],
    board: Path | None,
    poses: Path | None,
    plain_board: Board | None,
    progress: Callable[[int, int], None],
    warmth: tuple[float | None, float] = (None, 0.5),
) -> tuple[Sources, Board, Found]:
    """Open the images, and find the board in them: a plain board, or the board that a file or `board.yaml` beside
    the images describes.

    `warmth` is the board's temperature when it was photographed (C, None if not measured) and its standard
    uncertainty (K). The lengths of a board with a certificate are corrected for this temperature.
    """
    from coupole.calibration.artefact import temperature_of
    from coupole.calibration.lens.board import read_board
    from coupole.calibration.lens.images import find_board
    from coupole.calibration.sources import BOARD_NAME, open_sources

    usual_file = paths[0] / BOARD_NAME
    named_file = board or (usual_file if usual_file.is_file() else None)
    if plain_board is None and named_file is None:
        raise InputError(f"expected the board's description: give --board, or put it at {usual_file}")
    description = None if plain_board is not None else named_file
    target = plain_board if description is None else read_board(description)
    assert target is not None  # the case without a board was refused above
    sources = open_sources(paths, poses).with_file(description)
    if description is None:
        across, down = target.corners
        sources = sources.with_words(f"--board {across}x{down} --square {target.square_mm:g}")
    target, artefacts = target.measured_at(temperature_of(*warmth, sources.about.temperature_c))
    return replace(sources, artefacts=artefacts), target, find_board(target, sources, progress)


def _silent(step: str, count: int, total: int) -> None:
    """Report no progress."""


def path_list(paths: AnyPath | Sequence[AnyPath], what: str = "") -> list[Path]:
    """Return the paths as a list. Raises InputError if there is none, although `what` is expected."""
    if isinstance(paths, str | os.PathLike):
        return [Path(paths)]
    if what and not len(paths):
        raise InputError(f"expected {what}, found none")
    return [Path(path) for path in paths]
