"""Make the record of all LEDs, the dome's new table and the report's data from the spots of a run."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.acceptance import against_limits
from coupole.calibration.calibrated_arm import CalibratedArm, calibrated_poses
from coupole.calibration.leds.acceptance import LEDS
from coupole.calibration.leds.adjustment import LedGeometry, adjust_leds
from coupole.calibration.leds.boards import Boards, board_poses, boards_of
from coupole.calibration.leds.equations import GROUPS, ORIENTATION, POSITION, SPOTS, TOLERANCE, Stated, problem_of
from coupole.calibration.leds.matching import Matching, fault_lines, match_leds
from coupole.calibration.leds.remarks import remarks_of
from coupole.calibration.leds.sources import LedImages
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.record import (
    ImageResidual,
    Input,
    LedFault,
    Limit,
    Noise,
    Parameter,
    Record,
    Validity,
    seal_record,
)
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats, rotation_vector
from coupole.errors import InputError
from coupole.plan.led_table import COLUMNS, LedTable

MOVED_MM, MOVED_DEG = 5.0, 1.0
"""A board that is farther than this from its place in the table is reported: it was remounted, or pushed."""
_COVARIANCE_OF_SINGLE = 1e-12


@dataclass(frozen=True)
class LedsFound:
    """The result, and the data that the report draws."""

    record: Record
    files: dict[str, bytes]
    table: LedTable
    """Table before the calibration."""
    new_table: LedTable
    geometry: LedGeometry
    matching: Matching
    u_mm: Floats
    """[n] standard uncertainty of each LED's centre, by row of the table; NaN for an LED that was not found."""
    u_deg: Floats
    """[n] standard uncertainty of each LED's normal."""
    view_errors: Floats
    """[v, 6] error of the arm at each view, mm and degrees."""


def leds_from(
    images: LedImages,
    table: LedTable,
    prior: CameraPrior,
    request: Request,
    *,
    stated_noise: Stated,
    arm: CalibratedArm | None = None,
    accept_faults: bool = False,
) -> LedsFound:
    """Find all LEDs of a dome. Raises InputError if none is found, or the spots contradict the camera's record.

    `arm` corrects the reported poses by the axis zeros that the hand-eye record found. With dead, swapped or
    astray LEDs the record is not accepted and there is no table, unless `accept_faults`.
    """
    if arm is not None and images.joints_deg is not None:
        poses, prior = calibrated_poses(images.base_from_flange, images.joints_deg, arm, prior)
        images = replace(images, base_from_flange=poses)
    boards = boards_of(table)
    matching = _match_spots(images, table, boards, prior, stated_noise)
    sightings = matching.sightings.only(np.flatnonzero(matching.place_of[matching.sightings.led] >= 0))
    place = matching.place_of[sightings.led]
    problem = problem_of(sightings, place, boards, images.base_from_flange, prior, stated_noise)
    geometry = adjust_leds(problem, board_poses(boards, matching.by_place_mm))
    leds = _in_table_order(geometry, matching, boards)
    normals = geometry.normals[boards.board_of[leds.place]]
    new_table = LedTable(
        table.ids, table.boards[leds.place], geometry.centres_mm[leds.place], normals, table.flux_lm
    )
    faults = (*matching.faults, *_moved_boards(boards, geometry, place))
    of_faults = _of_faults(faults, accept_faults)
    limits = (*against_limits(LEDS, request.limits, _figures(geometry, leds)), of_faults)
    files = {f"{request.name}.h5": _h5(geometry, matching, boards, leds.place, place, len(table.ids))}
    if of_faults.is_met:
        files[f"{request.name}.csv"] = led_csv(new_table, request.name).encode("ascii")
    record = _record(
        images,
        request,
        geometry,
        leds,
        stated_noise,
        files,
        _Assessment(
            _views(images.views, sightings.view, geometry),
            limits,
            faults,
            (*fault_lines(faults), *remarks_of(images, geometry, prior, limits, arm)),
        ),
    )
    return LedsFound(
        record,
        files,
        table,
        new_table,
        geometry,
        matching,
        np.where(leds.found_mask, leds.u_mm, np.nan),
        np.where(leds.found_mask, leds.u_deg, np.nan),
        _view_errors(geometry, images.base_from_flange),
    )


