"""Lights that a user names on the command line or in a file of lights.

Places are in mm; the length of a direction does not matter. Both are in the support frame for results of runs (z
up), and in the pictures' frame for results of pictures. A strength is one number or three (r, g, b). The value 1
of a picture is a white diffuser in full light. Strength 1 then means:

=============  ====================================================================================
`direction`    a white diffuser that faces the light is 1
`point`        the same at 1 m
`area`         a surface of radiance 1: a white diffuser is 1 if nothing else is in its sky
`environment`  the file's values are radiances, in the same unit
`led`          the LED as it was in the run: values are shares of the camera's range
=============  ====================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from coupole.errors import InputError
from coupole.plan import yamlfile
from coupole.plan.base_model import FilePath, Length, Model, Vector

Floats = NDArray[np.float64]


def _with_length(vector: Vector) -> Vector:
    if math.hypot(*vector) < 1e-9:
        raise ValueError("a vector that is not all 0")
    return vector


Way = Annotated[Vector, AfterValidator(_with_length)]
MOST_MM = 20_000.0
"""Largest coordinate or side: more than any cell has."""
Factor = Annotated[float, Field(ge=0.0, le=1e9)]


class Light(Model):
    """Properties that all lights have."""

    strength: Factor | tuple[Factor, Factor, Factor] = 1.0
    """Strength, one number for all channels or one each for red, green and blue. The head of this module tells
    what strength 1 means."""

    @property
    def rgb(self) -> Floats:
        """[3] strength for red, green and blue."""
        return np.broadcast_to(np.asarray(self.strength, np.float64), 3).copy()


class DistantLight(Light):
    """A light at a great distance, whose light comes from one direction."""

    kind: Literal["direction"] = "direction"
    towards: Way
    """Vector towards the light; its length does not count."""


class LedLight(Light):
    """An LED of the run with its measured power."""

    kind: Literal["led"] = "led"
    number: Annotated[int, Field(ge=0)]
    """Number of the LED."""


class PointLight(Light):
    """A light at a point that shines equally to all sides."""

    kind: Literal["point"] = "point"
    at_mm: Vector
    """Place of the point, mm."""


_LEVEL = (1.0, 0.0, 0.0)
"""Direction of the width if the normal is z."""


class AreaLight(Light):
    """A rectangle that radiates by Lambert's law to one side; its width is level unless `across` is given."""

    kind: Literal["area"] = "area"
    at_mm: Vector
    """Place of its centre, mm."""
    normal: Way
    """Direction of the side that radiates."""
    across: Way | None = None
    """Direction of the width; only its part across the normal counts."""
    width_mm: Length
    """Width, mm."""
    height_mm: Length | None = None
    """Height, mm; equal to the width if it is not given."""


class EnvironmentLight(Light):
    """A picture of all directions; coupole.reflectance.new_light.environment describes its layout."""

    kind: Literal["environment"] = "environment"
    file: FilePath
    """Picture of all directions."""
    turn_deg: float = 0.0
    """Angle, degrees, by which the environment is turned about the up direction, from the middle of the picture to
    its left."""


AnyLight = Annotated[
    DistantLight | LedLight | PointLight | AreaLight | EnvironmentLight, Field(discriminator="kind")
]


class LightsFile(Model):
    """A file of lights that shine together."""

    lights: Annotated[tuple[AnyLight, ...], Field(min_length=1, max_length=1000)]
    """The lights."""


def read_lights(path: Path) -> list[AnyLight]:
    """Read the lights of a file. Raises InputError with file:line:column."""
    document = yamlfile.read_document(path)
    lights = document.validate(LightsFile).lights
    return [
        light.model_copy(update={"file": document.resolve(light.file)})
        if isinstance(light, EnvironmentLight)
        else light
        for light in lights
    ]


def numbers_of(text: str, counts: Sequence[int], option: str, form: str) -> list[float]:
    """Return numbers separated by commas. Raises InputError for a wrong count, and for a text that is not a
    number."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not all(math.isfinite(number) for number in numbers):
        raise InputError(f"{option}: expected {form}; got {text!r}")
    return numbers


def way_of(text: str, option: str) -> Vector:
    """Return a direction vector of any length. Raises InputError."""
    form = "X,Y,Z, not all 0"
    x, y, z = numbers_of(text, (3,), option, form)
    length = math.hypot(x, y, z)
    if length < 1e-9:
        raise InputError(f"{option}: expected {form}; got {text!r}")
    return x / length, y / length, z / length


def place_of(text: str, option: str) -> Vector:
    """A place in mm. Raises InputError."""
    form = f"X,Y,Z in mm, each within {MOST_MM:g}"
    x, y, z = numbers_of(text, (3,), option, form)
    if max(abs(x), abs(y), abs(z)) > MOST_MM:
        raise InputError(f"{option}: expected {form}; got {text!r}")
    return x, y, z


def area_of(text: str) -> AreaLight:
    """Return a rectangle from the value of the option `--area`. Raises InputError."""
    form = "X,Y,Z,NX,NY,NZ,WIDTH or X,Y,Z,NX,NY,NZ,WIDTH,HEIGHT in mm, the normal not all 0, sides above 0"
    numbers = numbers_of(text, (7, 8), "--area", form)
    at_mm = place_of(",".join(map(str, numbers[:3])), "--area")
    length = math.hypot(*numbers[3:6])
    if length < 1e-9 or not all(0.0 < side <= MOST_MM for side in numbers[6:]):
        raise InputError(f"--area: expected {form}; got {text!r}")
    x, y, z = (number / length for number in numbers[3:6])
    return AreaLight(at_mm=at_mm, normal=(x, y, z), width_mm=numbers[6], height_mm=numbers[-1])


def turn_light(light: AnyLight, angle_deg: float) -> AnyLight:
    """Return a light turned about the z axis, from x to y, or an environment turned about its own up direction.
    Raises InputError for an LED, because its place is fixed."""
    cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))

    def turn(vector: Vector) -> Vector:
        x, y, z = vector
        return cosine * x - sine * y, sine * x + cosine * y, z

    match light:
        case DistantLight():
            return light.model_copy(update={"towards": turn(light.towards)})
        case PointLight():
            return light.model_copy(update={"at_mm": turn(light.at_mm)})
        case AreaLight():
            across = turn(light.across or _LEVEL) if light.across or not any(light.normal[:2]) else None
            turned_area = {"at_mm": turn(light.at_mm), "normal": turn(light.normal), "across": across}
            return light.model_copy(update=turned_area)
        case EnvironmentLight():
            return light.model_copy(update={"turn_deg": light.turn_deg + angle_deg})
        case LedLight():
            raise InputError("--turn: an LED stays where it is; name a light of another kind")
