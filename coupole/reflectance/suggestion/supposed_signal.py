"""The signal of parts of an object's surface in a cell, and its noise, by the records in force.

The power of each LED comes from the record `led-power`, and the noise from the record `response`. Shadows of the
object, the arm and the tool come from `coupole.motion.occlusion`. Not included are inter-reflection, glare, errors
of the mesh, and errors of the records other than the LEDs' own power.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.frames import channels_of
from coupole.calibration.light.irradiance import Emission, irradiance_per_flux
from coupole.calibration.record import Record
from coupole.errors import InputError
from coupole.geometry import apply, inverse
from coupole.kernels import kernel
from coupole.motion.occlusion import REACHED, Occlusion, Occlusions, Sight, sight_of
from coupole.motion.patches import Patches
from coupole.plan.rig import Rig, Sensor
from coupole.preflight.framing import depth_of_field_mm
from coupole.preflight.job import Job
from coupole.reflectance.extraction.measured_run import Powers, emission_of, read_powers, u_signal_of
from coupole.reflectance.extraction.radiance import RANGE_LEFT_OUT
from coupole.reflectance.ggx import lobe
from coupole.reflectance.suggestion.supposed_materials import SupposedMaterial
from coupole.reflectance.triangle_fit import between, towards

Floats = NDArray[np.float64]

LEAST_COSINE = 0.1
"""Least cosine between view and normal, as in the extraction."""


@dataclass(frozen=True)
class CameraNoise:
    """Variance of a pixel at a signal of s DN above black, for each channel: in_dark + gain s."""

    in_dark_dn2: Floats
    """[channels]"""
    gain_dn: Floats
    """[channels] DN per electron."""
    least_dn: float
    """Signal above black below which a mean is not used."""
    most_dn: float
    """Signal above black from which on a pixel is not used."""
    channel_share: Floats
    """[channels] share of the pixels that have this colour."""

    def relative_variances(
        self, signal_dn_per_s: Floats, channel_pixels: Floats, exposures_us: Sequence[int]
    ) -> Floats:
        """[..., channels] relative variances, from noise, of triangles' mean signals. They use all exposures in
        which a signal is neither too dark nor saturated, and are infinite without such an exposure.
        `channel_pixels` [..., channels] is the number of a triangle's pixels of each channel."""
        precision = np.zeros(signal_dn_per_s.shape)
        for exposure_us in exposures_us:
            signal_dn = signal_dn_per_s * exposure_us * 1e-6
            is_used = (signal_dn > self.least_dn) & (signal_dn < self.most_dn)
            electrons_weight = signal_dn**2 / (self.in_dark_dn2 + self.gain_dn * signal_dn)
            precision += np.where(is_used, electrons_weight, 0.0)
        precision *= channel_pixels
        with np.errstate(divide="ignore"):
            variances: Floats = 1.0 / precision
        return variances

    def drawn_pixels(self, pixels: Floats, random: np.random.Generator) -> NDArray[np.int64]:
        """[n, channels] pixels of each channel on triangles that cover `pixels` [n] on average. A triangle covers
        whole pixels, and the pixels beside each other that complete no tile of the Bayer pattern lack channels: a
        triangle of one pixel has one channel. They are drawn from a tile without replacement."""
        tile = np.rint(self.channel_share / self.channel_share.min()).astype(np.int64)
        tiles, rest = np.divmod(np.floor(pixels + random.random(len(pixels))).astype(np.int64), tile.sum())
        channel_counts: NDArray[np.int64] = tiles[:, None] * tile
        for count in range(1, int(tile.sum())):
            rows = np.flatnonzero(rest == count)
            channel_counts[rows] += random.multivariate_hypergeometric(tile, count, len(rows))
        return channel_counts


