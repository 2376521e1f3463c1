"""Makes a record and the report's data from images and poses, with the functions that the commands call.

Each function makes a sealed record. A contradiction with a known cause raises an error with that cause, because
the result would be meaningless. A contradiction without a simple cause becomes a remark of the record, which then
exceeds its limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from coupole.calibration import optics
from coupole.calibration.acceptance import against_limits
from coupole.calibration.adjustment import Component
from coupole.calibration.arm_errors import axis_sensitivity
from coupole.calibration.lens.acceptance import CAMERA, HAND_EYE
from coupole.calibration.lens.board import Board, Sighting
from coupole.calibration.lens.bundle import HandEyeCalibration, RobotNoise, calibrate_hand_eye
from coupole.calibration.lens.camera import CameraCalibration, calibrate_camera, without_gross_errors
from coupole.calibration.lens.diagnosis import Diagnosis, diagnose, expected_scatter
from coupole.calibration.lens.doubts import Doubts
from coupole.calibration.lens.equations import EarlierLens, Poses
from coupole.calibration.lens.images import Found
from coupole.calibration.poses import ReportedPoses
from coupole.calibration.record import (
    ImageResidual,
    Input,
    Noise,
    Parameter,
    Record,
    pose_of,
    rows_of,
    seal_record,
)
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats
from coupole.calibration.sources import Sources
from coupole.errors import InputError
from coupole.kinematics import Arm

FIELD_CELLS = (8, 6)


@dataclass(frozen=True)
class Shown:
    """Data that the report draws."""

    record: Record
    size_px: tuple[int, int]
    names: tuple[str, ...]
    """Names of the images."""
    pixels: tuple[Floats, ...]
    """[k, 2] pixels of the corners in each image."""
    residuals_px: tuple[Floats, ...]
    """[k, 2], observed minus computed."""
    pixel_px: float
    pose_errors: Floats | None
    """[n, 6] errors of the robot, mm and degrees."""


def camera_from(
    board_images: Found, sources: Sources, model: str, request: Request
) -> tuple[CameraCalibration, Shown]:
    """Calibrate a lens from the images of a board."""
    fit = calibrate_camera(board_images.sightings, board_images.size_px, model, with_doubts=True)
    good_sightings = without_gross_errors(fit)
    residuals = tuple(r[keep] for r, keep in zip(fit.residuals_px, fit.accepted_masks, strict=True))
    u = np.sqrt(np.diag(fit.covariance))
    parameters = [
        Parameter(
            name=unit_name(name),
            value=getattr(fit.intrinsics, name),
            u=float(u[i]),
            degrees_of_freedom=float(fit.degrees[i]),
            dominated_by="corners",
        )
        for i, name in enumerate(fit.free)
    ]
    redundancy = float(np.sum([2 * k.sum() for k in fit.accepted_masks]) - len(fit.free) - 6 * len(good_sightings))
    record = seal_record(
        kind="camera",
        transforms={},
        parameters=tuple(parameters),
        covariance=rows_of(fit.covariance),
        noise=(_noise("corners", "px", 0.0, fit.sigma_px, redundancy),),
        limits=against_limits(
            CAMERA,
            request.limits,
            {**image_figures(fit, board_images), "ray_px": ray_u_px(fit), **doubted_figures(fit.doubts)},
        ),
        remarks=(
            *board_images.left_out,
            *sentences_of(fit.doubts),
            *sentences_of_pixels(good_sightings, fit.sigma_px),
        ),
        fixed=held_parameters(fit.intrinsics, fit.free),
        images=image_lines(good_sightings, residuals, fit.sightings),
        **content_of(board_images, sources, request),
    )
    return fit, _lens_report(record, board_images, good_sightings, residuals, fit.sigma_px, None)


@dataclass(frozen=True)
class CameraArm:
    """The arm that carries the camera."""

    noise: RobotNoise
    model: Arm | None = None
    """The arm's model; the zero errors of its axes are then estimated too."""


