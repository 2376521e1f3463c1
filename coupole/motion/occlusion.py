"""Occlusion: which LEDs light which parts of the object in a view, and which bodies hide the other LEDs.

Rays are traced from the point of each patch of the object's surface to the LEDs (also points). They are tested
against the object's own mesh, which is the same for all views, and against the capsules of arm and tool in the
view's posture. Capsules enclose the real bodies, so occlusion is overestimated rather than underestimated.
Coordinates are in the support frame, in mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.geometry import Transform, apply, inverse
from coupole.joint_chain import FLANGE
from coupole.kernels import kernel
from coupole.kinematics import link_frames
from coupole.motion.bodies import Capsule, capsules_of
from coupole.motion.itinerary import undescribed_arm_error
from coupole.motion.patches import PATCHES, Patches, patches_at, patches_of
from coupole.motion.remembered import Remembered
from coupole.plan.arm_description import ArmDescription
from coupole.plan.led_table import LedTable
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import described_arm

REACHED, AWAY, BY_OBJECT, BY_ARM, BY_TOOL = range(5)
"""Codes of a patch and an LED. AWAY: the LED is below the patch's horizon, or the patch is behind the LED. If
several codes apply, the smallest one after REACHED is given; REACHED means that none applies."""
RAY_START_MM = 0.1
"""Distance of the start of a ray from the surface, along the patch's normal. So a patch does not hide itself by
rounding (Embree computes with 24 bits: 0.00006 mm at 1 m). Steps of the surface that are lower than this cast no
shadow."""
_OBJECTS: Remembered[tuple[Patches, NDArray[np.uint8]]] = Remembered(most=2)
"""Patches of objects, and their codes."""


@dataclass(frozen=True)
class Sight:
    """A camera as a pinhole. Its axis passes through the centre of the image."""

    support_from_camera: Transform
    focal_px: float
    width_px: int
    height_px: int

    def project(self, points_mm: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return column and row [..., 2] in pixels and depth [...] in mm of points [..., 3] of the support frame.

        The first pixel's centre is (0, 0). Pixels are meaningless where the depth is not positive.
        """
        in_camera = apply(inverse(self.support_from_camera), points_mm)
        depth_mm = in_camera[..., 2]
        scale = self.focal_px / np.where(depth_mm > 0, depth_mm, np.inf)
        middle = (np.array((self.width_px, self.height_px)) - 1) / 2
        return in_camera[..., :2] * scale[..., None] + middle, depth_mm


@dataclass(frozen=True)
class Occlusion:
    """LEDs that light each patch in one view: plain arrays, LEDs in the order of the dome's table."""

    codes: NDArray[np.uint8]
    """[patches, leds] REACHED, AWAY, BY_OBJECT, BY_ARM or BY_TOOL."""
    is_seen: NDArray[np.bool_]
    """[patches] True where the camera sees the patch's point."""
    areas_mm2: NDArray[np.float64]
    """[patches] areas, which are the weights of the patches."""

    def share(self, code: int = REACHED) -> NDArray[np.float64]:
        """Return [leds] the share of the surface in the camera's view that has this code; 0 if the camera sees
        nothing of the surface."""
        weights = np.where(self.is_seen, self.areas_mm2, 0.0)
        share: NDArray[np.float64] = weights @ (self.codes == code) / max(weights.sum(), 1e-300)
        return share

    def occluded_leds(self) -> NDArray[np.bool_]:
        """Return [leds], True where an LED reaches no patch that the camera sees; all False if the camera sees no
        patch.

        Parts smaller than a patch may still be lit.
        """
        reaches: NDArray[np.bool_] = (self.codes[self.is_seen] == REACHED).any(axis=0)
        return ~reaches & self.is_seen.any()

    def arrays(self, patches: Patches) -> dict[str, NDArray[np.generic]]:
        """Return arrays by name, which are stored with a view's frames and can be read without this module.

        `codes` is uint8 [patches, leds], and `seen` is [patches], with the meanings above. The patches themselves
        are given in the support frame: `points_mm` and outward `normals`, float32 [patches, 3], and `areas_mm2`,
        float32 [patches].
        """
        return {
            "codes": self.codes,
            "seen": self.is_seen,
            "points_mm": patches.points_mm.astype(np.float32),
            "normals": patches.normals.astype(np.float32),
            "areas_mm2": patches.areas_mm2.astype(np.float32),
        }


