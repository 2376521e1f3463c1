"""The scene file of `coupole render` (docs/reference/scene.md).

Lengths are mm, angles degrees; z is up.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AwareDatetime, BaseModel, Field, model_validator

from coupole.appearance.render.bands import StepNm
from coupole.appearance.render.lights import Daylight, Light, PlainLight, plain
from coupole.appearance.render.model import Model, Positive, Vector
from coupole.appearance.render.objects import Object, PaintWedge, Plane
from coupole.appearance.render.spectra import Shape
from coupole.geometry import transform

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
Pixels = Annotated[int, Field(ge=4, le=8192)]


class FieldOfView(Model):
    kind: Literal["field"]
    degrees: Annotated[float, Field(gt=0, lt=170)]
    """Field of view across the picture's width, degrees."""


class Lens(Model):
    kind: Literal["lens"]
    focal_length_mm: Positive
    pixel_pitch_um: Positive


class Camera(Model):
    """A pinhole camera."""

    name: Name
    position_mm: Vector
    target_mm: Vector
    up: Vector = (0.0, 0.0, 1.0)
    optics: Annotated[FieldOfView | Lens, Field(discriminator="kind")]
    width_px: Pixels
    height_px: Pixels

    @model_validator(mode="after")
    def _looks(self) -> Camera:
        way = np.subtract(self.target_mm, self.position_mm)
        if np.linalg.norm(np.cross(way, self.up)) < 1e-6 * np.linalg.norm(way) * np.linalg.norm(self.up):
            raise ValueError("the camera looks along `up`, or nowhere: choose another `up`, or move the camera")
        return self

    def field_deg(self) -> float:
        """Field of view across the picture's width, degrees."""
        if isinstance(self.optics, FieldOfView):
            return self.optics.degrees
        half_mm = 0.5e-3 * self.width_px * self.optics.pixel_pitch_um
        return float(np.degrees(2.0 * np.arctan(half_mm / self.optics.focal_length_mm)))

    def narrowed_to(self, width_px: int) -> Camera:
        """Return the same camera with fewer pixels, at most `width_px` wide. A camera that is not wider stays as
        it is.
        """
        if width_px >= self.width_px:
            return self
        optics = FieldOfView(kind="field", degrees=self.field_deg())
        height_px = max(4, round(self.height_px * width_px / self.width_px))
        return self.model_copy(update={"width_px": width_px, "height_px": height_px, "optics": optics})


class Bands(Model):
    """380 to 780 nm by `step_nm`."""

    step_nm: StepNm = 5


class Display(Model):
    """Conversion of XYZ to sRGB."""

    white_cd_m2: Positive | None = None
    """Luminance that is shown as white. By default it is the level that the share `clipped` of the pixels
    exceeds."""
    clipped: Annotated[float, Field(ge=0, lt=0.5)] = 0.005
    adaptation: Literal["CAT16", "Bradford", "none"] = "CAT16"
    """Adaptation from the white of the first light to D65; `none` shows the light's own colour."""
    denoised: bool = False
    """True if the PNG, but no other file, is denoised by Open Image Denoise."""


class Outputs(Model):
    spectra: Literal["half", "float"] = "float"
    """Number format of the EXR."""
    xyz: bool = True
    """True if the EXR has X, Y, Z in addition to the bands."""


class Caustic(Model):
    """A picture of the light on the arcature's back wall, by photons; the sun is the first distant light."""

    photons: Annotated[int, Field(ge=1000, le=100_000_000)] = 1_000_000
    cell_mm: Positive = 4.0


class Gathered(Model):
    """Sunlight that gold reflects onto matt surfaces, by photons that the eye gathers, instead of by paths."""

    photons: Annotated[int, Field(ge=1000, le=100_000_000)] = 2_000_000
    """Number of photons for each sun."""
    radius_mm: Positive = 4.0
    """Radius, around each place that the eye sees, in which photons are gathered. A smaller radius is sharper, and
    needs more photons."""


class Film(Model):
    """A film with a picture for each time from `begins` to `ends`; all have the white of the first picture."""

    begins: AwareDatetime
    ends: AwareDatetime
    every_s: Annotated[float, Field(gt=0)] = 30.0
    frames_per_s: Annotated[int, Field(ge=1, le=60)] = 12
    """Pictures per second when the film is shown."""

    @model_validator(mode="after")
    def _rises(self) -> Film:
        if self.ends <= self.begins:
            raise ValueError("the film ends before it begins: exchange `begins` and `ends`")
        return self

    def times(self) -> list[datetime]:
        count = int((self.ends - self.begins).total_seconds() / self.every_s + 1e-6) + 1
        return [self.begins + timedelta(seconds=number * self.every_s) for number in range(count)]