def hand_eye_from(
    board_images: Found,
    sources: Sources,
    board: Board,
    model: str,
    request: Request,
    *,
    arm: CameraArm,
    lens: EarlierLens | None = None,
) -> tuple[HandEyeCalibration, Diagnosis, Shown]:
    """Calibrate the camera's pose on the flange. Raises InputError with the likely cause if robot and camera
    contradict each other and a cause is known."""
    if sources.poses is None:
        raise InputError("hand-eye: the images have no poses; give a pose file with --poses")
    if not board.has_a_top:
        raise InputError(
            "hand-eye: this chess board looks the same upside down; use one whose corners are even in one "
            "direction and odd in the other, or a ChArUco board"
        )
    fit = calibrate_camera(board_images.sightings, board_images.size_px, model)
    good_sightings = without_gross_errors(fit)
    reported_poses = ReportedPoses(sources.poses.numbers[board_images.image_numbers], sources.poses.convention)
    joints = [sources.images[i].joints_deg for i in board_images.image_numbers]
    joints_deg = [j for j in joints if j is not None]
    model_of_arm = arm.model if len(joints_deg) == len(joints) else None
    axes = axis_sensitivity(model_of_arm, joints_deg) if model_of_arm is not None else None
    diagnosis = _refused_if_contradicting(fit, reported_poses, arm.noise, [s.name for s in good_sightings])
    result = calibrate_hand_eye(
        good_sightings,
        Poses(reported_poses.base_from_flange, axes),
        model=model,
        lens=lens or fit.intrinsics,
        robot=arm.noise,
        board_scale_u_ppm=board.scale_u_ppm,
        size_px=board_images.size_px,
    )
    record = seal_record(
        kind="hand-eye",
        transforms={
            "flange_from_camera": pose_of(result.flange_from_camera),
            "base_from_board": pose_of(result.base_from_board),
        },
        parameters=_hand_eye_parameters(result),
        covariance=rows_of(result.covariance),
        noise=_hand_eye_noise(result),
        limits=against_limits(
            HAND_EYE,
            request.limits,
            {**image_figures(fit, board_images), **_hand_eye_figures(result), **doubted_figures(result.doubts)},
        ),
        remarks=(
            *filter(None, (*board_images.left_out, *diagnosis.sentences(), diagnosis.of_methods())),
            *sentences_of(result.doubts),
        ),
        fixed=held_parameters(result.intrinsics, lens.free if lens else optics.MODELS[model]),
        images=image_lines(good_sightings, result.residuals_px, fit.sightings),
        **content_of(board_images, sources, request),
    )
    errors = result.residuals_px, result.noise.pixel_px, result.pose_errors
    return result, diagnosis, _lens_report(record, board_images, good_sightings, *errors)


def _refused_if_contradicting(
    fit: CameraCalibration, reported_poses: ReportedPoses, robot: RobotNoise, names: Sequence[str]
) -> Diagnosis:
    """Diagnose how well robot and camera agree. Raises InputError if they do not agree and the cause is known."""
    robot_mm, robot_rad = robot.pose_sigmas(axes_known=False)
    expectation = expected_scatter(
        fit.camera_from_board,
        pixel_px=fit.sigma_px,
        focal_px=fit.intrinsics.fx,
        robot_mm=robot_mm,
        robot_deg=float(np.degrees(robot_rad)),
    )
    diagnosis = diagnose(reported_poses, fit.camera_from_board, expectation, names)
    if diagnosis.cause is not None:
        raise InputError("hand-eye: " + ".\n".join(diagnosis.sentences()[:2]) + ".")
    return diagnosis


def _lens_report(
    record: Record,
    board_images: Found,
    accepted_sightings: Sequence[Sighting],
    residuals_px: tuple[Floats, ...],
    pixel_px: float,
    pose_errors: Floats | None,
) -> Shown:
    names, pixels = tuple(s.name for s in accepted_sightings), tuple(s.pixels for s in accepted_sightings)
    return Shown(record, board_images.size_px, names, pixels, residuals_px, pixel_px, pose_errors)


def ray_u_px(fit: CameraCalibration) -> float:
    """Return the largest standard uncertainty of the image of a direction at the corners and edges of the field,
    px.

    Changes of the intrinsics that are equivalent to a rotation of the camera do not count, because the board's
    poses absorb them.
    """
    width, height = fit.size_px
    steps = np.linspace(0.0, 1.0, 9)
    field = np.array([(x * (width - 1), y * (height - 1)) for x in steps for y in steps])
    rays = np.column_stack(
        [(field - (fit.intrinsics.cx, fit.intrinsics.cy)) / (fit.intrinsics.fx, fit.intrinsics.fy)]
    )
    points = np.column_stack([rays, np.ones(len(rays))])
    image = optics.project(points, fit.intrinsics.vector())
    by_lens = image.by_intrinsics[:, :, [optics.NAMES.index(name) for name in fit.free]].reshape(-1, len(fit.free))
    turns = np.cross(np.eye(3)[None], points[:, None])  # d point / d rotation about each axis, [k, 3, 3]
    by_turn = np.einsum("kij,kaj->kia", image.by_point, turns).reshape(-1, 3)
    without_turns = by_lens - by_turn @ np.linalg.lstsq(by_turn, by_lens, rcond=None)[0]
    variance = np.einsum("ki,ij,kj->k", without_turns, fit.covariance, without_turns)
    return float(np.sqrt(variance.reshape(-1, 2).sum(axis=1).max()))


def field_without_corners(sightings: Sequence[Sighting], size_px: tuple[int, int]) -> float:
    """Return the share of the field's cells, 8 x 6, without a corner."""
    pixels = np.concatenate([sighting.pixels for sighting in sightings])
    cells = np.floor(pixels * FIELD_CELLS / size_px).astype(int)
    return 1.0 - len(np.unique(cells, axis=0)) / (FIELD_CELLS[0] * FIELD_CELLS[1])


def image_lines(
    accepted_sightings: Sequence[Sighting], residuals: Sequence[Floats], all_seen: Sequence[Sighting]
) -> tuple[ImageResidual, ...]:
    """Return the number of corners and the residual of each image."""
    return tuple(
        ImageResidual(
            name=sighting.name,
            corners=len(sighting.ids),
            rejected=len(before.ids) - len(sighting.ids),
            rms_px=float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))),
        )
        for sighting, residual, before in zip(accepted_sightings, residuals, all_seen, strict=True)
    )


