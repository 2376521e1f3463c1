"""Makes the record of the mesh's pose, and the report's data, from the stickers of a run and of a scan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from coupole.calibration import optics
from coupole.calibration.acceptance import against_limits
from coupole.calibration.calibrated_arm import CalibratedArm, CarriedCamera, calibrated_poses
from coupole.calibration.multi_view import seen_points
from coupole.calibration.record import (
    ImageResidual,
    Input,
    Noise,
    Parameter,
    Record,
    Validity,
    pose_of,
    rows_of,
    seal_record,
    step_names,
)
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats, inverses
from coupole.calibration.sources import Sources
from coupole.calibration.stickers.acceptance import MESH
from coupole.calibration.stickers.mesh_to_robot import (
    ORIENTATION,
    POSITION,
    STICKERS,
    MeshPose,
    Stated,
    mesh_to_robot,
)
from coupole.calibration.stickers.points import corrected_views, views_of
from coupole.calibration.stickers.sources import Scan, StickerImages
from coupole.errors import InputError
from coupole.geometry import Transform, inverse
from coupole.scan.simplify import simplified_mesh

_LEAST_SIGMA_PX = 0.02
_MOST_FACES = 1_000_000
"""Largest number of faces of the mesh that is drawn onto a frame."""


@dataclass(frozen=True)
class MeshFound:
    """The result, and the data that the report draws."""

    record: Record
    pose: MeshPose
    images: StickerImages
    camera_from_mesh: Floats
    """4x4 transform at the shown image."""
    lens: optics.Intrinsics
    scan: Scan
    u_mm: Floats
    """[n] standard uncertainty of each target's place in the base frame."""


def mesh_from(
    images: StickerImages,
    sources: Sources,
    scan: Scan,
    camera: CarriedCamera,
    request: Request,
    *,
    stated_noise: Stated,
    base_from_support: Transform | None = None,
) -> MeshFound:
    """Calibrate the pose of a scanned mesh. Raises InputError if its stickers do not match the stickers in the
    images."""
    if sources.poses is None:
        raise InputError("mesh: the images have no poses; give runs, or a folder with poses")
    base_from_flange = sources.poses.base_from_flange
    prior, arm, depth_mm = camera.prior, camera.arm, images.depth_mm
    if arm is not None:
        joints_deg = np.array([source.joints_deg for source in sources.images])
        base_from_flange, prior = calibrated_poses(base_from_flange, joints_deg, arm, prior)
    base_from_camera = base_from_flange @ prior.flange_from_camera
    sigma_px = _sigma_px(images)
    stated_noise = replace(stated_noise, sticker_px=sigma_px)
    pose_px = prior.lens.fx * (
        stated_noise.robot_mm / float(np.mean(depth_mm)) + np.radians(stated_noise.robot_deg)
    )
    views = views_of(images.names, base_from_camera, images.stickers)
    points = seen_points(views, prior.lens, tolerance_px=4 * float(np.hypot(0.2, pose_px)), depth_mm=depth_mm)
    views = corrected_views(views, images.stickers, points)
    pose = mesh_to_robot(
        views, prior.lens, scan.targets_mm, scan.names, stated_noise=stated_noise, prior=prior, depth_mm=depth_mm
    )
    u_mm = np.array([pose.uncertainty_at(target) for target in scan.targets_mm])
    transforms = {"base_from_mesh": pose_of(pose.base_from_mesh)}
    if base_from_support is not None:
        transforms["support_from_object"] = pose_of(inverse(base_from_support) @ pose.base_from_mesh)
    record = seal_record(
        kind="mesh",
        **request.head(),
        simulated=sources.about.is_simulated,
        validity=Validity(expires=request.expires),
        transforms=transforms,
        parameters=_parameters(pose),
        fixed={"stickers_found": float(len(pose.recognised_names)), "stickers_known": float(len(scan.names))},
        covariance=rows_of(pose.covariance),
        noise=_noise(pose, stated_noise),
        images=tuple(
            ImageResidual(name=name, corners=used_count, rejected=rejected_count, rms_px=rms_px)
            for name, (used_count, rejected_count, rms_px) in zip(images.names, pose.residuals_of, strict=True)
        ),
        limits=against_limits(MESH, request.limits, _figures(pose, scan, u_mm)),
        remarks=(*_remarks(pose), *(() if arm is None else (_of_the_arm(arm),))),
        inputs=tuple(Input(name=name, sha256=digest) for name, digest in (*sources.inputs, *scan.inputs)),
    )
    camera_from_mesh = inverses(base_from_camera[images.shown_number]) @ pose.base_from_mesh
    return MeshFound(record, pose, images, camera_from_mesh, prior.lens, scan, u_mm)


