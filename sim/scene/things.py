"""Things in the simulated scene in addition to the plan's object: calibration targets, samples.

Listed in the rig under `world: settings: things:`, each with its kind, dimensions and position on the support. The
controller does not know of them: views must keep clear of tall ones.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal, Protocol, assert_never

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from coupole.geometry import Transform, transform
from sim.scene.surface import Surface

_Length = Annotated[float, Field(gt=0)]
_Vector = tuple[float, float, float]
Poses = NDArray[np.float64]


class _Thing(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    translation_mm: _Vector = (0.0, 0.0, 0.0)
    abc_deg: _Vector = (0.0, 0.0, 0.0)
    """Pose in the support frame, as in a plan's poses."""

    def support_from_thing(self) -> Transform:
        return transform(self.translation_mm, self.abc_deg)


class CharucoBoard(_Thing):
    """Defaults are those of `sim.objects.charuco.Charuco`."""

    kind: Literal["charuco_board"]
    squares_x: Annotated[int, Field(ge=3)] = 12
    squares_y: Annotated[int, Field(ge=3)] = 9
    square_mm: _Length = 16.0
    marker_mm: _Length = 12.0
    dictionary: str = "DICT_5X5_250"
    thickness_mm: _Length = 4.0
    margin_mm: _Length = 5.0

    def surface(self) -> Surface:
        from sim.objects.charuco import Charuco, charuco_board

        measures = {field.name: getattr(self, field.name) for field in dataclasses.fields(Charuco)}
        return charuco_board(Charuco(**measures))


class Sphere(_Thing):
    kind: Literal["chrome_ball", "glossy_sphere"]
    diameter_mm: _Length = 30.0

    def surface(self) -> Surface:
        from sim.objects import shapes, standards

        match self.kind:
            case "chrome_ball":
                return standards.chrome_ball(self.diameter_mm)
            case "glossy_sphere":
                return shapes.glossy_sphere(self.diameter_mm / 2)
            case _:
                assert_never(self.kind)


class Stickers(BaseModel):
    """The scanner's retro-reflective targets, attached where the surface is flat enough."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    count: Annotated[int, Field(ge=1)]
    """Number of stickers at present."""
    seed: int = 1
    diameter_mm: _Length = 6.0
    gap_mm: _Length = 0.8
    """Gap as in `sim.objects.standards.sticker_poses`, which gives the stickers' poses."""
    new: Annotated[int, Field(ge=0)] = 0
    """Number of stickers that were attached after the scan and are not in its table."""
    fallen: Annotated[int, Field(ge=0)] = 0
    """Number of stickers in the scan that have come off since."""

    @model_validator(mode="after")
    def _some_stayed(self) -> Stickers:
        if self.new > self.count:
            raise ValueError(f"`new` is {self.new}, but there are only {self.count} stickers")
        return self

    def on(self, surface: Surface) -> Surface:
        """The surface with its present stickers. Raises InputError if it has no room for them."""
        from sim.objects.standards import stuck_on

        return stuck_on(surface, self._poses(surface)[: self.count], diameter_mm=self.diameter_mm)

    def poses_when_scanned(self, surface: Surface) -> Poses:
        """[n, 4, 4] poses of the stickers that were scanned, in the thing's frame."""
        return self._poses(surface)[self.new :]

    def _poses(self, surface: Surface) -> Poses:
        """Return poses of all stickers ever attached: first the new ones, last those that have come off."""
        from sim.objects.standards import sticker_poses

        total = self.count + self.fallen
        return sticker_poses(surface, total, self.seed, diameter_mm=self.diameter_mm, gap_mm=self.gap_mm)


class Sample(_Thing):
    """A sample of a material, with the dimensions of its generator."""

    kind: Literal[
        "spectralon_tile",
        "grey_card",
        "colour_chart",
        "glare_target",
        "gilt_step_wedge",
        "paint_wedge",
        "makie_tile",
        "nashiji_slab",
        "fabric",
        "sculpted_relief",
    ]
    stickers: Stickers | None = None

    def surface(self) -> Surface:
        return self.bare() if self.stickers is None else self.stickers.on(self.bare())

    def bare(self) -> Surface:
        """Return the surface without its stickers."""
        from sim.objects import colour_chart, fabric, shapes, standards, urushi, wedges

        match self.kind:
            case "spectralon_tile":
                return standards.spectralon_tile()
            case "grey_card":
                return standards.grey_card()
            case "colour_chart":
                return colour_chart.colour_chart()
            case "glare_target":
                return standards.glare_target()
            case "gilt_step_wedge":
                return wedges.gilt_step_wedge()
            case "paint_wedge":
                return wedges.paint_wedge()
            case "makie_tile":
                return urushi.makie_tile()
            case "nashiji_slab":
                return urushi.nashiji_slab()
            case "fabric":
                return fabric.fabric()
            case "sculpted_relief":
                return shapes.sculpted_relief()
            case _:
                assert_never(self.kind)


Thing = Annotated[CharucoBoard | Sphere | Sample, Field(discriminator="kind")]


class Disturbance(Protocol):
    """Change of a thing's surface that its description does not contain."""

    def disturbed_surface(self, kind: str, surface: Surface) -> Surface: ...


def placed_surfaces(
    things: tuple[Thing, ...], base_from_support: Transform, disturbance: Disturbance
) -> list[tuple[Surface, Transform]]:
    """Surfaces and their `base_from_surface`."""
    return [
        (
            disturbance.disturbed_surface(thing.kind, thing.surface()),
            np.asarray(base_from_support @ thing.support_from_thing()),
        )
        for thing in things
    ]