@dataclass(frozen=True)
class Surface:
    """An object's surface in a cell, in n parts, each with one of the mesh's triangles."""

    points_mm: Floats
    """[n, 3] support frame."""
    normals: Floats
    """[n, 3] unit."""
    triangle_areas_mm2: Floats
    """[n] area of the triangle in each part."""
    triangles: Floats
    """[n] number of triangles that each part represents."""
    leds_mm: Floats
    """[leds, 3] support frame, in the order of the dome's table."""
    signal_upright: Floats
    """[n, leds, channels] DN/s above black for a reflectance of 1/sr and perpendicular incidence."""
    u_own: Floats
    """[leds] relative standard uncertainty of an LED's own power."""
    u_shared: float
    """Relative standard uncertainty that all LEDs share."""
    u_led_mm: float
    """Standard uncertainty of each coordinate of an LED's centre."""
    noise: CameraNoise
    u_pose_mm: float = 0.0
    """Standard uncertainty of a view's place on the object, in each of the two directions across the line of
    sight."""

    @cached_property
    def signal_per_f(self) -> Floats:
        """[n, leds, channels] DN/s above black for a reflectance of 1/sr, including the cosine of incidence."""
        towards_leds = self.leds_mm[None] - self.points_mm[:, None]
        towards_leds /= np.linalg.norm(towards_leds, axis=2)[:, :, None]
        cosines = np.maximum(np.einsum("nlk,nk->nl", towards_leds, self.normals), 0.0)
        signals: Floats = self.signal_upright * cosines[:, :, None]
        return signals


@dataclass(frozen=True)
class SeenParts:
    """Parts of the surface as one view sees them."""

    camera_mm: Floats
    """[3] support frame."""
    pixels: Floats
    """[n] pixels of a triangle, in all channels; 0 if the view does not see the part."""
    is_lit: NDArray[np.bool_]
    """[n, leds]"""

    @property
    def parts(self) -> NDArray[np.int64]:
        """Numbers of the parts that the view sees, in rising order."""
        return np.flatnonzero(self.pixels > 0.0)


class SupposedCell:
    """A job's cell, which computes what views would see. Raises InputError if a record that it needs is not
    named."""

    def __init__(self, job: Job) -> None:
        self._job, self.rig = job, job.cell.rig
        records = {item.record.kind: item for item in job.calibrations or ()}
        if missing := [kind for kind in ("led-power", "response", "leds") if kind not in records]:
            raise InputError(
                f"expected calibration records of the kinds led-power, response and leds, and none is of the kind "
                f"{missing[0]}: name the cell's records with --calibrations, or under `calibrations:` of the rig"
            )
        self._power_path, self._power = records["led-power"].path, records["led-power"].record
        self._response, self._leds = records["response"].record, records["leds"].record
        self._hand_eye = records["hand-eye"].record if "hand-eye" in records else None
        self._u_signal = u_signal_of({kind: item.path for kind, item in records.items()})

    @cached_property
    def occlusions(self) -> Occlusions:
        return self._job.motion.occlusions

    @cached_property
    def surface(self) -> Surface:
        """Return the parts, and the light that reaches them without shadows."""
        patches, leds = self.occlusions.patches, self._job.cell.leds
        support_from_base = inverse(self.rig.support.base_from_support.matrix())
        leds_mm = apply(support_from_base, leds.positions_mm)
        axes = leds.normals @ support_from_base[:3, :3].T
        channels, channel_share = _channels(self.rig.sensor)
        powers: Powers = read_powers(self._power_path, channels).of(leds.ids)
        per_flux = upright_per_flux(patches.points_mm, leds_mm, axes, emission_of(self._power))
        triangles, areas_mm2 = triangles_of_parts(patches, self._job.shape.corners_mm)
        return Surface(
            patches.points_mm,
            patches.normals,
            areas_mm2,
            triangles,
            leds_mm,
            per_flux[:, :, None] * np.nan_to_num(powers.power)[None],
            np.nan_to_num(powers.u_own.mean(axis=1)),
            float(np.nanmean(np.hypot(powers.u_shared, self._u_signal))),
            self._leds.value("led_centre_median_u_mm"),
            _camera_noise(self.rig.sensor, self._response, channels, channel_share),
            _pose_noise_mm(self._hand_eye, self.rig.lens.focus_distance_mm),
        )

    def seen_by(self, joints_deg: Floats, support_from_camera: Floats) -> SeenParts:
        """Return the parts that a view sees with the arm in this posture."""
        return seen_by(self.occlusions, self.surface, joints_deg, support_from_camera)