@dataclass(frozen=True)
class _InTableOrder:
    """The dome's LEDs [n], in the order of the table's rows."""

    found_mask: NDArray[np.bool_]
    place: NDArray[np.intp]
    """Place on the boards at which the LED was found. For an LED that was not found, it is the place of its row in
    the table."""
    u_mm: Floats
    """Standard uncertainty of the centre at that place."""
    u_deg: Floats
    """Standard uncertainty of the normal at that place."""


def _in_table_order(geometry: LedGeometry, matching: Matching, boards: Boards) -> _InTableOrder:
    is_found = matching.place_of >= 0
    place = np.where(is_found, matching.place_of, np.arange(len(is_found)))
    u_mm = np.sqrt(np.trace(geometry.centre_covariance, axis1=1, axis2=2))
    u_deg = np.sqrt(np.trace(geometry.normal_covariance, axis1=1, axis2=2))[boards.board_of]
    return _InTableOrder(is_found, place, u_mm[place], u_deg[place])


def _match_spots(
    images: LedImages, table: LedTable, boards: Boards, prior: CameraPrior, stated_noise: Stated
) -> Matching:
    """Spots assigned to LEDs. Raises InputError if no spot belongs to a place of the table."""
    base_from_camera = images.base_from_flange @ prior.flange_from_camera
    matching = match_leds(
        images.seen,
        base_from_camera,
        prior.lens,
        table.ids,
        boards,
        tolerance_px=tolerance_px(prior, stated_noise, table, base_from_camera),
    )
    if not np.any(matching.place_of[matching.sightings.led] >= 0):
        lines = "\n".join(fault_lines(matching.faults)[:5])
        raise InputError(f"LEDs: none was found near its place of the table:\n{lines}")
    return matching


@dataclass(frozen=True)
class _Assessment:
    """The record's remarks and figures about the adjustment and the dome."""

    views: tuple[ImageResidual, ...]
    limits: Sequence[Limit]
    faults: tuple[LedFault, ...]
    remarks: tuple[str, ...]


def _record(
    images: LedImages,
    request: Request,
    geometry: LedGeometry,
    leds: _InTableOrder,
    stated_noise: Stated,
    files: Mapping[str, bytes],
    assessment: _Assessment,
) -> Record:
    median_u_mm, median_u_deg = (float(np.median(u[leds.found_mask])) for u in (leds.u_mm, leds.u_deg))
    return seal_record(
        kind="leds",
        **request.head(),
        simulated=images.about.is_simulated,
        validity=Validity(expires=request.expires),
        transforms={},
        **_parameters(geometry, stated_noise, median_u_mm, median_u_deg),
        fixed={
            "leds": float(len(leds.found_mask)),
            "leds_found": float(leds.found_mask.sum()),
            "views": float(len(images.base_from_flange)),
            "images": float(len(images.seen.frames)),
        },
        files=tuple(Input(name=name, sha256=hashlib.sha256(data).hexdigest()) for name, data in files.items()),
        noise=_noise(geometry, stated_noise),
        images=assessment.views,
        limits=assessment.limits,
        faults=assessment.faults,
        remarks=assessment.remarks,
        inputs=tuple(Input(name=name, sha256=digest) for name, digest in images.inputs),
    )


def tolerance_px(prior: CameraPrior, stated_noise: Stated, table: LedTable, base_from_camera: Floats) -> float:
    """Largest distance of the spots of one LED from one point: 4 sigma of the camera's poses at the dome's
    distance, and 3 px for all other errors."""
    eyes_mm = base_from_camera[:, :3, 3].mean(axis=0)
    distance_mm = float(np.median(np.linalg.norm(table.positions_mm - eyes_mm, axis=1)))
    hand_eye = np.sqrt(np.diag(prior.hand_eye_covariance))
    shift_mm = float(np.hypot(stated_noise.robot_mm, hand_eye[:3].max()))
    turn = float(np.hypot(np.radians(stated_noise.robot_deg), hand_eye[3:].max()))
    return 3.0 + 4.0 * prior.lens.fx * (shift_mm / distance_mm + turn)


