"""Renders the simulated camera's frames: the scene from the true camera pose, under the lights that were on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.render.led_squares import Leds, read_leds
from coupole.appearance.spectra import light
from coupole.geometry import Transform, inverse
from sim.devices.arm_bodies import NONE, Capsules
from sim.devices.camera_body import Exposed
from sim.objects.plan_object import surface_of
from sim.optics import panels
from sim.optics.blur import defocus_blur_px, through
from sim.optics.disturbances import Millimetres
from sim.optics.dome import as_built
from sim.optics.glow import Glow, glow
from sim.optics.led_light import channel_factors
from sim.optics.objective import Objective, vignetting
from sim.optics.sensor import electrons, expose_electrons, mosaic_electrons
from sim.render import arm_shadow
from sim.render.camera_view import View, Viewer, slopes
from sim.render.embree import Obstacles
from sim.render.emitter import LED_SIDE_MM, Emitter, irradiance_of_each, square, squares
from sim.render.interreflection import Neighbourhood, add_indirect, exchange, indirect_lux, neighbourhood
from sim.render.lens import Lens, Sight, sight
from sim.render.radiance import albedo, led_radiance, panel_radiance
from sim.render.shadows import Shadows
from sim.scene.scene import Scene, build_scene, support_disk
from sim.scene.things import placed_surfaces
from sim.world.config import CameraConfig, SceneConfig, Settings

_POSE_TOLERANCE, _ARM_TOLERANCE_MM = 1e-6, 1e-3
_SHADOW_BYTES = 512 << 20
_RADIANCE_BYTES = 256 << 20
_WARM_UP_HEIGHT_MM = 1000.0

_AHEAD = square((0.0, 0.0, 1000.0), (0.0, 0.0, -1.0), side_mm=LED_SIDE_MM, flux_lm=1.0)
"""A lamp in front of the camera, for the warm-up."""

Radiance = NDArray[np.float32]


@dataclass
class Look:
    """View from one pose of camera and arm, and the radiances computed for it so far."""

    base_from_camera: Transform
    arm_mm: Capsules
    """Capsules of the arm, which cast shadows."""
    view: View
    places: NDArray[np.int32] | None
    """[sites] places in the table of shadows; None if each pixel is shaded."""
    samples: int
    scene: Scene
    radiance: dict[int, Radiance] = field(default_factory=dict)
    """Radiance of the sites, by LED, or by minus the number of a panel."""
    around: Neighbourhood | None = None
    """Neighbourhood in which interreflection is interpolated; it is computed when it is needed."""
    disk_px: NDArray[np.float32] | None = None
    """Blur by defocus; it is computed when it is needed."""
    glows: dict[int, Glow | None] = field(default_factory=dict)
    """Images of lamps, by the same numbers."""
    through: Sight | None = None
    """The lens of this pose, if it differs from the common lens."""

    @cached_property
    def empty(self) -> NDArray[np.float32]:
        """[h, w] fraction of each pixel that sees nothing."""
        return self.view.empty(self.samples)

    @cached_property
    def albedo(self) -> NDArray[np.float32]:
        """[sites, 3] albedo for light from all directions."""
        return albedo(self.view, self.scene.materials)


class Photographer:
    """Contains the scene, its shadows, and the last view of it. Only one worker thread calls `render`."""

    def __init__(self, scene: SceneConfig, camera: CameraConfig, settings: Settings) -> None:
        base_from_support = np.array(scene.base_from_support)
        self._base_from_support = base_from_support
        self._object = [(surface_of(mesh, settings), np.array(mesh.support_from_object)) for mesh in scene.objects]
        self._around = [(support_disk(scene.support_diameter_mm), base_from_support)]
        self._things = placed_surfaces(settings.things, base_from_support, settings.strangers.target)
        self._strangers = settings.strangers
        self._glare = settings.glare
        self._up = base_from_support[:3, 2]
        self._emission = scene.emission
        table = read_leds(scene.leds)
        self.leds: Leds = as_built(table, settings.dome)
        """The LEDs at their true places; the controller has the table."""
        self._led_model = settings.leds
        dies = settings.strangers.light.tilted_normals(self.leds.normals, self.leds.ids)
        self._emitters = _emitters(replace(self.leds, normals=dies))
        self._row_of_led = {int(led): row for row, led in enumerate(self.leds.ids)}
        self._objective = Objective(
            camera.focal_length_mm,
            camera.focus_distance_mm,
            camera.f_number,
            rim_radius=camera.rim_radius,
            rim_shift=camera.rim_shift,
            lateral_colour=camera.lateral_colour,
        )
        self._camera = camera
        lens = Lens.at_focus(
            camera.width_px,
            camera.height_px,
            pixel_pitch_um=camera.pixel_pitch_um,
            focal_length_mm=camera.focal_length_mm,
            focus_distance_mm=camera.focus_distance_mm,
            distortion=camera.distortion,
        )
        self._lens = settings.strangers.lens.disturbed_lens(lens, camera.focus_distance_mm)
        self._sight = sight(self._lens)
        self._falloff = self._relative_illuminance()
        self._shading = settings.shading
        self.sensor = camera.true_sensor(settings.seed)
        self.flange_from_camera: Transform = np.array(camera.flange_from_camera)
        self.reference_lux = _reference_lux(_emitters(table), base_from_support)
        white_e = camera.white_share * self.sensor.full_scale_e
        self._electrons = white_e * np.pi / (self.reference_lux * camera.nominal_exposure_us * 1e-6)
        self._panels = [
            (panels.whole(panel, base_from_support, self.reference_lux), panel.unevenness)
            for panel in settings.panels
        ]
        pieces = [piece for panel, unevenness in self._panels for piece in panels.pieces(panel, unevenness)]
        self._pieces = pieces
        places_mm = np.array([*self.leds.positions_mm, *(piece.centre_mm for piece in pieces)])
        self._lamp_places_mm = places_mm
        self._interreflection = settings.light_between_surfaces
        self._place_object((0.0, 0.0, 0.0))
        self._colour: dict[int, NDArray[np.float32]] = {}
        self._warm_up(base_from_support)

    def _place_object(self, moved_mm: Millimetres) -> None:
        """Build the scene with the plan's object displaced in the support frame."""
        displacement = np.eye(4)
        displacement[:3, 3] = self._object_mm = moved_mm
        base_from_displaced = self._base_from_support @ displacement
        object_surfaces = [(surface, base_from_displaced @ pose) for surface, pose in self._object]
        self._scene = build_scene([*self._around, *object_surfaces, *self._things])
        self._viewer = Viewer(self._scene, self._lens, self._camera.samples_per_side, self._shading)
        self._obstacles = Obstacles(self._scene.corners_mm)
        self._shadows = Shadows(self._obstacles, self._lamp_places_mm, _SHADOW_BYTES)
        self._look: Look | None = None
        config = self._interreflection
        self._exchange = None if config is None else exchange(self._scene, self._obstacles, config.rays)

    def _warm_up(self, base_from_support: Transform) -> None:
        """Compile by rendering the support from above under one LED, before the first frame is due."""
        support_from_camera = np.diag([1.0, -1.0, -1.0, 1.0])
        support_from_camera[2, 3] = _WARM_UP_HEIGHT_MM
        look = self._look_from(base_from_support @ support_from_camera @ inverse(self.flange_from_camera))
        self._led(look, int(self.leds.ids[0]))
        arm_shadow.warm_up()
        glow(_AHEAD, "lambertian", self._sight, np.eye(4), look.empty, None)

    def _relative_illuminance(self) -> NDArray[np.float32]:
        """[h, w] illuminance of each pixel relative to the illuminance of the centre."""
        x, y = slopes(self._sight)
        tangent = np.hypot(x, y)
        shift_x, shift_y = self._strangers.lens.stop_shift_mm
        along_mm = (x * shift_x + y * shift_y) / np.maximum(tangent, 1e-12)
        stop_mm = (along_mm, float(np.hypot(shift_x, shift_y)))
        return vignetting(self._objective, tangent, stop_mm).astype(np.float32)

    def render(self, out: NDArray[np.uint16], exposure: Exposed) -> None:
        """Fill `out` [h, w] with the frame of one exposure, DN."""
        disturbance = exposure.disturbance
        if disturbance.object_mm != self._object_mm:
            self._place_object(disturbance.object_mm)
        base_from_flange = exposure.base_from_flange.copy()
        base_from_flange[:3, 3] += disturbance.camera_mm
        look = self._look_from(base_from_flange, exposure.arm_mm)
        radiance, seconds = self._lit(look, exposure)
        sensor_arguments: dict[str, Any] = {
            "model": self.sensor,
            "frame": exposure.number,
            "exposure_s": exposure.exposure_s,
            "gain": exposure.gain * disturbance.gain * self._strangers.sensor.gain(exposure.number),
            "temperature_c": self._camera.sensor_temperature_c,
        }
        glows = self._glows(look, exposure)
        scale = self._electrons * seconds
        if self._camera.blur or self._strangers.lens.coma_px or disturbance.covers or self._glare is not None:
            sharp = electrons(look.view.site, radiance, self._falloff, electrons_per_radiance=scale)
            mean_e = self._blurred_electrons(look, sharp)
            if glows is not None:
                mean_e += glows
            mean_e = disturbance.cover_up(mean_e)
            if self._glare is not None:
                mean_e = self._glare.over(mean_e, self.sensor.channels())
        else:
            mean_e = mosaic_electrons(
                look.view.site, radiance, self._falloff, model=self.sensor, electrons_per_radiance=scale
            )
            if glows is not None:
                mean_e += glows
        expose_electrons(out, mean_e, **sensor_arguments)
        self._strangers.sensor.add_tails(out, exposure.number, self.sensor.white_dn)

    def _blurred_electrons(self, look: Look, sharp: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return [h, w] electrons after the Bayer filter, for the electrons [h, w, 3] of a perfect lens."""
        if self._strangers.lens.coma_px:
            sharp = self._strangers.lens.with_coma(sharp)
        channels = self.sensor.channels()
        if not self._camera.blur:
            rows, columns = np.ogrid[: sharp.shape[0], : sharp.shape[1]]
            return np.asarray(sharp[rows, columns, channels[rows & 1, columns & 1]])
        pitch_um = self._camera.pixel_pitch_um
        return through(self._objective, sharp, self._disk_px(look), channels, pixel_pitch_um=pitch_um)

    def _disk_px(self, look: Look) -> NDArray[np.float32]:
        """[h, w] standard deviation of the blur by defocus, computed once per pose."""
        if look.disk_px is None:
            depth_mm = look.view.depth_mm(look.base_from_camera, look.samples)
            look.disk_px = defocus_blur_px(self._objective, depth_mm, self._camera.pixel_pitch_um)
        return look.disk_px

    def _lit(self, look: Look, exposure: Exposed) -> tuple[Radiance, float]:
        """Radiance of the sites, and its duration in seconds."""
        warmth = self._strangers.light.warmth(exposure.number)
        lights = [(self._led(look, led), warmth * lit_s) for led, lit_s in exposure.seconds_of_led.items()]
        lights += [(self._panel(look, panel), exposure.exposure_s) for panel in exposure.panels]
        if lamp_lux := exposure.disturbance.lamp_lux:
            lights.append((panel_radiance(look.view, self._scene.materials, lamp_lux), exposure.exposure_s))
        if len(lights) == 1:
            return lights[0]
        count = len(look.view.points_mm)
        radiance = np.zeros((max(1, count), 3), np.float32)
        for led_light, lit_s in lights:
            radiance[:count] += led_light * np.float32(lit_s)
        return radiance, 1.0

    def _look_from(self, base_from_flange: Transform, arm_mm: Capsules = NONE) -> Look:
        """Rasterise from a flange pose, unless it is the same as the last one."""
        base_from_camera = base_from_flange @ self.flange_from_camera
        look = self._look
        if look is None or np.abs(base_from_camera - look.base_from_camera).max() > _POSE_TOLERANCE:
            viewer, lens_now = self._viewer, self._sight
            if self._strangers.lens.breathing:
                down = -float(base_from_camera[:3, 2] @ self._up)
                lens = self._strangers.lens.with_breathing(self._lens, down)
                viewer = Viewer(self._scene, lens, self._camera.samples_per_side, self._shading)
                lens_now = sight(lens)
            view = viewer.look(base_from_camera)
            places = self._shadows.places(view.sides) if self._shading == "flat" else None
            samples = self._camera.samples_per_side
            look = self._look = Look(base_from_camera, arm_mm, view, places, samples, self._scene)
            look.through = lens_now
        arm_moved = arm_mm.shape != look.arm_mm.shape or np.abs(arm_mm - look.arm_mm).max(initial=0.0)
        if arm_moved > _ARM_TOLERANCE_MM:
            look.arm_mm = arm_mm
            look.radiance.clear()
        return look

    # -- light on the scene -------------------------------------------------------------------------------

    def _led(self, look: Look, led: int) -> Radiance:
        """Radiance of the sites under one LED at its tabulated flux."""
        row = self._row_of_led[led]
        return _remembered_radiance(look, led, lambda: self._lit_by_led(look, row, led))

    def _lit_by_led(self, look: Look, row: int, led: int) -> Radiance:
        radiance = self._shaded_radiance(look, self._emitters[row], row)
        self._add_indirect(radiance, look, self._emitters[row], self._emission)
        if self._led_model.pump_spread_nm > 0.0:
            radiance *= self._colour_of(led)
        return radiance

    def _panel(self, look: Look, panel: int) -> Radiance:
        """Radiance of the sites under panel 1 to 4."""
        if not self._panels:
            return panel_radiance(look.view, self._scene.materials, self.reference_lux)
        if panel > len(self._panels):
            return np.zeros((len(look.view.points_mm), 3), np.float32)
        return _remembered_radiance(look, -panel, lambda: self._lit_by_panel(look, panel))

    def _lit_by_panel(self, look: Look, panel: int) -> Radiance:
        count = panels.PARTS**2
        radiance = np.zeros((len(look.view.points_mm), 3), np.float32)
        self._add_indirect(radiance, look, self._panels[panel - 1][0], "lambertian")
        for piece in range((panel - 1) * count, panel * count):
            radiance += self._shaded_radiance(look, self._pieces[piece], len(self._emitters) + piece, "lambertian")
        return radiance

    def _shaded_radiance(self, look: Look, emitter: Emitter, row: int, emission: str = "") -> Radiance:
        view, emission = look.view, emission or self._emission
        matter = self._scene.materials, self._scene.tables
        if look.places is not None:
            visibility = self._shadows.reached_bits(row)
            radiance = led_radiance(view, *matter, emitter, emission, look.places, visibility)
        else:
            radiance = led_radiance(view, *matter, emitter, emission)
            self._obstacles.cast(radiance, view.points_mm, view.triangle, view.normals, emitter.centre_mm)
        arm_shadow.cast(radiance, view.points_mm, look.arm_mm, emitter.centre_mm)
        if self._strangers.light.has_lobe and row < len(self._emitters):
            led = int(self.leds.ids[row])
            radiance *= self._strangers.light.over_cosine(emitter, view.points_mm, led)[:, None]
        return radiance

    def _add_indirect(self, radiance: Radiance, look: Look, emitter: Emitter, emission: str) -> None:
        """Add the interreflection of a light, if interreflection is on."""
        between, config = self._exchange, self._interreflection
        if between is None or config is None or len(radiance) == 0:
            return
        if look.around is None:
            look.around = neighbourhood(between, self._scene.corners_mm, look.view.sides, look.view.normals)
        lux = indirect_lux(between, self._obstacles, emitter, emission, look.arm_mm, config.bounces)
        add_indirect(radiance, lux, look.around, look.albedo, look.view.triangle)

    def _colour_of(self, led: int) -> NDArray[np.float32]:
        """[3] signal of white under this LED relative to the median one, at equal flux."""
        if self._led_model.pump_spread_nm == 0.0:
            return np.ones(3, np.float32)
        if led not in self._colour:
            self._colour[led] = channel_factors(self._led_model, led, light.camera()).astype(np.float32)
        return self._colour[led]

    # -- lamps in the picture -----------------------------------------------------------------------------

    def _glows(self, look: Look, exposure: Exposed) -> NDArray[np.float32] | None:
        """[h, w] mean electrons from lamps in the picture, or None if there are none."""
        glows: list[tuple[Glow, NDArray[np.float32]]] = []
        for led, lit_s in exposure.seconds_of_led.items():
            die = self._emitters[self._row_of_led[led]]
            if self._strangers.light.primary_lens_mm:
                die = self._strangers.light.seen_from(die, look.base_from_camera[:3, 3])
            if spot := self._glow(look, led, die, self._emission):
                glows.append((spot, self._colour_of(led) * np.float32(lit_s)))
        for panel in exposure.panels:
            if panel <= len(self._panels):
                whole, unevenness = self._panels[panel - 1]
                if area := self._glow(look, -panel, whole, "lambertian", unevenness):
                    glows.append((area, np.full(3, exposure.exposure_s, np.float32)))
        if not glows:
            return None
        mean_e = np.zeros(self._falloff.shape, np.float32)
        for lamp, seconds in glows:
            of_row, of_column = np.ogrid[lamp.rows, lamp.columns]
            weights = seconds[self.sensor.channels()[of_row & 1, of_column & 1]]
            mean_e[lamp.rows, lamp.columns] += lamp.radiance * weights
        return mean_e * self._falloff * np.float32(self._electrons)

    def _glow(self, look: Look, light: int, lamp: Emitter, emission: str, unevenness: float = 0.0) -> Glow | None:
        """The image of a lamp; computed once per pose."""
        if light not in look.glows:
            blur = (self._objective, self._camera.pixel_pitch_um) if self._camera.blur else None
            look.glows[light] = glow(
                lamp, emission, look.through or self._sight, look.base_from_camera, look.empty, blur, unevenness
            )
        return look.glows[light]


def _remembered_radiance(look: Look, light: int, compute: Callable[[], Radiance]) -> Radiance:
    """Return the radiance under a light. It is computed once per pose as long as memory suffices."""
    if light in look.radiance:
        return look.radiance[light]
    radiance = compute()
    if (len(look.radiance) + 1) * radiance.nbytes <= _RADIANCE_BYTES:
        look.radiance[light] = radiance
    return radiance


def _emitters(leds: Leds) -> list[Emitter]:
    return squares(leds.positions_mm, leds.normals, side_mm=LED_SIDE_MM, fluxes_lm=leds.flux_lm)


def _reference_lux(emitters: list[Emitter], base_from_support: Transform) -> float:
    """Median over the LEDs of the irradiance on a horizontal white target at the support's centre."""
    centre, up = base_from_support[:3, 3], base_from_support[:3, 2]
    return float(np.median(irradiance_of_each(emitters, centre, up)))
