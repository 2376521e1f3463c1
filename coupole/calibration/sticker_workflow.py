"""From the stickers of a run and of a scan to the record of where the mesh lies, and what the report shows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, timedelta
from pathlib import Path

import numpy as np

import coupole
from coupole.calibration import optics
from coupole.calibration.mesh_to_robot import (
    ORIENTATION,
    POSITION,
    STICKERS,
    HandEye,
    MeshPose,
    Stated,
    mesh_to_robot,
)
from coupole.calibration.multi_view import seen_points
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.record import (
    ImageResidual,
    Input,
    Limit,
    Noise,
    Parameter,
    Record,
    Validity,
    sealed,
    step_names,
)
from coupole.calibration.rotations import Floats, inverses
from coupole.calibration.sources import Sources
from coupole.calibration.sticker_points import corrected, views_of
from coupole.calibration.sticker_sources import Scan, StickerImages
from coupole.calibration.workflow import Wish
from coupole.errors import InputError
from coupole.geometry import Transform, abc_from_rotation, inverse
from coupole.plan import Model, Pose

_LEAST_SIGMA_PX = 0.02


class MeshAcceptance(Model):
    """What the place of a mesh must reach to be accepted."""

    place_mm: float = 0.1
    """Largest standard uncertainty of a sticker's place in the base (seed 003: 100 um)."""
    missing: float = 0.5
    """Share of the table's stickers that were not found."""
    residual_px: float = 0.5
    robot_noise_ratio: float = 3.0


ACCEPTANCE = MeshAcceptance()


@dataclass(frozen=True)
class MeshFound:
    """The result and what the report draws."""

    record: Record
    pose: MeshPose
    images: StickerImages
    camera_from_mesh: Floats
    """4x4 at the image that is shown."""
    lens: optics.Intrinsics
    scan: Scan
    u_mm: Floats
    """[n] standard uncertainty of each target's place in the base."""


def mesh_from(
    images: StickerImages,
    sources: Sources,
    scan: Scan,
    prior: CameraPrior,
    wish: Wish,
    *,
    stated: Stated,
    depth_mm: tuple[float, float],
    base_from_support: Transform | None = None,
    acceptance: MeshAcceptance = ACCEPTANCE,
) -> MeshFound:
    """Find where a scanned mesh lies. Raises InputError if its stickers are not those in the images."""
    if sources.poses is None:
        raise InputError("mesh: the images have no poses; give runs, or a folder with poses")
    base_from_camera = sources.poses.base_from_flange @ prior.flange_from_camera
    sigma_px = _sigma_px(images)
    stated = replace(stated, sticker_px=sigma_px)
    pose_px = prior.lens.fx * (stated.robot_mm / float(np.mean(depth_mm)) + np.radians(stated.robot_deg))
    views = views_of(images.names, base_from_camera, images.stickers)
    points = seen_points(views, prior.lens, tolerance_px=4 * float(np.hypot(0.2, pose_px)), depth_mm=depth_mm)
    views = corrected(views, images.stickers, points)
    hand_eye = HandEye(prior.flange_from_camera, prior.hand_eye_covariance)
    pose = mesh_to_robot(
        views, prior.lens, scan.targets_mm, scan.names, stated=stated, hand_eye=hand_eye, depth_mm=depth_mm
    )
    u_mm = np.array([pose.uncertainty_at(target) for target in scan.targets_mm])
    transforms = {"base_from_mesh": _pose(pose.base_from_mesh)}
    if base_from_support is not None:
        transforms["support_from_object"] = _pose(inverse(base_from_support) @ pose.base_from_mesh)
    record = sealed(
        kind="mesh",
        name=wish.name,
        created=wish.now.astimezone(UTC).replace(microsecond=0),
        software=f"coupole {coupole.__version__}",
        simulated=sources.about.simulated,
        validity=Validity(
            expires=(wish.now + timedelta(days=wish.valid_days)).astimezone(UTC).replace(microsecond=0)
        ),
        transforms=transforms,
        parameters=_parameters(pose),
        fixed={"stickers_found": float(len(pose.matched)), "stickers_known": float(len(scan.names))},
        covariance=tuple(map(tuple, (0.5 * (pose.covariance + pose.covariance.T)).tolist())),
        noise=_noise(pose, stated),
        images=tuple(
            ImageResidual(name=name, corners=len(seen), rejected=0, rms_px=pose.residual_px)
            for name, seen in zip(images.names, images.stickers, strict=True)
        ),
        limits=_limits(pose, scan, u_mm, acceptance),
        remarks=_remarks(pose),
        inputs=tuple(Input(name=name, sha256=digest) for name, digest in (*sources.inputs, *scan.inputs)),
    )
    camera_from_mesh = inverses(base_from_camera[images.shown]) @ pose.base_from_mesh
    return MeshFound(record, pose, images, camera_from_mesh, prior.lens, scan, u_mm)


