"""`coupole calibrate check-artefact`: a calibrated cell measures an artefact that was used in no fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.calibration.check.acceptance import CHECK
from coupole.commands.calibrate_lens import Warmth, look_for_board
from coupole.commands.calibrate_light import TargetCalibrations, frames_with_poses, setting_of
from coupole.commands.calibrating import (
    EmissionOption,
    Paths,
    Work,
    arm_of,
    bar,
    calibration,
    emission_of,
    rig_of,
)
from coupole.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from coupole.calibration.check.board_lengths import Position
    from coupole.calibration.check.tile_reflectance import Place
    from coupole.calibration.in_force import InForce
    from coupole.calibration.lens.board import Board
    from coupole.calibration.light.frames import LightFrames
    from coupole.calibration.record import Kind
    from coupole.calibration.report import Outcome
    from coupole.calibration.request import Request
    from coupole.calibration.sources import Sources

OF_TILE: tuple[Kind, ...] = ("led-power", "leds", "hand-eye", "camera", "dark", "response", "flat-field", "glare")
OF_BOARD: tuple[Kind, ...] = ("hand-eye",)


@dataclass(frozen=True)
class IndependentArtefact:
    """Options of the independent artefact, and of the records that are used to measure it."""

    board: Annotated[
        Path | None, typer.Option("--board", help="A second board's description (YAML), with its certificate.")
    ] = None
    tile: Annotated[
        list[Path] | None,
        typer.Option(
            "--tile",
            help="A second tile's description (YAML), with its certificate; one for all runs, or one for each.",
            show_default=False,
        ),
    ] = None
    records: Annotated[
        list[Path] | None,
        typer.Option("--records", help="Records in force, or folders of them.", show_default=False),
    ] = None
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="The rig, for arm, LEDs and support; the first run's if not given."),
    ] = None
    poses: Annotated[
        Path | None,
        typer.Option("--poses", help="Robot poses of pictures (YAML); FOLDER/poses.yaml if not given."),
    ] = None
    mpe: Annotated[
        str | None,
        typer.Option(
            "--mpe-um", help="Largest permissible error of a length: A+L/K, A in um, L in mm; such as 50+L/20."
        ),
    ] = None


@calibration("artefact-check", limits=CHECK, valid_days=365, lens=False)
def check_artefact(
    paths: Paths,
    independent: IndependentArtefact,
    *,
    warmth: Warmth,
    emission: EmissionOption = "lambertian",
) -> Work:
    """Measure a second board or tile, which took part in no fit, and compare it with its certificate by E_n.

    Each run, or folder of pictures with poses, is one position of the artefact.
    """

    def work(console: Console, request: Request) -> Outcome:
        _refuse_wrong(paths, independent, emission)
        from coupole.calibration.check.workflow import records_in_force
        from coupole.calibration.record import records_named

        records = records_in_force(records_named(independent.records or []))
        if independent.board is not None:
            return _check_board(paths, independent, warmth, records, request, console)
        return _check_tile(paths, independent, emission, records, request, console)

    return work


def _refuse_wrong(paths: Sequence[Path], independent: IndependentArtefact, emission: str) -> None:
    """Raise InputError for options that do not go together and for missing files.

    This is done first, because reading takes long and some imports take seconds.
    """
    from coupole.calibration.check.permissible import parse_permissible

    tiles = independent.tile or []
    if (independent.board is None) != bool(tiles):
        raise InputError("check-artefact: give one of --board and --tile, the artefact's description")
    if tiles and (independent.mpe is not None or independent.poses is not None):
        raise InputError(f"--{'mpe-um' if independent.mpe is not None else 'poses'}: is for --board only")
    if independent.mpe is not None:
        parse_permissible(independent.mpe)
    emission_of(emission)
    if len(tiles) not in (0, 1, len(paths)):
        raise InputError(
            f"--tile: expected one description, or one for each of {len(paths)} runs; got {len(tiles)}"
        )
    for path in paths:
        if not path.is_dir():
            raise InputError(f"{path}: no such folder; expected a run, or a folder of pictures")
    file_of_option = {"--board": independent.board, "--rig": independent.rig, "--poses": independent.poses}
    options = [*file_of_option.items(), *(("--tile", tile) for tile in tiles)]
    for option, file in (*options, *(("--records", record) for record in independent.records or [])):
        if file is not None and not file.exists():
            raise InputError(f"{option}: {file}: no such file")
    if not independent.records:
        kind = "hand-eye" if independent.board is not None else "led-power"
        raise InputError(f"--records: expected a record of the kind `{kind}`; none is named")


# -- a board ----------------------------------------------------------------------------------------------------


def _check_board(
    paths: list[Path],
    independent: IndependentArtefact,
    warmth: Warmth,
    records: Sequence[InForce],
    request: Request,
    console: Console,
) -> Outcome:
    from coupole.calibration.check.board_lengths import Noise, lengths_of
    from coupole.calibration.check.permissible import parse_permissible
    from coupole.calibration.check.workflow import (
        Pictures,
        check_outcome,
        compare_lengths,
        needed_record,
        records_by_kind,
        refuse_dependent,
        refuse_used_images,
    )
    from coupole.calibration.lens.board import read_board

    assert independent.board is not None  # `check_artefact` has refused the other case
    permissible = None if independent.mpe is None else parse_permissible(independent.mpe)
    record_of_kind = records_by_kind(records, OF_BOARD)
    needed_record(record_of_kind, "hand-eye")
    refuse_dependent(read_board(independent.board).artefact, independent.board, records)
    lengths, inputs, sources, target = [], [], None, None
    for path in paths:
        position, sources, target = _position(path, independent, warmth, record_of_kind["hand-eye"], console)
        refuse_used_images(records, sources.inputs)
        inputs += list(sources.inputs)
        lengths.append(lengths_of(position, target, Noise.of(record_of_kind["hand-eye"].record)))
    assert sources is not None  # `paths` has at least one
    assert target is not None
    check = compare_lengths(lengths, position.camera.covariance, 1e-6 * target.scale_u_ppm, permissible)
    hand_eye = record_of_kind["hand-eye"]
    size_px = hand_eye.record.validity.size_px
    if size_px is None:
        raise InputError(f"{hand_eye.path}: expected `validity.size_px`, the size of its images; found none")
    pictures = Pictures(sources.about, size_px, tuple(dict.fromkeys(inputs)))
    return check_outcome(check, sources.artefacts[0], pictures, record_of_kind, request)


def _position(
    path: Path, independent: IndependentArtefact, warmth: Warmth, hand_eye: InForce, console: Console
) -> tuple[Position, Sources, Board]:
    """Return sightings and poses of one run or folder, by the hand-eye record."""
    import numpy as np

    from coupole.calibration.calibrated_arm import calibrated_poses
    from coupole.calibration.check.board_lengths import Position
    from coupole.calibration.posed_camera import read_posed_camera
    from coupole.plan.cell import read_cell

    sources, target, sightings = look_for_board([path], independent.board, independent.poses, console, warmth)
    if sources.poses is None:
        raise InputError(f"{path}: the pictures have no poses; give a pose file with --poses")
    camera = read_posed_camera(hand_eye.path, None, sources.about, sightings.size_px)
    base_from_flange = sources.poses.base_from_flange[sightings.image_numbers]
    if any(parameter.name.startswith("axis_zero.") for parameter in hand_eye.record.parameters):
        joints = [sources.images[number].joints_deg for number in sightings.image_numbers]
        if None in joints:
            raise InputError(f"{hand_eye.path}: has axis zeros of the arm, but {path} has no joints; give runs")
        arm = arm_of(read_cell(independent.rig or rig_of(path)), hand_eye.path)
        assert arm is not None  # `arm_of` returns None only for a record without axis zeros
        base_from_flange, camera = calibrated_poses(base_from_flange, np.array(joints), arm, camera)
    return Position(path.resolve().name, sightings.sightings, base_from_flange, camera), sources, target


# -- a tile -----------------------------------------------------------------------------------------------------


def _check_tile(
    runs: list[Path],
    independent: IndependentArtefact,
    emission: str,
    records: Sequence[InForce],
    request: Request,
    console: Console,
) -> Outcome:
    import numpy as np

    from coupole.calibration.artefact import used_as
    from coupole.calibration.check.tile_reflectance import reflectance_of
    from coupole.calibration.check.workflow import (
        Pictures,
        check_outcome,
        compare_reflectances,
        needed_record,
        records_by_kind,
        refuse_dependent,
        refuse_used_images,
    )
    from coupole.calibration.earlier import refuse_read_otherwise
    from coupole.calibration.light.drift_records import read_powers
    from coupole.calibration.light.frames import channels_of
    from coupole.calibration.light.spectralon import read_tile

    tiles = independent.tile or []
    record_of_kind = records_by_kind(records, OF_TILE)
    record = needed_record(record_of_kind, "led-power")
    artefacts = [refuse_dependent(read_tile(tile).artefact, tile, records) for tile in tiles]
    if len({artefact.serial for artefact in artefacts}) > 1:
        raise InputError(
            f"--tile: expected the same tile in all places, found {', '.join(a.serial for a in artefacts)}"
        )
    refuse_read_otherwise(record_of_kind["led-power"].path, record, list(record_of_kind))
    places, inputs = [], []
    for number, run in enumerate(runs):
        tile = tiles[number % len(tiles)]
        place, frames, run_inputs = _place(
            run, tile, independent.rig, _calibrations_of(record_of_kind, independent.rig, emission), console
        )
        refuse_used_images(records, frames.inputs)
        places.append(place)
        inputs += run_inputs
    channels = channels_of(frames.pattern)
    powers = {channel: read_powers(record_of_kind["led-power"].path, channel) for channel in channels}
    names = [parameter.name for parameter in record.parameters]
    at = [names.index(f"{name}.{channel}") for channel in channels for name in powers[channel].names]
    tile_values = reflectance_of(places, powers, record.covariance_matrix[np.ix_(at, at)])
    figures = {f"reflectance.{channel}": places[0].tile[channel].reflectance for channel in channels}
    pictures = Pictures(frames.about, frames.size_px, tuple(dict.fromkeys(inputs)))
    artefact = used_as("tile", artefacts[0], figures)[0]
    return check_outcome(compare_reflectances(tile_values), artefact, pictures, record_of_kind, request)


def _calibrations_of(
    record_of_kind: Mapping[Kind, InForce], rig: Path | None, emission: str
) -> TargetCalibrations:
    """Return the records that are used to read frames of the tile."""
    paths = {kind: item.path for kind, item in record_of_kind.items()}
    return TargetCalibrations(
        rig=rig,
        leds=paths.get("leds"),
        hand_eye=paths.get("hand-eye"),
        camera=paths.get("camera"),
        dark_record=paths.get("dark"),
        response_record=paths.get("response"),
        flat=paths.get("flat-field"),
        glare=paths.get("glare"),
        emission=emission,
    )


def _place(
    run: Path, tile: Path, rig: Path | None, calibrations: TargetCalibrations, console: Console
) -> tuple[Place, LightFrames, list[tuple[str, str]]]:
    """Return the tile's reflectance in one run, the run's frames, and all files that were read."""
    from coupole.calibration.check.tile_reflectance import place_of
    from coupole.calibration.light.frames import open_light_frames

    frames = frames_with_poses(open_light_frames([run]), calibrations.hand_eye, calibrations.rig, [run])
    setting = setting_of(frames, tile, rig or rig_of(run), calibrations)
    with bar(console, f"frames of the tile in {run.name}") as progress:
        place = place_of(run.resolve().name, frames, setting, progress)
    return place, frames, [*frames.inputs, *setting.inputs]