class Turntable(Model):
    """A film with a picture for each step of a turn about the scene's z axis. All objects except planes turn;
    lights stand still."""

    frames: Annotated[int, Field(ge=2, le=1000)] = 48
    degrees: Annotated[float, Field(ge=-3600, le=3600)] = 360.0
    """Angle from the first picture to the picture that would follow the last one."""
    frames_per_s: Annotated[int, Field(ge=1, le=60)] = 12

    def angles_deg(self) -> list[float]:
        return [number * self.degrees / self.frames for number in range(self.frames)]


class Scene(Model):
    """One scene; all its cameras see the same objects and lights."""

    schema_version: Literal[1]
    name: Name
    cameras: Annotated[tuple[Camera, ...], Field(min_length=1)]
    objects: Annotated[tuple[Object, ...], Field(min_length=1)]
    lights: Annotated[tuple[Light, ...], Field(min_length=1)]
    observer: Literal["10 deg", "2 deg"] = "10 deg"
    bands: Bands = Bands()
    samples: Annotated[int, Field(ge=1, le=1_000_000)] = 64
    """Number of paths through each pixel; if a `noise` is given, the largest number."""
    noise: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Largest relative standard error of luminance in half of the pixels."""
    depth: Annotated[int, Field(ge=1, le=100)] = 8
    """Largest number of surfaces that a path meets."""
    seed: Annotated[int, Field(ge=0, le=2**31)] = 1
    polarisation: bool = False
    """True for Stokes vectors of every band. Stokes vectors need four times the work."""
    display: Display = Display()
    outputs: Outputs = Outputs()
    caustic: Caustic | None = None
    gathered: Gathered | None = None
    film: Film | None = None
    turntable: Turntable | None = None

    @model_validator(mode="after")
    def _names(self) -> Scene:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise ValueError("two cameras have the same name; their pictures would overwrite each other")
        return self

    @model_validator(mode="after")
    def _sun(self) -> Scene:
        kinds = {part.kind for part in (*self.objects, *self.lights)}
        if self.caustic is not None and not ("arcature" in kinds and kinds & {"distant", "daylight"}):
            raise ValueError(
                "`caustic` needs an object of kind `arcature` and a light of kind `distant` or `daylight`"
            )
        if self.gathered is not None and (self.polarisation or not kinds & {"distant", "daylight"}):
            raise ValueError("`gathered` needs a light of kind `distant` or `daylight`, and no polarisation")
        if self.film is not None and "daylight" not in kinds:
            raise ValueError("`film` needs a light of kind `daylight`, whose time it moves")
        if self.film is not None and self.turntable is not None:
            raise ValueError("`film` and `turntable` exclude each other: one moves the sun, the other the objects")
        return self

    def at(self, when: datetime) -> Scene:
        """Return the scene with its daylight at another time."""
        moved_lights = tuple(
            light.model_copy(update={"when": when}) if isinstance(light, Daylight) else light
            for light in self.lights
        )
        return self.model_copy(update={"lights": moved_lights})

    def turned_about_z(self, angle_deg: float) -> Scene:
        """Return the scene with all objects except planes turned about its z axis, anticlockwise from above."""
        about_z = transform(abc_deg=(angle_deg, 0.0, 0.0))

        def turn_object(thing: Object) -> Object:
            if isinstance(thing, Plane):
                return thing
            x, y, z = (about_z[:3, :3] @ thing.translation_mm).tolist()
            a, b, c = thing.abc_deg
            return thing.model_copy(update={"translation_mm": (x, y, z), "abc_deg": (a + angle_deg, b, c)})

        return self.model_copy(update={"objects": tuple(turn_object(thing) for thing in self.objects)})


class PlainScene(Scene):
    """A scene in which daylight has been replaced by sun and sky."""

    lights: Annotated[tuple[PlainLight, ...], Field(min_length=1)]


def with_plain_lights(scene: Scene, folder: Path) -> PlainScene:
    """Return the scene with sun and sky instead of daylight. Raises InputError if they cannot be computed."""
    fields = {name: getattr(scene, name) for name in Scene.model_fields}
    return PlainScene.model_construct(**{**fields, "lights": plain(scene.lights, folder)})


def files(part: Any, at: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Path]]:
    """Yield all paths that a scene names, with the keys that lead to them."""
    if isinstance(part, Path):
        yield at, part
    elif isinstance(part, BaseModel):
        for name in type(part).model_fields:
            yield from files(getattr(part, name), (*at, name))
    elif isinstance(part, tuple):
        for number, inner in enumerate(part):
            yield from files(inner, (*at, number))


def remarks(scene: Scene) -> list[str]:
    """Return remarks for the author of the scene, one sentence each."""
    shape_remarks = [shape.remark() for shape in _shapes(scene)]
    return list(dict.fromkeys(remark for remark in shape_remarks if remark))


def _shapes(part: Any) -> Iterator[Shape]:
    if isinstance(part, PaintWedge):
        yield Shape(kind="shape", name=part.pigment)
    if isinstance(part, Shape):
        yield part
    elif isinstance(part, BaseModel):
        for name in type(part).model_fields:
            yield from _shapes(getattr(part, name))
    elif isinstance(part, tuple):
        for inner in part:
            yield from _shapes(inner)