def content_of(board_images: Found, sources: Sources, request: Request) -> dict[str, object]:
    """Return the content that all records from a board's images share."""
    about = sources.about
    return {
        **request.head(),
        "simulated": about.is_simulated,
        "validity": request.validity(about, board_images.size_px, about.temperature_c),
        "artefacts": sources.artefacts,
        "inputs": tuple(Input(name=name, sha256=digest) for name, digest in sources.inputs),
    }


def held_parameters(intrinsics: optics.Intrinsics, free: Sequence[str]) -> dict[str, float]:
    """Return the lens parameters that were not estimated, by the record's names."""
    return {unit_name(n): getattr(intrinsics, n) for n in optics.NAMES if n not in free}


def image_figures(fit: CameraCalibration, board_images: Found) -> dict[str, float]:
    """Return the figures that `acceptance.IMAGES` limits."""
    is_rejected = np.concatenate([~keep for keep in fit.accepted_masks])
    clipped_count = sum(": clipped" in line for line in board_images.left_out)
    return {
        "pixel_px": fit.sigma_px,
        "bare_field": field_without_corners(fit.sightings, fit.size_px),
        "rejected": float(is_rejected.mean()),
        "clipped": clipped_count / (len(board_images.sightings) + len(board_images.left_out)),
    }


def doubted_figures(doubts: Doubts | None) -> dict[str, float]:
    """Return the figures that `acceptance.DOUBTS` limits."""
    return {} if doubts is None else {"pattern": doubts.pattern, "predicted": doubts.predictions.ratio}


def sentences_of(doubts: Doubts | None) -> tuple[str, ...]:
    return () if doubts is None else tuple(doubts.sentences())


def sentences_of_pixels(sightings: Sequence[Sighting], found_px: float) -> tuple[str, ...]:
    """Compare the corners' noise in the adjustment with the noise that their pixels show."""
    u_px = [sighting.u_px for sighting in sightings if sighting.u_px is not None]
    if not u_px:
        return ()
    by_pixels_px = float(np.sqrt(np.mean(np.concatenate(u_px) ** 2)))
    rest = "; the rest is board, lens and movement" if found_px > by_pixels_px else ""
    return (
        f"noise of a corner {found_px:.2g} px by the residuals, {by_pixels_px:.2g} px by its pixels alone{rest}",
    )


def _hand_eye_figures(result: HandEyeCalibration) -> dict[str, float]:
    def together(steps: Sequence[str]) -> float:
        return float(np.linalg.norm([result.u(f"flange_from_camera.{step}") for step in steps]))

    noise = result.noise
    return {
        "centre_mm": together(("x_mm", "y_mm", "z_mm")),
        "turn_deg": together(("rx_deg", "ry_deg", "rz_deg")),
        "robot_ratio": max(
            noise.position_mm / noise.stated_position_mm, noise.orientation_deg / noise.stated_orientation_deg
        ),
    }


def _hand_eye_parameters(result: HandEyeCalibration) -> tuple[Parameter, ...]:
    values: dict[str, float] = {unit_name(name): getattr(result.intrinsics, name) for name in optics.NAMES}
    values["board_scale"] = result.board_scale
    values |= {f"axis_zero.a{i + 1}_deg": float(zero) for i, zero in enumerate(result.axis_zeros_deg)}
    for name in ("flange_from_camera", "base_from_board"):
        at = getattr(result, name)[:3, 3]
        values |= {f"{name}.{axis}_mm": float(at[i]) for i, axis in enumerate("xyz")}
    u = np.sqrt(np.diag(result.covariance))
    return tuple(
        Parameter(
            name=name,
            value=values.get(name),
            u=float(u[i]),
            degrees_of_freedom=float(result.degrees[i]),
            dominated_by=result.components[int(np.argmax(result.shares[:, i]))].name,
        )
        for i, name in enumerate(result.names)
    )


def _hand_eye_noise(result: HandEyeCalibration) -> tuple[Noise, ...]:
    component_of: dict[str, Component] = {component.name: component for component in result.components}
    noise = result.noise
    return (
        _noise("corners", "px", 0.0, noise.pixel_px, component_of["corners"].redundancy),
        _noise(
            "robot position",
            "mm",
            noise.stated_position_mm,
            noise.position_mm,
            component_of["robot position"].redundancy,
        ),
        _noise(
            "robot orientation",
            "deg",
            noise.stated_orientation_deg,
            noise.orientation_deg,
            component_of["robot orientation"].redundancy,
        ),
    )


def _noise(
    name: str, unit: Literal["px", "mm", "deg"], stated_sigma: float, found_sigma: float, redundancy: float
) -> Noise:
    return Noise(name=name, unit=unit, stated=stated_sigma, found=found_sigma, redundancy=redundancy)


def unit_name(name: str) -> str:
    """Return a lens parameter's name with its unit, as in records."""
    return f"{name}_px" if name in ("fx", "fy", "cx", "cy") else name
