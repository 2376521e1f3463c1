"""The world's photographer: renders what the true camera pose sees under the lights that shone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform, inverse
from sim.camera_body import Exposed
from sim.config import WHITE_SHARE, CameraConfig, MeshConfig, SceneConfig
from sim.render.embree import Obstacles
from sim.render.emitter import LED_SIDE_MM, irradiance, square
from sim.render.lens import Lens
from sim.render.radiance import led_radiance, panel_radiance
from sim.render.shadows import Shadows
from sim.render.view import View, Viewer
from sim.scene import Leds, build_scene, load_surface, read_leds, support_disk
from sim.sensor import SensorModel, expose
from sim.surface import Material, Surface
from sim.things import Thing, placed

_POSE_TOLERANCE = 1e-6
_SHADOW_BYTES = 512 << 20
_RADIANCE_BYTES = 256 << 20
_WARM_UP_HEIGHT_MM = 1000.0


class Photographer:
    """Holds the scene, its shadows and the last pose's view; `render` is called from one worker thread."""

    def __init__(
        self, scene: SceneConfig, camera: CameraConfig, *, seed: int, things: tuple[Thing, ...] = ()
    ) -> None:
        base_from_support = np.array(scene.base_from_support)
        surfaces = [(support_disk(scene.support_diameter_mm), base_from_support)]
        surfaces += [
            (_surface(mesh), base_from_support @ np.array(mesh.support_from_object)) for mesh in scene.objects
        ]
        surfaces += placed(things, base_from_support)
        self._scene = build_scene(surfaces)
        self.leds: Leds = read_leds(scene.leds)
        self._emission = scene.emission
        self._emitters = [
            square(position, normal, side_mm=LED_SIDE_MM, flux_lm=float(flux))
            for position, normal, flux in zip(
                self.leds.positions_mm, self.leds.normals, self.leds.flux_lm, strict=True
            )
        ]
        self._row_of_led = {int(led): row for row, led in enumerate(self.leds.ids)}
        lens = Lens.focused(
            camera.width_px,
            camera.height_px,
            pixel_pitch_um=camera.pixel_pitch_um,
            focal_length_mm=camera.focal_length_mm,
            focus_distance_mm=camera.focus_distance_mm,
            distortion=camera.distortion,
        )
        self._viewer = Viewer(self._scene, lens, camera.samples_per_side)
        self._shadows = Shadows(Obstacles(self._scene.corners_mm), self.leds.positions_mm, _SHADOW_BYTES)
        self.sensor = SensorModel(camera.bayer_pattern, camera.bit_depth, camera.black_dn, seed=seed)
        self.flange_from_camera: Transform = np.array(camera.flange_from_camera)
        self.reference_lux = self._reference_lux(base_from_support)
        white_e = WHITE_SHARE * self.sensor.full_scale_e
        self._electrons = white_e * np.pi / (self.reference_lux * camera.nominal_exposure_us * 1e-6)
        self._view: View | None = None
        self._places = np.empty(0, np.int32)
        self._base_from_camera: Transform = np.zeros((4, 4))
        self._radiance: dict[int, NDArray[np.float32]] = {}
        self.flicker: dict[int, float] = {}
        """Relative rms of LEDs whose flux varies from flash to flash."""
        self._random = np.random.default_rng(seed)
        self._warm_up(base_from_support)

    def _warm_up(self, base_from_support: Transform) -> None:
        """Compile by looking down at the support under one LED, before anybody waits for a frame."""
        support_from_camera = np.diag([1.0, -1.0, -1.0, 1.0])
        support_from_camera[2, 3] = _WARM_UP_HEIGHT_MM
        view = self._look_from(base_from_support @ support_from_camera @ inverse(self.flange_from_camera))
        self._led(view, int(self.leds.ids[0]))

    def _reference_lux(self, base_from_support: Transform) -> float:
        """Median over the LEDs of the irradiance on a horizontal white target at the support's centre."""
        centre, up = base_from_support[:3, 3], base_from_support[:3, 2]
        return float(np.median([irradiance(emitter, centre, up)[0] for emitter in self._emitters]))

    def render(self, out: NDArray[np.uint16], exposed: Exposed) -> None:
        """Fill `out` [h, w] with the frame of one exposure, DN."""
        view = self._look_from(exposed.base_from_flange)
        lights = [
            (self._led(view, led), self._seconds(led, lit_s)) for led, lit_s in exposed.seconds_of_led.items()
        ]
        lit = panel_radiance(view, self._scene.materials, self.reference_lux) if exposed.panels else None
        lights += [(lit, exposed.exposure_s) for _ in exposed.panels if lit is not None]
        if len(lights) == 1:
            ((radiance, seconds),) = lights
        else:
            radiance, seconds = np.zeros((max(1, len(view.sides)), 3), np.float32), 1.0
            for each, lit_s in lights:
                radiance[: len(view.sides)] += each * np.float32(lit_s)
        expose(
            out,
            view.triangle,
            radiance,
            self._viewer.falloff,
            model=self.sensor,
            electrons_per_radiance=self._electrons * seconds,
            frame=exposed.number,
            exposure_s=exposed.exposure_s,
            gain=exposed.gain,
        )

    def _seconds(self, led: int, lit_s: float) -> float:
        """How long an LED shone, weighted by its flicker."""
        return lit_s * (1.0 + self.flicker.get(led, 0.0) * float(self._random.standard_normal()))

    def _look_from(self, base_from_flange: Transform) -> View:
        """Rasterise from a flange pose, unless it is the last one still."""
        base_from_camera = base_from_flange @ self.flange_from_camera
        if self._view is None or np.abs(base_from_camera - self._base_from_camera).max() > _POSE_TOLERANCE:
            self._view = self._viewer.look(base_from_camera)
            self._places = self._shadows.places(self._view.sides)
            self._base_from_camera = base_from_camera
            self._radiance.clear()
        return self._view

    def _led(self, view: View, led: int) -> NDArray[np.float32]:
        """Radiance of the view's triangles under one LED; what fits into memory is computed once per pose."""
        if led in self._radiance:
            return self._radiance[led]
        row = self._row_of_led[led]
        radiance = led_radiance(
            view,
            self._scene.materials,
            self._emitters[row],
            self._emission,
            self._places,
            self._shadows.reached(row),
        )
        if (len(self._radiance) + 1) * radiance.nbytes <= _RADIANCE_BYTES:
            self._radiance[led] = radiance
        return radiance


def _surface(mesh: MeshConfig) -> Surface:
    given = mesh.material
    material = Material(mesh.path.stem, given.diffuse, given.f0, given.roughness) if given else None
    return load_surface(mesh.path, mesh.unit, material)
