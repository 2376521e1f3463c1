"""`coupole calibrate dark`, `response`, `flat-field`, `glare`, `led-power` and `drift`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.calibration.light.acceptance import DARK, DRIFT, GLARE, LED_POWER, RESPONSE
from coupole.commands.calibrating import EmissionOption, Work, arm_of, bar, calibration, emission_of, rig_of

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.calibration.artefact import LightSpectrum
    from coupole.calibration.light.frames import LightFrames
    from coupole.calibration.light.led_power_tile import Setting
    from coupole.calibration.light.lit_cell import LitCell
    from coupole.calibration.optics import Intrinsics
    from coupole.calibration.report import Outcome
    from coupole.calibration.request import Request
    from coupole.plan.cell import Cell

Runs = Annotated[list[Path], typer.Argument(help="Runs.", show_default=False, metavar="RUN...")]
DarkOption = Annotated[
    Path | None,
    typer.Option("--dark", help="A record of `calibrate dark`; the runs' own dark frames if not given."),
]
ResponseOption = Annotated[Path | None, typer.Option("--response", help="A record of `calibrate response`.")]
FlatOption = Annotated[Path | None, typer.Option("--flat", help="A record of `calibrate flat-field`.")]
GlareOption = Annotated[
    Path | None, typer.Option("--glare", help="A record of `calibrate glare`: the veiling glare is subtracted.")
]
CameraOption = Annotated[
    Path | None, typer.Option("--camera", help="A camera's record; the rig's lens if not given.")
]
TileOption = Annotated[Path, typer.Option("--tile", help="The tile's description (YAML).", show_default=False)]
RigOption = Annotated[
    Path | None, typer.Option("--rig", help="The rig, for its LEDs and support; the first run's if not given.")
]
HandEyeOption = Annotated[
    Path | None, typer.Option("--hand-eye", help="A record of `calibrate hand-eye`; the rig's if not given.")
]
LedsOption = Annotated[
    Path | None, typer.Option("--leds", help="A record of `calibrate leds`; the rig's table if not given.")
]


@dataclass(frozen=True)
class TargetCalibrations:
    """Rig, records and emission that are used to read frames of a target of known pose."""

    rig: RigOption = None
    leds: LedsOption = None
    hand_eye: HandEyeOption = None
    camera: CameraOption = None
    dark_record: DarkOption = None
    response_record: ResponseOption = None
    flat: FlatOption = None
    glare: GlareOption = None
    emission: EmissionOption = "lambertian"


@calibration("dark", limits=DARK, valid_days=90)
def dark(
    runs: Runs,
) -> Work:
    """Offset, dark current and hot pixels from dark frames of two or more exposures."""
    from coupole.calibration.light.frames import open_light_frames
    from coupole.calibration.light.records import dark_outcome

    def work(console: Console, request: Request) -> Outcome:
        with bar(console, "dark frames") as progress:
            return dark_outcome(open_light_frames(runs), request, progress)

    return work


@calibration("response", limits=RESPONSE, valid_days=365)
def response(
    runs: Runs,
    dark_record: DarkOption = None,
) -> Work:
    """Gain, read noise, full well and linearity from a bracket of a constant scene, each frame twice."""
    from coupole.calibration.light.frames import open_light_frames
    from coupole.calibration.light.records import response_outcome

    def work(console: Console, request: Request) -> Outcome:
        with bar(console, "exposures") as progress:
            return response_outcome(open_light_frames(runs), request, dark_record, progress)

    return work


@calibration("flat-field")
def flat_field(
    runs: Runs,
    panel_mm: Annotated[
        float, typer.Option("--panel-mm", min=50.0, help="Distance from the camera to the panel.")
    ] = 600.0,
    dark_record: DarkOption = None,
    response_record: ResponseOption = None,
    hand_eye: HandEyeOption = None,
    rig: RigOption = None,
) -> Work:
    """Find the lens's fall-off, per channel, from views of a luminous panel that is shifted and turned."""
    from coupole.calibration.light.flat_field_records import flat_field_outcome
    from coupole.calibration.light.frames import open_light_frames

    def work(console: Console, request: Request) -> Outcome:
        frames = frames_with_poses(open_light_frames(runs), hand_eye, rig, runs)
        with bar(console, "views of the panel") as progress:
            return flat_field_outcome(
                frames, request, dark_record, response_record, panel_mm, progress, hand_eye=hand_eye
            )

    return work


@calibration("glare", limits=GLARE)
def glare(
    runs: Runs,
    target: Annotated[
        Path | None,
        typer.Option("--target", help="Description of the target (YAML): its name, and the light of its traps."),
    ] = None,
    dark_record: DarkOption = None,
    response_record: ResponseOption = None,
) -> Work:
    """Find the veiling glare of lens and camera, per channel, from views of black traps in a white card.

    With this record, extraction subtracts the glare; each sample's uncertainty then includes the glare's
    uncertainty.
    """
    from coupole.calibration.light.frames import open_light_frames
    from coupole.calibration.light.glare_records import glare_outcome

    def work(console: Console, request: Request) -> Outcome:
        frames = open_light_frames(runs)
        with bar(console, "views of the traps") as progress:
            return glare_outcome(frames, request, target, dark_record, response_record, progress)

    return work