def led_csv(table: LedTable, name: str) -> str:
    """Return a dome's table in the format of `configs/domes`."""
    lines = [
        f"# LEDs of a dome, in the frame of the robot's base. By the calibration {name}.",
        "# Positions in mm, normals of unit length into the dome, flux in lumen.",
        ",".join(COLUMNS),
    ]
    for row, led in enumerate(table.ids):
        place = ",".join(f"{v:z.4f}" for v in table.positions_mm[row])
        normal = ",".join(f"{v:z.7f}" for v in table.normals[row])
        lines.append(f"{led},{table.boards[row]},{place},{normal},{table.flux_lm[row]:.1f}")
    return "\n".join(lines) + "\n"


def _h5(
    geometry: LedGeometry,
    matching: Matching,
    boards: Boards,
    where: NDArray[np.intp],
    place: NDArray[np.intp],
    count: int,
) -> bytes:
    """Return the uncertainties by LED, in the table's order, as the bytes of an HDF5 file; equal numbers give
    equal bytes."""
    keep = geometry.accepted_mask
    views = np.bincount(place[keep], minlength=count)
    square = np.bincount(place[keep], np.sum(geometry.residuals_px[keep] ** 2, axis=1), minlength=count)
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", track_order=True) as file:
        file.attrs["frame"] = "base"

        def write_dataset(name: str, data: NDArray[np.generic], unit: str, long_name: str) -> None:
            dataset = file.create_dataset(name, data=data, track_times=False)
            dataset.attrs["units"] = unit
            dataset.attrs["long_name"] = long_name

        write_dataset(
            "centre_covariance", geometry.centre_covariance[where], "mm^2", "[leds, 3, 3] covariance of the centre"
        )
        normal = geometry.normal_covariance[boards.board_of[where]]
        write_dataset("normal_covariance", normal, "deg^2", "[leds, 2, 2] of the turns about the board's x and y")
        axes = geometry.state.base_from_board[boards.board_of[where], :3, :2]
        write_dataset("board_axes", axes, "", "[leds, 3, 2] x and y axes of the LED's board in the base frame")
        write_dataset(
            "left_out_covariance",
            geometry.views.centre_covariance[where],
            "mm^2",
            "[leds, 3, 3] covariance of the centre by the jackknife over views",
        )
        write_dataset("degrees_of_freedom", geometry.degrees[where], "", "[leds] effective, for the centre's u")
        shared_text = (
            "[leds] share of the centre's variance from poses, lens and hand-eye (common to neighbouring LEDs)"
        )
        write_dataset("shared_part", geometry.shared_part[where], "", shared_text)
        write_dataset(
            "offset_mm",
            geometry.state.offsets_mm[where],
            "mm",
            "[leds, 3] offset of each LED from its nominal place on the board",
        )
        write_dataset("views", views[where], "", "[leds] number of views in which the LED was found")
        write_dataset("residual_rms", np.sqrt(square / np.maximum(views, 1))[where], "px", "[leds]")
        write_dataset("found", matching.place_of >= 0, "", "[leds] False: only the board determines the place")
    return buffer.getvalue()


def _of_faults(faults: Sequence[LedFault], are_accepted: bool) -> Limit:
    count = float(sum(fault.is_wrong for fault in faults))
    label = "faults of LEDs and wires"
    if are_accepted and count:
        return Limit(what=label, found=count, limit=count, unit="", usual=0.0)
    return Limit(what=label, found=count, limit=0.0, unit="")


def _moved_boards(boards: Boards, geometry: LedGeometry, place: NDArray[np.intp]) -> list[LedFault]:
    before, after = boards.base_from_board, geometry.state.base_from_board
    shift_mm = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    turn = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    turn_deg = np.degrees(np.linalg.norm(rotation_vector(turn), axis=1))
    is_seen = np.isin(np.arange(len(boards.numbers)), boards.board_of[place])
    return [
        LedFault(
            "moved",
            (),
            f"board {boards.numbers[b]} stands {shift_mm[b]:.1f} mm and {turn_deg[b]:.2f} deg from its place in "
            "the table. Its new place is in this record",
        )
        for b in np.flatnonzero(is_seen & ((shift_mm > MOVED_MM) | (turn_deg > MOVED_DEG)))
    ]