def seen_by(
    occlusions: Occlusions, surface: Surface, joints_deg: Floats, support_from_camera: Floats
) -> SeenParts:
    """Return the parts of a surface that a view sees with the arm in this posture."""
    occlusion: Occlusion = occlusions.at(joints_deg)
    pixels = _pixels(surface, occlusions.rig, sight_of(occlusions.rig, support_from_camera))
    return SeenParts(
        support_from_camera[:3, 3], np.where(occlusion.is_seen, pixels, 0.0), occlusion.codes == REACHED
    )


def _pixels(surface: Surface, rig: Rig, sight: Sight) -> Floats:
    """[n] pixels that a triangle of each part covers; 0 if it is out of focus, or seen too obliquely."""
    ways = sight.support_from_camera[:3, 3] - surface.points_mm
    distance_mm = np.linalg.norm(ways, axis=1)
    depth_mm = -ways @ sight.support_from_camera[:3, 2]
    cosine = np.sum(ways * surface.normals, axis=1) / distance_mm
    near_mm, far_mm = depth_of_field_mm(rig.lens, rig.sensor.pixel_pitch_um)
    is_used = (cosine > LEAST_COSINE) & (depth_mm >= near_mm) & (depth_mm <= far_mm)
    scale = sight.focal_px**2 * distance_mm / np.maximum(depth_mm, 1.0) ** 3
    pixels: Floats = np.where(is_used, surface.triangle_areas_mm2 * cosine * scale, 0.0)
    return pixels


def triangles_of_parts(patches: Patches, corners_mm: Floats) -> tuple[Floats, Floats]:
    """[n] number of triangles of each part, and their mean area, mm^2. A triangle that lies in several parts
    counts in each by its share."""
    across = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    areas_mm2 = 0.5 * np.linalg.norm(across, axis=1)
    share = 1.0 / np.bincount(patches.piece_triangle, minlength=len(corners_mm))[patches.piece_triangle]
    count = len(patches.points_mm)
    triangles: Floats = np.bincount(patches.piece_patch, share, count).astype(np.float64)
    sums_mm2 = np.bincount(patches.piece_patch, share * areas_mm2[patches.piece_triangle], count)
    return triangles, sums_mm2 / triangles


def upright_per_flux(points_mm: Floats, leds_mm: Floats, axes: Floats, emission: Emission) -> Floats:
    """[points, leds] irradiance per flux, m^-2, of surfaces at points [points, 3] that face each LED."""
    rows = []
    for point_mm in points_mm:
        towards = leds_mm - point_mm
        facing = towards / np.linalg.norm(towards, axis=1)[:, None]
        rows.append(irradiance_per_flux(point_mm, facing, leds_mm, axes, emission=emission))
    return np.stack(rows)


def _pose_noise_mm(hand_eye: Record | None, distance_mm: float) -> float:
    """Return the robot's noise, by the hand-eye record, at the object: of position, and of orientation at its
    distance."""
    if hand_eye is None:
        return 0.0
    noise = {line.name: line.found for line in hand_eye.noise}
    return math.hypot(noise["robot position"], math.radians(noise["robot orientation"]) * distance_mm)


def _channels(sensor: Sensor) -> tuple[Sequence[str], Floats]:
    """Return the names of the channels, as in records, and each channel's share of the pixels."""
    channels = channels_of(sensor.bayer_pattern)
    shares = {"R": 0.25, "G": 0.5, "B": 0.25}
    return channels, np.array([shares[channel] for channel in channels] if len(channels) > 1 else [1.0])


def _camera_noise(sensor: Sensor, response: Record, channels: Sequence[str], channel_share: Floats) -> CameraNoise:
    range_dn = sensor.white_dn - sensor.black_dn
    left_out_dn = RANGE_LEFT_OUT * range_dn
    return CameraNoise(
        np.array([response.value(f"dark_variance_dn2.{channel}") for channel in channels]),
        np.array([response.value(f"gain_dn_per_e.{channel}") for channel in channels]),
        left_out_dn,
        range_dn - left_out_dn,
        channel_share,
    )


