"""The world's photographer: renders what the true camera pose sees under the lights that shone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform
from sim.camera_body import Exposed
from sim.config import WHITE_SHARE, CameraConfig, SceneConfig
from sim.scene import (
    Leds,
    Pinhole,
    View,
    build_scene,
    led_radiance,
    load_mesh,
    panel_radiance,
    rasterise,
    read_leds,
)
from sim.sensor import SensorModel, expose

_POSE_TOLERANCE = 1e-6
_CACHED_LEDS = 4096


class Photographer:
    """Holds the scene and the last pose's view; `render` is called from one worker thread."""

    def __init__(self, scene: SceneConfig, camera: CameraConfig, *, seed: int) -> None:
        base_from_support = np.array(scene.base_from_support)
        objects = [
            load_mesh(m.path, m.unit) @ np.array(m.support_from_object)[:3, :3].T
            + np.array(m.support_from_object)[:3, 3]
            for m in scene.objects
        ]
        self.leds: Leds = read_leds(scene.leds)
        self._emission = scene.emission
        self._scene = build_scene(base_from_support, scene.support_diameter_mm, objects)
        self._pinhole = Pinhole.from_lens(
            camera.width_px,
            camera.height_px,
            camera.pixel_pitch_um,
            camera.focal_length_mm,
            camera.focus_distance_mm,
        )
        self.sensor = SensorModel(camera.bayer_pattern, camera.bit_depth, camera.black_dn, seed=seed)
        self.flange_from_camera: Transform = np.array(camera.flange_from_camera)
        self._row_of_led = {int(led): row for row, led in enumerate(self.leds.ids)}
        self.reference_lux = self._reference_lux(base_from_support)
        white_e = WHITE_SHARE * self.sensor.full_well_e
        self._electrons = white_e * np.pi / (self.reference_lux * camera.nominal_exposure_us * 1e-6)
        self._view: View | None = None
        self._base_from_camera: Transform = np.zeros((4, 4))
        self._radiance: dict[int, NDArray[np.float32]] = {}
        self.flicker: dict[int, float] = {}
        """Relative rms of LEDs whose flux varies from flash to flash."""
        self._random = np.random.default_rng(seed)

    def _reference_lux(self, base_from_support: Transform) -> float:
        """Median over the LEDs of the irradiance on a horizontal white target at the support's centre."""
        to_light = self.leds.positions_mm - base_from_support[:3, 3]
        distance_mm = np.linalg.norm(to_light, axis=1)
        cos_emitter = -np.einsum("ij,ij->i", to_light, self.leds.normals) / distance_mm
        cos_receiver = to_light @ base_from_support[:3, 2] / distance_mm
        lux = self.leds.flux_lm / np.pi / (distance_mm * 1e-3) ** 2 * np.clip(cos_emitter, 0, 1)
        return float(np.median(lux * np.clip(cos_receiver, 0, 1)))

    def render(self, out: NDArray[np.uint16], exposed: Exposed) -> None:
        """Fill `out` [h, w] with the frame of one exposure, DN."""
        view = self._look_from(exposed.base_from_flange)
        radiance = np.zeros((max(1, len(view.seen)), 3), np.float32)
        for led, seconds in exposed.seconds_of_led.items():
            flux = 1.0 + self.flicker.get(led, 0.0) * float(self._random.standard_normal())
            radiance[: len(view.seen)] += self._led(view, led) * np.float32(seconds * flux)
        for _ in exposed.panels:
            lit = panel_radiance(self._scene, view, self.reference_lux)
            radiance[: len(view.seen)] += lit * np.float32(exposed.exposure_s)
        expose(
            out,
            view.triangle,
            radiance,
            view.falloff,
            model=self.sensor,
            electrons_per_radiance=self._electrons * exposed.gain,
            frame=exposed.number,
        )

    def _look_from(self, base_from_flange: Transform) -> View:
        """Rasterise from a flange pose, unless it is the last one still."""
        base_from_camera = base_from_flange @ self.flange_from_camera
        if self._view is None or np.abs(base_from_camera - self._base_from_camera).max() > _POSE_TOLERANCE:
            self._view = rasterise(self._scene, self._pinhole, base_from_camera)
            self._base_from_camera = base_from_camera
            self._radiance.clear()
        return self._view

    def _led(self, view: View, led: int) -> NDArray[np.float32]:
        if led not in self._radiance:
            if len(self._radiance) >= _CACHED_LEDS:
                self._radiance.clear()
            row = self._row_of_led[led]
            self._radiance[led] = led_radiance(self._scene, view, self.leds, row, self._emission)
        return self._radiance[led]