def _parameters(
    geometry: LedGeometry, stated_noise: Stated, centre_mm: float, normal_deg: float
) -> dict[str, object]:
    """Return figures of the whole dome. Their own uncertainty is the uncertainty of a standard deviation, s /
    sqrt(2 nu)."""
    robot_mm, robot_deg = (
        stated_noise.robot_mm * geometry.noise[POSITION],
        stated_noise.robot_deg * geometry.noise[ORIENTATION],
    )
    freedom = np.maximum(geometry.redundancy, 1.0)
    poses = float(freedom[POSITION] + freedom[ORIENTATION])
    by = "camera poses" if float(np.median(geometry.shared_part)) > 0.5 else GROUPS[SPOTS]
    figures = [
        ("led_centre_median_u_mm", centre_mm, poses, by),
        ("led_normal_median_u_deg", normal_deg, poses, by),
        ("robot_position_mm", robot_mm, float(freedom[POSITION]), "residuals"),
        ("robot_orientation_deg", robot_deg, float(freedom[ORIENTATION]), "residuals"),
        (
            "led_on_board_mm",
            stated_noise.tolerance_mm * geometry.noise[TOLERANCE],
            float(freedom[TOLERANCE]),
            "residuals",
        ),
    ]
    parameters = tuple(
        Parameter(
            name=name,
            value=float(value),
            u=float(value) / float(np.sqrt(2 * freedom)),
            degrees_of_freedom=freedom,
            dominated_by=cause,
        )
        for name, value, freedom, cause in figures
    )
    covariance = np.diag([max(p.u**2, _COVARIANCE_OF_SINGLE**2) for p in parameters])
    return {"parameters": parameters, "covariance": tuple(map(tuple, covariance.tolist()))}


def _noise(geometry: LedGeometry, stated_noise: Stated) -> tuple[Noise, ...]:
    spot_px = float(np.sqrt(np.mean(geometry.residuals_px[geometry.accepted_mask] ** 2)))
    units = ("px", "mm", "mm", "deg")
    numbers = (
        (spot_px / max(float(geometry.noise[SPOTS]), 1e-9), spot_px),
        (stated_noise.tolerance_mm, stated_noise.tolerance_mm * geometry.noise[TOLERANCE]),
        (stated_noise.robot_mm, stated_noise.robot_mm * geometry.noise[POSITION]),
        (stated_noise.robot_deg, stated_noise.robot_deg * geometry.noise[ORIENTATION]),
    )
    return tuple(
        Noise(name=name, unit=unit, stated=float(before), found=float(after), redundancy=float(freedom))
        for name, unit, (before, after), freedom in zip(GROUPS, units, numbers, geometry.redundancy, strict=True)
    )


def _views(names: Sequence[str], view: NDArray[np.intp], geometry: LedGeometry) -> tuple[ImageResidual, ...]:
    """Return one line for each view; in it, spots take the place of the corners of a board's image."""
    lines = []
    for number, name in enumerate(names):
        rows = np.flatnonzero(view == number)
        good = rows[geometry.accepted_mask[rows]]
        square = np.sum(geometry.residuals_px[good] ** 2, axis=1)
        rms_px = float(np.sqrt(square.mean())) if len(good) else 0.0
        lines.append(ImageResidual(name=name, corners=len(good), rejected=len(rows) - len(good), rms_px=rms_px))
    return tuple(lines)


def _figures(geometry: LedGeometry, leds: _InTableOrder) -> dict[str, float]:
    """Return the figures that `acceptance.LEDS` limits."""
    return {
        "missing": float(1 - leds.found_mask.mean()),
        "centre_mm": float(np.median(leds.u_mm[leds.found_mask])),
        "normal_deg": float(np.median(leds.u_deg[leds.found_mask])),
        "robot_ratio": float(max(geometry.noise[POSITION], geometry.noise[ORIENTATION])),
        "rejected": float(1 - geometry.accepted_mask.mean()),
        "record_step": float(np.abs(geometry.prior_step).max()),
        "image_away": max(suspect.away for suspect in geometry.suspects),
        "left_out": geometry.left_out_ratio(leds.place[leds.found_mask]),
    }


def _view_errors(geometry: LedGeometry, reported_poses: Floats) -> Floats:
    shift = geometry.state.base_from_flange[:, :3, 3] - reported_poses[:, :3, 3]
    turn = np.swapaxes(reported_poses[:, :3, :3], 1, 2) @ geometry.state.base_from_flange[:, :3, :3]
    return np.concatenate([shift, np.degrees(rotation_vector(turn))], axis=1)