def reflectances(
    surface: Surface, view: SeenParts, material: SupposedMaterial, leds_mm: Floats, parts: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Return two arrays [parts, leds] for some parts of the surface and LEDs at `leds_mm` [leds, 3]: the
    reflectance, 1/sr, and the cosine of incidence. They are NaN where no light reaches the visible part.

    Like a real highlight, the reflectance grows towards grazing angles, here by Schlick's Fresnel term (1994).
    """
    f, cosines = np.full((2, len(parts), len(leds_mm)), np.nan)
    _fill_reflectances(
        surface.points_mm[parts], surface.normals[parts], view.camera_mm, view.pixels[parts], leds_mm,
        view.is_lit[parts], (material.kd, material.ks, material.alpha), f, cosines,
    )  # fmt: skip
    return f, cosines


def signal_quantile(
    surface: Surface, views: Sequence[SeenParts], material: SupposedMaterial, quantile: float
) -> float:
    """Return a quantile of the samples' signals, DN/s in the most sensitive channel; NaN without samples."""
    per_f = surface.signal_per_f.max(axis=2)
    signals = [np.zeros(0)]
    for view in views:
        parts = view.parts
        values = per_f[parts] * reflectances(surface, view, material, surface.leds_mm, parts)[0]
        signals.append(values[np.isfinite(values)])
    all_signals = np.concatenate(signals)
    return float(np.quantile(all_signals, quantile)) if len(all_signals) else np.nan


@kernel
def _reflectance(nl, nv, nh, vh, material):  # type: ignore[no-untyped-def]
    """Return the reflectance, 1/sr, for cosines of the normal with light, view and half vector, and of view with
    half vector."""
    kd, ks, alpha = material
    return kd + (ks + (1.0 - ks) * (1.0 - vh) ** 5) * lobe(nl, nv, nh, alpha)[0]


@kernel
def _fill_reflectances(points_mm, normals, camera_mm, pixels, leds_mm, is_lit, material, f, cosines):  # type: ignore[no-untyped-def]
    light, view, half = np.empty(3), np.empty(3), np.empty(3)
    for part in range(len(points_mm)):
        if pixels[part] <= 0.0:
            continue
        normal = normals[part]
        towards(points_mm[part], camera_mm, view)
        nv = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
        for led in range(len(leds_mm)):
            towards(points_mm[part], leds_mm[led], light)
            nl = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
            if nl <= 0.0 or not is_lit[part, led]:
                continue
            between(light, view, half)
            nh = normal[0] * half[0] + normal[1] * half[1] + normal[2] * half[2]
            vh = view[0] * half[0] + view[1] * half[1] + view[2] * half[2]
            f[part, led] = _reflectance(nl, nv, nh, vh, material)
            cosines[part, led] = nl


def seen_samples(
    points_mm: Floats,
    normals: Floats,
    camera_mm: Floats,
    leds_mm: Floats,
    is_lit: NDArray[np.bool_],
    material: SupposedMaterial,
) -> Floats:
    """[n, leds] reflectance times cosine of incidence, 1/sr: the mean over the normals [n, places, 3] that pixels
    at points [n, 3] see. NaN where no light reaches a point (`is_lit` [n, leds])."""
    samples = np.full(is_lit.shape, np.nan)
    _fill_samples(
        points_mm, normals, camera_mm, leds_mm, is_lit, (material.kd, material.ks, material.alpha), samples
    )
    return samples


@kernel
def _fill_samples(points_mm, normals, camera_mm, leds_mm, is_lit, material, samples):  # type: ignore[no-untyped-def]
    light, view, half = np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(points_mm)):
        towards(points_mm[n], camera_mm, view)
        for led in range(len(leds_mm)):
            if not is_lit[n, led]:
                continue
            towards(points_mm[n], leds_mm[led], light)
            between(light, view, half)
            vh = view[0] * half[0] + view[1] * half[1] + view[2] * half[2]
            total = 0.0
            for place in range(normals.shape[1]):
                normal = normals[n, place]
                nl = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
                nv = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
                if nl > 0.0 and nv > 0.0:
                    nh = normal[0] * half[0] + normal[1] * half[1] + normal[2] * half[2]
                    total += _reflectance(nl, nv, nh, vh, material) * nl
            samples[n, led] = total / normals.shape[1]