def _sigma_px(images: StickerImages) -> float:
    """Return the typical noise of a sticker's centre along one axis, from the fits of their rims."""
    variances = [
        np.trace(sticker.covariance) / 2 for image_stickers in images.stickers for sticker in image_stickers
    ]
    return max(float(np.sqrt(np.median(variances))), _LEAST_SIGMA_PX)


def outline_px(result: MeshFound, mesh: Path) -> Floats:
    """Return the ends [n, 2, 2] (px) of the mesh's contours. A contour is an edge between a triangle that faces
    the shown image's camera and one that does not."""
    import trimesh

    whole = trimesh.load_mesh(mesh, process=False)
    coarse = simplified_mesh(np.asarray(whole.vertices), np.asarray(whole.faces), _MOST_FACES)
    coarse_mesh = trimesh.Trimesh(*coarse, process=False)
    eye_mm = inverse(result.camera_from_mesh)[:3, 3]
    corners = np.asarray(coarse_mesh.triangles)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces_eye = np.einsum("ij,ij->i", normals, eye_mm - corners[:, 0]) > 0
    face, neighbour = np.asarray(coarse_mesh.face_adjacency).T
    edges = np.asarray(coarse_mesh.face_adjacency_edges)[faces_eye[face] != faces_eye[neighbour]]
    ends = np.asarray(coarse_mesh.vertices, dtype=np.float64)[edges.reshape(-1)]
    return projected_pixels(result, ends).reshape(-1, 2, 2)


def projected_pixels(result: MeshFound, mesh_mm: Floats) -> Floats:
    """Return pixels [n, 2] of points [n, 3] of the mesh in the shown image; NaN for points behind the camera."""
    in_camera = mesh_mm @ result.camera_from_mesh[:3, :3].T + result.camera_from_mesh[:3, 3]
    pixels = np.full((len(mesh_mm), 2), np.nan)
    before = in_camera[:, 2] > 1.0
    pixels[before] = optics.project(in_camera[before], result.lens.vector()).pixels
    return pixels


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


def _noise(pose: MeshPose, stated_noise: Stated) -> tuple[Noise, ...]:
    stated_sigmas = {
        STICKERS: (stated_noise.sticker_px, "px"),
        POSITION: (stated_noise.robot_mm, "mm"),
        ORIENTATION: (stated_noise.robot_deg, "deg"),
    }
    return tuple(
        Noise(
            name=name,
            unit=unit,
            stated=sigma,
            found=sigma * pose.noise[name],
            redundancy=float(pose.redundancy[name]),
        )
        for name, (sigma, unit) in stated_sigmas.items()
    )


def _figures(pose: MeshPose, scan: Scan, u_mm: Floats) -> dict[str, float]:
    """Return the figures that `acceptance.MESH` limits."""
    return {
        "place_mm": float(u_mm.max()),
        "missing": 1 - len(pose.recognised_names) / len(scan.names),
        "residual_px": pose.residual_px,
        "robot_ratio": float(max(pose.noise[POSITION], pose.noise[ORIENTATION])),
    }


def _remarks(pose: MeshPose) -> tuple[str, ...]:
    remarks = [
        f"points in space differ from the scanner's table by {pose.point_rms_mm:.3f} mm (rms) before the "
        "adjustment"
    ]
    if pose.missing:
        remarks.append(f"{len(pose.missing)} stickers of the table were not found: {', '.join(pose.missing[:20])}")
    if pose.false_points:
        remarks.append(f"{pose.false_points} detected points are not in the table")
    return tuple(remarks)


def _of_the_arm(arm: CalibratedArm) -> str:
    zeros = ", ".join(f"A{axis} {zero:+.4f}" for axis, zero in enumerate(arm.zeros_deg[1:], start=2))
    return (
        f"poses are corrected by the axis zeros of the hand-eye record ({zeros} deg); use these zeros with this "
        "mesh"
    )