def _sigma_px(images: StickerImages) -> float:
    """Typical noise of a sticker's centre along one axis, by the fits of their rims."""
    variances = [np.trace(sticker.covariance) / 2 for seen in images.stickers for sticker in seen]
    return max(float(np.sqrt(np.median(variances))), _LEAST_SIGMA_PX)


def mesh_edges_px(found: MeshFound, mesh: Path, most: int = 20_000) -> Floats:
    """Pixels [n, 2] of the mesh's vertices as the shown image should have them, at most so many."""
    import trimesh

    vertices = np.asarray(trimesh.load_mesh(mesh, process=False).vertices, dtype=np.float64)
    vertices = vertices[:: max(1, len(vertices) // most)]
    return reprojected(found, vertices)


def reprojected(found: MeshFound, mesh_mm: Floats) -> Floats:
    """Pixels [n, 2] of points [n, 3] of the mesh in the image that is shown."""
    in_camera = mesh_mm @ found.camera_from_mesh[:3, :3].T + found.camera_from_mesh[:3, 3]
    return optics.project(in_camera[in_camera[:, 2] > 1.0], found.lens.vector()).pixels


def _parameters(pose: MeshPose) -> tuple[Parameter, ...]:
    place = pose.base_from_mesh[:3, 3]
    return tuple(
        Parameter(
            name=name,
            value=float(place[i]) if i < len(place) else None,
            u=float(np.sqrt(pose.covariance[i, i])),
            degrees_of_freedom=float(pose.degrees[i]),
            dominated_by=pose.dominated_by[i],
        )
        for i, name in enumerate(step_names("base_from_mesh"))
    )


def _noise(pose: MeshPose, stated: Stated) -> tuple[Noise, ...]:
    said = {
        STICKERS: (stated.sticker_px, "px"),
        POSITION: (stated.robot_mm, "mm"),
        ORIENTATION: (stated.robot_deg, "deg"),
    }
    return tuple(
        Noise(
            name=name,
            unit=unit,
            stated=sigma,
            found=sigma * pose.noise[name],
            redundancy=float(pose.redundancy[name]),
        )
        for name, (sigma, unit) in said.items()
    )


def _limits(pose: MeshPose, scan: Scan, u_mm: Floats, asked: MeshAcceptance) -> tuple[Limit, ...]:
    robot = max(pose.noise[POSITION], pose.noise[ORIENTATION])
    return (
        Limit(what="place of the worst sticker", found=float(u_mm.max()), limit=asked.place_mm, unit="mm"),
        Limit(
            what="stickers not found",
            found=1 - len(pose.matched) / len(scan.names),
            limit=asked.missing,
            unit="",
        ),
        Limit(what="residual of stickers", found=pose.residual_px, limit=asked.residual_px, unit="px"),
        Limit(what="robot's noise, found over stated", found=float(robot), limit=asked.robot_noise_ratio, unit=""),
    )


def _remarks(pose: MeshPose) -> tuple[str, ...]:
    remarks = [
        f"points in space off the scanner's table by {pose.point_rms_mm:.3f} mm (rms) before the adjustment"
    ]
    if pose.missing:
        remarks.append(f"{len(pose.missing)} stickers of the table were not found: {', '.join(pose.missing[:20])}")
    if pose.false_points:
        remarks.append(f"{pose.false_points} things like stickers are none of the table's")
    return tuple(remarks)


def _pose(transform: Floats) -> Pose:
    x, y, z = map(float, transform[:3, 3])
    return Pose(translation_mm=(x, y, z), abc_deg=abc_from_rotation(transform[:3, :3]))