@calibration("led-power", limits=LED_POWER, valid_days=90)
def led_power(
    runs: Runs,
    tile: TileOption,
    known: TargetCalibrations,
) -> Work:
    """Power of each LED from views of a white tile of known pose."""
    from coupole.calibration.light.frames import open_light_frames
    from coupole.calibration.light.led_power_records import led_power_outcome

    def work(console: Console, request: Request) -> Outcome:
        frames = frames_with_poses(open_light_frames(runs), known.hand_eye, known.rig, runs)
        setting = setting_of(frames, tile, known.rig or rig_of(runs[0]), known)
        with bar(console, "frames of the tile") as progress:
            return led_power_outcome(frames, setting, request, progress)

    return work


@calibration("drift", limits=DRIFT, valid_days=3650)
def drift(
    runs: Runs,
    led_power_record: Annotated[
        Path, typer.Option("--led-power", help="A record of `calibrate led-power`.", show_default=False)
    ],
    tile: TileOption,
    known: TargetCalibrations,
) -> Work:
    """Find how LED power has drifted from its calibration to a run, by temperature and age, from views of a tile.

    Give the same records and the same tile as for `led-power`.
    """
    from coupole.calibration.light.drift_records import drift_outcome
    from coupole.calibration.light.frames import open_light_frames

    def work(console: Console, request: Request) -> Outcome:
        frames = frames_with_poses(open_light_frames(runs), known.hand_eye, known.rig, runs)
        setting = setting_of(frames, tile, known.rig or rig_of(runs[0]), known)
        with bar(console, "frames with the tile") as progress:
            return drift_outcome(frames, setting, led_power_record, request, progress)

    return work


# -- helpers --------------------------------------------------------------------------------------------------


def frames_with_poses(
    frames: LightFrames, hand_eye: Path | None, rig: Path | None, runs: list[Path]
) -> LightFrames:
    """Return frames with the poses of a hand-eye record, which may include zeros of the axes. Raises InputError if
    the record is of another kind or focus, or if the rig has no model of the record's arm."""
    from coupole.calibration.posed_camera import read_posed_camera
    from coupole.plan.cell import read_cell

    if hand_eye is None:
        return frames
    prior = read_posed_camera(hand_eye, None, frames.about, frames.size_px)
    return frames.seen_through(prior.flange_from_camera, arm_of(read_cell(rig or rig_of(runs[0])), hand_eye))


def setting_of(frames: LightFrames, tile: Path, rig: Path, calibrations: TargetCalibrations) -> Setting:
    """Return the descriptions and calibrations that are used to read frames of a tile. Raises InputError for
    invalid files."""
    from coupole.calibration.light.led_power_tile import Setting
    from coupole.calibration.light.spectralon import read_tile
    from coupole.plan.cell import read_cell

    cell = read_cell(rig)
    spectrum = None if cell.rig.dome.spectrum is None else cell.document.resolve(cell.rig.dome.spectrum)
    lit_cell = lit_cell_of(frames, cell, calibrations, (tile, rig), spectrum)
    return Setting(**vars(lit_cell), tile=read_tile(tile), light=light_of(cell))


def lit_cell_of(
    frames: LightFrames,
    cell: Cell,
    calibrations: TargetCalibrations,
    artefact_files: tuple[Path, ...],
    spectrum: Path | None = None,
) -> LitCell:
    """Return a cell with the calibrations with which its frames are read. `artefact_files` describe what is seen
    in them. Raises InputError for invalid files."""
    from coupole.calibration.light.led_power_tile import calibrated_positions
    from coupole.calibration.light.lit_cell import LitCell
    from coupole.calibration.light.tile_views import Positions

    by_table = Positions(cell.leds.ids, cell.leds.positions_mm, cell.leds.normals)
    files = (
        *artefact_files,
        calibrations.leds or cell.leds_path,
        spectrum,
        calibrations.hand_eye,
        calibrations.camera,
    )
    return LitCell(
        base_from_support=cell.rig.support.base_from_support.matrix(),
        positions=by_table if calibrations.leds is None else calibrated_positions(calibrations.leds),
        lens=lens_of(calibrations.camera, frames),
        dark=calibrations.dark_record,
        response=calibrations.response_record,
        flat=calibrations.flat,
        glare=calibrations.glare,
        emission=emission_of(calibrations.emission),
        files=tuple(path for path in files if path is not None),
    )


def light_of(cell: Cell) -> LightSpectrum | None:
    """The LEDs' spectrum that a rig names (`dome.spectrum`); None if it names none. Raises InputError."""
    from coupole.appearance.spectra.measured import read_spectrum
    from coupole.calibration.artefact import LightSpectrum

    if cell.rig.dome.spectrum is None:
        return None
    path = cell.document.resolve(cell.rig.dome.spectrum)
    spectrum = read_spectrum(path, unit="power")
    return LightSpectrum(spectrum.wavelengths_nm, spectrum.values, path.name)


def lens_of(record_path: Path | None, frames: LightFrames) -> Intrinsics:
    """Return the lens of a camera record; without a record, the nominal lens of the rig. Raises InputError if the
    record is of another camera."""
    from coupole.calibration.earlier import read_earlier
    from coupole.calibration.optics import Intrinsics
    from coupole.calibration.record import intrinsics_of

    if record_path is None:
        width_px, height_px = frames.size_px
        return Intrinsics(frames.focal_px, frames.focal_px, (width_px - 1) / 2.0, (height_px - 1) / 2.0)
    return intrinsics_of(read_earlier(record_path, "camera", frames.about, frames.size_px))[0]