@dataclass(frozen=True)
class Occlusions:
    """Data common to all views, and the rig for the other data."""

    rig: Rig
    arm: ArmDescription
    patches: Patches
    mesh: Any
    """The object's mesh, prepared for rays (`ray_mesh`)."""
    leds_mm: NDArray[np.float64]
    """[leds, 3] places of the LEDs in the support frame."""
    object_codes: NDArray[np.uint8]
    """[patches, leds] REACHED, AWAY or BY_OBJECT, of the object alone."""

    def at(self, joints_deg: ArrayLike) -> Occlusion:
        """Return the occlusion in a view with the arm at joint angles [6].

        The tool is assumed not to obstruct the camera's view.
        """
        support_from_base = inverse(self.rig.support.base_from_support.matrix())
        frames = support_from_base @ link_frames(self.arm.arm, joints_deg)
        links = capsules_of(self.arm)
        tool = [Capsule(body.name, FLANGE, body.from_mm, body.to_mm, body.radius_mm) for body in self.rig.tool]
        axes_mm, radii_mm = capsule_axes((*links, *tool), frames)
        by = hidden_by(ray_starts(self.patches), self.leds_mm, axes_mm, radii_mm, self.object_codes == REACHED)
        codes = self.object_codes.copy()
        codes[(by >= 0) & (by < len(links))] = BY_ARM
        codes[by >= len(links)] = BY_TOOL
        arm = slice(len(links))
        visible = self._visible_patches(
            sight_of(self.rig, frames[FLANGE] @ self.rig.flange_from_camera.matrix()), axes_mm[arm], radii_mm[arm]
        )
        return Occlusion(codes, visible, self.patches.areas_mm2)

    def _visible_patches(
        self, sight: Sight, axes_mm: NDArray[np.float64], radii_mm: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return [patches], True where a camera sees the patch: inside the image, facing the camera,
        unobstructed."""
        eye_mm = sight.support_from_camera[:3, 3]
        starts_mm = ray_starts(self.patches)
        pixels, depth_mm = sight.project(starts_mm)
        inside = (pixels >= -0.5) & (pixels <= np.array((sight.width_px, sight.height_px)) - 0.5)
        visible = (depth_mm > 0) & inside.all(axis=1)
        visible &= np.einsum("pk,pk->p", eye_mm - starts_mm, self.patches.normals) > 0
        visible &= hidden_by(starts_mm, eye_mm[None], axes_mm, radii_mm, visible[:, None])[:, 0] < 0
        candidates = np.flatnonzero(visible)
        visible[candidates] = ~blocked_segments(
            self.mesh, starts_mm[candidates], np.tile(eye_mm, (len(candidates), 1))
        )
        return visible


def occlusions_of(
    rig: Rig, leds: LedTable, corners_mm: NDArray[np.float64], targets_mm: ArrayLike, count: int = PATCHES
) -> Occlusions:
    """Return the part of an object's occlusion that does not depend on the arm.

    `corners_mm` [triangles, 3, 3] is the object's mesh in the support frame. If there are no triangles,
    `targets_mm` [n, 3] replace it. Raises InputError if the rig's arm has no description.
    """
    arm = described_arm(rig)
    if arm is None:
        raise undescribed_arm_error(rig)
    targets = np.asarray(targets_mm, dtype=np.float64)
    support_from_base = inverse(rig.support.base_from_support.matrix())
    leds_mm = apply(support_from_base, leds.positions_mm)
    led_normals = leds.normals @ support_from_base[:3, :3].T
    mesh = ray_mesh(corners_mm)

    def patches_and_codes() -> tuple[Patches, NDArray[np.uint8]]:
        patches = patches_of(corners_mm, count) if len(corners_mm) else patches_at(targets)
        return patches, own_codes(patches, mesh, leds_mm, led_normals)

    patches, codes = _OBJECTS.result((corners_mm, targets, leds_mm, led_normals, count), patches_and_codes)
    return Occlusions(rig, arm, patches, mesh, leds_mm, codes)


def own_codes(
    patches: Patches,
    mesh: Any,
    leds_mm: NDArray[np.float64],
    led_normals: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Return codes [patches, leds] of an object alone. The LEDs are at [leds, 3] and emit into the half-space of
    their normals."""
    starts_mm = ray_starts(patches)
    to_leds = leds_mm[None] - starts_mm[:, None]
    faces = np.einsum("plk,pk->pl", to_leds, patches.normals) > 0
    faces &= np.einsum("plk,lk->pl", to_leds, led_normals) < 0
    patch, led = np.nonzero(faces)
    codes = np.where(faces, REACHED, AWAY).astype(np.uint8)
    codes[patch, led] = np.where(blocked_segments(mesh, starts_mm[patch], leds_mm[led]), BY_OBJECT, REACHED)
    return codes


def ray_starts(patches: Patches) -> NDArray[np.float64]:
    """Return [patches, 3], the starting points of rays from the patches: RAY_START_MM above the points of the
    patches."""
    starts_mm: NDArray[np.float64] = patches.points_mm + RAY_START_MM * patches.normals
    return starts_mm


def ray_mesh(corners_mm: NDArray[np.float64]) -> Any:
    """Return a mesh [triangles, 3, 3] prepared for ray tracing (Embree); None without triangles."""
    if len(corners_mm) == 0:
        return None
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene(robust=True)  # no ray slips through between two triangles
    TriangleMesh(scene, np.ascontiguousarray(corners_mm, np.float32))
    return scene


def blocked_segments(mesh: Any, starts_mm: NDArray[np.float64], ends_mm: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return [n], True where the segment between two points [n, 3] meets a triangle of a `ray_mesh`."""
    if mesh is None or len(starts_mm) == 0:
        return np.zeros(len(starts_mm), np.bool_)
    return blocked_along(mesh, starts_mm.astype(np.float32), (ends_mm - starts_mm).astype(np.float32))


def blocked_along(mesh: Any, starts_mm: NDArray[np.float32], ways_mm: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return [n], True where the way [n, 3] from a start to its end meets a triangle of a `ray_mesh`."""
    triangles = mesh.run(starts_mm, ways_mm, dists=np.ones(len(starts_mm), np.float32), query="OCCLUDED")
    are_blocked: NDArray[np.bool_] = triangles >= 0
    return are_blocked


def capsule_axes(
    capsules: Sequence[Capsule], frames: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ends of the axes [n, 2, 3] and radii [n] of capsules. They are in the frame to which `frames` [8, 4,
    4] map the links."""
    ends = [apply(frames[c.link], (c.start_mm, c.end_mm)) for c in capsules]
    return np.array(ends), np.array([c.radius_mm for c in capsules], np.float64)


def hidden_by(
    starts_mm: NDArray[np.float64],
    ends_mm: NDArray[np.float64],
    axes_mm: NDArray[np.float64],
    radii_mm: NDArray[np.float64],
    is_asked: NDArray[np.bool_],
) -> NDArray[np.int16]:
    """Find the first capsule (axes [k, 2, 3], radii [k]) that each segment from a start [n, 3] to an end [m, 3]
    meets. The result [n, m] is -1 if a segment meets no capsule, or if `is_asked` [n, m] is False."""
    capsule_numbers = np.full(is_asked.shape, -1, np.int16)
    if len(starts_mm):
        center_mm = starts_mm.mean(axis=0)
        reach_mm = float(np.linalg.norm(starts_mm - center_mm, axis=1).max())
        _first_met(
            starts_mm,
            np.ascontiguousarray(ends_mm),
            axes_mm,
            radii_mm,
            is_asked,
            center_mm,
            reach_mm,
            capsule_numbers,
        )
    return capsule_numbers


def compile_now() -> None:
    """Compile the kernel of `hidden_by`."""
    point_mm, is_asked = np.zeros((1, 3)), np.ones((1, 1), np.bool_)
    hidden_by(point_mm, point_mm + 1.0, np.zeros((1, 2, 3)), np.ones(1), is_asked)


def sight_of(rig: Rig, support_from_camera: Transform) -> Sight:
    """Return the rig's camera at a pose. The image distance follows from the lens equation and the focus
    distance."""
    image_mm = 1 / (1 / rig.lens.focal_length_mm - 1 / rig.lens.focus_distance_mm)
    return Sight(
        support_from_camera,
        image_mm / (rig.sensor.pixel_pitch_um * 1e-3),
        rig.sensor.width_px,
        rig.sensor.height_px,
    )


@kernel
def segment_distance_mm(p, q, a, b):  # type: ignore[no-untyped-def]
    """Return the distance between the segments from p to q and from a to b, points [3] each.

    Ericson, Real-Time Collision Detection (2005), section 5.1.9: nearest points of the lines, clamped to the
    segments. For parallel lines any starting point is valid.
    """
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    wx, wy, wz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    uw, vw = ux * wx + uy * wy + uz * wz, vx * wx + vy * wy + vz * wz
    across = uu * vv - uv * uv
    s = min(1.0, max(0.0, (uv * vw - vv * uw) / across)) if across > 0.0 else 0.0
    t = (uv * s + vw) / vv if vv > 0.0 else 0.0
    if t < 0.0 or t > 1.0 or vv == 0.0:
        t = min(1.0, max(0.0, t))
        s = min(1.0, max(0.0, (uv * t - uw) / uu)) if uu > 0.0 else 0.0
    dx, dy, dz = wx + s * ux - t * vx, wy + s * uy - t * vy, wz + s * uz - t * vz
    return np.sqrt(dx * dx + dy * dy + dz * dz)


@kernel
def _first_met(starts, ends, axes, radii, is_asked, center, reach, capsule_numbers):  # type: ignore[no-untyped-def]
    """Fill `capsule_numbers` [n, m]. All segments to an end lie within `reach` of the segment that starts at
    `center`. If this segment misses a capsule by more than `reach`, the capsule is not tested for the single
    starts of segments.
    """
    near = np.empty(len(radii), np.int64)
    for j in range(len(ends)):
        count = 0
        for k in range(len(radii)):
            if segment_distance_mm(center, ends[j], axes[k, 0], axes[k, 1]) <= radii[k] + reach:
                near[count] = k
                count += 1
        for i in range(len(starts) if count else 0):
            if not is_asked[i, j]:
                continue
            for n in range(count):
                k = near[n]
                if segment_distance_mm(starts[i], ends[j], axes[k, 0], axes[k, 1]) <= radii[k]:
                    capsule_numbers[i, j] = k
                    break
