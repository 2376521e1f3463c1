"""The plan: views, lights, exposures and object.

Positions are in the support frame (disk centre, z up), in mm; angles in degrees. Every model is frozen and refuses
unknown keys. `coupole.plan.yamlfile` reports refusals with file:line:column.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    field_validator,
    model_validator,
)

from coupole.geometry import Transform, transform

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
Name = Annotated[str, Field(pattern=NAME_PATTERN)]
"""Letters, digits, dot, underscore, hyphen: it becomes part of file names and shot ids."""
Words = Annotated[str, Field(min_length=1, max_length=500)]
Millimetres = Annotated[float, Field(ge=-20_000, le=20_000)]
"""A coordinate in a cell: 20 m are more than any has."""
Vector = tuple[Millimetres, Millimetres, Millimetres]
Length = Annotated[float, Field(gt=0, le=20_000)]
"""mm."""
Degrees = Annotated[float, Field(ge=-360.0, le=360.0)]
Angles = tuple[Degrees, Degrees, Degrees]
ExposureUs = Annotated[int, Field(ge=10, le=2_000_000)]
LedId = Annotated[int, Field(ge=0, le=65534)]


def possible_path(path: Path) -> Path:
    """The path itself. Raises ValueError if no file can have it."""
    if any(len(part.encode("utf-8", "replace")) > 255 for part in path.parts) or len(str(path)) > 2000:
        raise ValueError("a path of at most 2000 characters, each of its names of at most 255 bytes")
    if "\0" in str(path):
        raise ValueError("a path without NUL characters")
    if str(path).startswith("~"):
        try:
            path.expanduser()
        except RuntimeError as error:
            raise ValueError(f"a path in the home folder of a known user: {error}") from error
    return path


FilePath = Annotated[Path, AfterValidator(possible_path)]


class Model(BaseModel):
    """Frozen; unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Return the schema with the fields' docstrings as descriptions."""
        from coupole.plan.key_descriptions import key_descriptions

        schema = handler(core_schema)
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        for key, description in key_descriptions(cls).items():
            if key in properties:  # not a class variable
                properties[key].setdefault("description", description)
        return schema


class Pose(Model):
    """A rigid transform in a file: translation in mm, KUKA's A, B, C in degrees."""

    translation_mm: Vector = (0.0, 0.0, 0.0)
    """x, y, z."""
    abc_deg: Angles = (0.0, 0.0, 0.0)
    """KUKA's A, B, C: turns about z, then the new y, then the new x."""

    def matrix(self) -> Transform:
        return transform(self.translation_mm, self.abc_deg)


class AllLights(Model):
    kind: Literal["all"]
    """Each LED of the dome, one after the other."""


class LightIds(Model):
    kind: Literal["ids"]
    """LEDs by their ids in the LED table."""
    ids: Annotated[tuple[LedId, ...], Field(min_length=1)]
    """Each once; lit in this order."""

    @field_validator("ids")
    @classmethod
    def _no_twice(cls, ids: tuple[int, ...]) -> tuple[int, ...]:
        if twice := sorted({i for i in ids if ids.count(i) > 1}):
            raise ValueError(f"each LED once; given more than once: {twice}")
        return ids


class LightBoards(Model):
    """All LEDs of some boards."""

    kind: Literal["boards"]
    """All LEDs of some boards."""
    boards: Annotated[tuple[Annotated[int, Field(ge=0, le=65535)], ...], Field(min_length=1)]
    """Numbers of boards in the LED table."""


class EveryLight(Model):
    """Every n-th LED of the table, from `offset` on."""

    kind: Literal["every"]
    """Every n-th LED of the table."""
    every: Annotated[int, Field(ge=1, le=65535)]
    """n; 1 is each LED."""
    offset: Annotated[int, Field(ge=0, le=65535)] = 0
    """Rows of the table before the first."""


class LightCone(Model):
    """LEDs within `half_angle_deg` of a direction seen from the support's centre."""

    kind: Literal["cone"]
    """LEDs within an angle of a direction."""
    azimuth_deg: Degrees
    """Azimuth of the direction, from the support frame's x towards y."""
    elevation_deg: Annotated[float, Field(ge=-90, le=90)]
    """Elevation of the direction above the support's plane."""
    half_angle_deg: Annotated[float, Field(gt=0, le=180)]
    """Angle between the direction and the outermost LED."""


class Panels(Model):
    """The flat white panels, one after the other."""

    kind: Literal["panels"]
    """The flat white panels, one after the other."""
    panels: Annotated[tuple[Annotated[int, Field(ge=1, le=4)], ...], Field(min_length=1)] = (1, 2, 3, 4)
    """Numbers of panels."""


class NoLights(Model):
    """Dark frames only."""

    kind: Literal["none"]
    """Dark frames only."""


MOST_ADAPTIVE_BURSTS = 128
"""Bursts of one view whose LEDs are chosen, at most."""

LedSelection = Annotated[AllLights | LightIds | LightBoards | EveryLight | LightCone, Field(discriminator="kind")]


class EnoughLights(Model):
    """What ends the choice of LEDs of a view; what comes first counts."""

    lights: Annotated[int, Field(ge=6, le=65535)]
    """LEDs of one view, at most: it bounds time, heat, bytes and light."""
    relit_rms: Annotated[float, Field(gt=0, le=1)] | None = None
    """Expected rms error of pictures interpolated for the LEDs not lit, as a share of the view's bright level."""
    seconds: Annotated[float, Field(gt=0)] | None = None
    """Time of the view's bursts, at most."""
    lux_h: Annotated[float, Field(gt=0)] | None = None
    """Light at the view's target by the LED table, at most."""


class AdaptiveLights(Model):
    """LEDs that are chosen in the run, by what those before them have shown of the view."""

    kind: Literal["adaptive"]
    """LEDs that are chosen in the run, by what those before them have shown of the view."""
    until: EnoughLights
    """What ends the choice."""
    among: LedSelection = AllLights(kind="all")
    """LEDs from which is chosen."""
    first_lights: Annotated[int, Field(ge=6, le=200)] = 24
    """LEDs of the first burst, spread over the dome."""
    burst_lights: Annotated[int, Field(ge=1, le=256)] = 32
    """LEDs of each burst after it."""

    @property
    def burst_sizes(self) -> tuple[int, ...]:
        """LEDs of each burst of a view, if all are lit that may be."""
        first = min(self.first_lights, self.until.lights)
        full, rest = divmod(self.until.lights - first, self.burst_lights)
        return (first, *(self.burst_lights,) * full, *((rest,) if rest else ()))

    @model_validator(mode="after")
    def _few_bursts(self) -> AdaptiveLights:
        if (bursts := len(self.burst_sizes)) > MOST_ADAPTIVE_BURSTS:
            raise ValueError(
                f"at most {MOST_ADAPTIVE_BURSTS} bursts of a view, found {bursts}: raise `burst_lights`"
            )
        return self


Lights = Annotated[
    AllLights | LightIds | LightBoards | EveryLight | LightCone | AdaptiveLights | Panels | NoLights,
    Field(discriminator="kind"),
]


class LookAt(Model):
    """One view: the camera looks at a point from a direction."""

    kind: Literal["look_at"]
    """One view, from a direction."""
    name: Name
    """Name of the view, in shot ids and file names."""
    target_mm: Vector
    """The point in the picture's middle, in the support frame."""
    distance_mm: Annotated[float, Field(gt=0, le=3000)]
    """Distance from the target to the camera's projection centre."""
    azimuth_deg: Degrees
    """Azimuth of the camera seen from the target, from the support frame's x towards y."""
    elevation_deg: Annotated[float, Field(ge=-90, le=90)]
    """Elevation of the camera seen from the target, above the support's plane."""
    roll_deg: Degrees = 0.0
    """Roll of the camera about its line of sight."""
    lights: Lights | None = None
    """Lights of this view; the plan's if not given."""


class Grid(Model):
    """Views from all pairs of azimuth and elevation, named `<name>-az<azimuth>-el<elevation>`."""

    kind: Literal["grid"]
    """Views from all pairs of azimuth and elevation."""
    name: Name
    """Begins the names of the views."""
    target_mm: Vector
    """The point in the pictures' middle, in the support frame."""
    distance_mm: Annotated[float, Field(gt=0, le=3000)]
    """Distance from the target to the camera's projection centre."""
    azimuths_deg: Annotated[tuple[Degrees, ...], Field(min_length=1)]
    """Azimuths of the camera seen from the target, from the support frame's x towards y."""
    elevations_deg: Annotated[tuple[Annotated[float, Field(ge=-90, le=90)], ...], Field(min_length=1)]
    """Elevations of the camera seen from the target, above the support's plane."""
    roll_deg: Degrees = 0.0
    """Roll of the camera about its line of sight."""
    lights: Lights | None = None
    """Lights of these views; the plan's if not given."""


class Joints(Model):
    """One view from given joint angles of the arm."""

    kind: Literal["joints"]
    """One view, from angles of the arm."""
    name: Name
    """Name of the view, in shot ids and file names."""
    joints_deg: tuple[Degrees, Degrees, Degrees, Degrees, Degrees, Degrees]
    """Angles of the six axes, from the base on."""
    lights: Lights | None = None
    """Lights of this view; the plan's if not given."""


View = Annotated[LookAt | Grid | Joints, Field(discriminator="kind")]


class FixedExposure(Model):
    kind: Literal["fixed"]
    """One exposure for each light."""
    exposure_us: ExposureUs
    """Exposure time."""

    @property
    def exposures_us(self) -> tuple[int, ...]:
        return (self.exposure_us,)

    @property
    def frames_of_light(self) -> int:
        """Frames of each light, at most."""
        return 1


class BracketExposure(Model):
    """Each light at each of several exposures, shortest first as written."""

    kind: Literal["bracket"]
    """Several exposures for each light."""
    exposures_us: Annotated[tuple[ExposureUs, ...], Field(min_length=2, max_length=16)]
    """Exposure times, each longer than the one before."""

    @field_validator("exposures_us")
    @classmethod
    def _increasing(cls, exposures_us: tuple[int, ...]) -> tuple[int, ...]:
        if any(b <= a for a, b in pairwise(exposures_us)):
            raise ValueError("increasing exposures, each longer than the one before")
        return exposures_us

    @property
    def frames_of_light(self) -> int:
        """Frames of each light, at most."""
        return len(self.exposures_us)


STEPS_PER_STOP = 4
"""Exposure times of `auto` that lie within a factor of two of each other."""


class AutoExposure(Model):
    """Exposures that are chosen in the run, for each view and LED, from frames already proven of the view.

    The times among which is chosen are known beforehand, so that `e5` is the same time in all views and sessions.
    """

    kind: Literal["auto"]
    """Exposures that are chosen in the run, for each LED."""
    shortest_us: ExposureUs = 500
    """Shortest exposure that may be chosen."""
    longest_us: ExposureUs
    """Longest exposure that may be chosen: it bounds time, heat and light."""
    clipped_share: Annotated[float, Field(ge=1e-6, le=0.5)] = 1e-3
    """Share of a picture's pixels that may be clipped in the shortest exposure of an LED."""
    snr: Annotated[float, Field(ge=1, le=1000)] = 30.0
    """Signal over noise that pixels reach in an LED's exposures together."""
    object_share: Annotated[float, Field(ge=0.01, le=0.999)] = 0.9
    """Share of the object's pixels under each LED's direct light that reach it."""
    most_exposures: Annotated[int, Field(ge=2, le=4)] = 3
    """Exposures of one LED in one view, at most."""
    first_lights: Annotated[int, Field(ge=4, le=200)] = 24
    """LEDs of the first pass, spread over the dome; never more than an eighth of the view's, but six."""

    @model_validator(mode="after")
    def _a_range(self) -> AutoExposure:
        if self.longest_us < 2 * self.shortest_us:
            raise ValueError(
                f"a `longest_us` of at least twice `shortest_us` ({self.shortest_us}); found {self.longest_us}"
            )
        return self

    @property
    def exposures_us(self) -> tuple[int, ...]:
        """Times among which is chosen, four to the stop: their places are those of shot ids."""
        stops = math.log2(self.longest_us / self.shortest_us)
        count = math.ceil(STEPS_PER_STOP * stops - 1e-9)
        times_us = {round(self.shortest_us * 2.0 ** (step / STEPS_PER_STOP)) for step in range(count)}
        return (*sorted(times_us - {self.longest_us}), self.longest_us)

    @property
    def frames_of_light(self) -> int:
        """Frames of each light, at most."""
        return self.most_exposures


Exposures = Annotated[FixedExposure | BracketExposure | AutoExposure, Field(discriminator="kind")]


class MeasuredObject(Model):
    """The object on the support: its id, mesh, pose and dose budget."""

    id: Name
    """Id of the object whose dose is kept in the ledger: an accession number."""
    mesh: FilePath | None = None
    """PLY, STL or OBJ; for collisions, occlusion, dose and pictures."""
    mesh_unit: Literal["mm", "m", "um"] = "mm"
    """Unit of the coordinates in the mesh."""
    support_from_object: Pose = Pose()
    """Pose of the mesh's frame on the support."""
    dose_budget_lux_h: Annotated[float, Field(gt=0, le=1e9)] | None = None
    """Light that the object may receive in its life; not limited if not given."""


class Optics(Model):
    """The intended lens settings; preflight compares them with the rig."""

    focus_distance_mm: Length | None = None
    """Distance from the projection centre to which the lens is to be focused."""
    f_number: Annotated[float, Field(gt=0, le=1000)] | None = None
    """F-number to which the aperture is to be set."""


class Plan(Model):
    """One acquisition."""

    schema_version: Literal[1]
    """Version of the format of plans."""
    name: Name
    """Ends the name of the run's folder."""
    rig: FilePath
    """The rig's file, relative to the plan."""
    object: MeasuredObject | None = None
    """Object that lies on the support."""
    optics: Optics = Optics()
    """The lens settings that are meant."""
    calibrations: Literal["none"] | tuple[FilePath, ...] | None = None
    """Records that must be in force; None: those that the rig names."""
    views: Annotated[tuple[View, ...], Field(min_length=1)]
    """Views from which the camera takes its pictures."""
    order: Literal["fastest", "as_written"] = "fastest"
    """Order of the views: on the shortest path, or as written."""
    lights: Lights
    """Lights of each view that has none of its own."""
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1
    """Frames of each light at each exposure."""
    hidden_lights: Literal["mark", "skip"] = "mark"
    """LEDs that arm, camera or object hide from everything that a view sees: taken and marked, or left out."""
    exposure: Exposures
    """One exposure time, or several."""
    gain_db: Annotated[float, Field(ge=0, le=42)] = 0.0
    """Gain of the camera's amplifier."""
    darks_per_view: Annotated[int, Field(ge=0, le=1000)] = 2
    """Frames without light in each view."""
    trigger: Literal["hardware", "software"] = "hardware"
    """The camera is triggered by the LED box, or by the host, light by light."""
    reshoot_limit: Annotated[int, Field(ge=0, le=20)] = 3
    """Number of times that frames which are not proven are taken again, at most."""
    licence: Words | None = None
    """Terms under which the run's data may be used; None: the rig's. For the run's README.txt."""
    contact: Words | None = None
    """Whom to ask about the data; None: the rig's."""

    @model_validator(mode="after")
    def _something_to_shoot(self) -> Plan:
        lights = [view.lights or self.lights for view in self.views]
        if any(isinstance(selection, NoLights) for selection in lights) and self.darks_per_view == 0:
            raise ValueError("lights, or at least one dark frame per view: a view would shoot nothing")
        return self

    @property
    def chooses_lights(self) -> bool:
        """True if LEDs of some view are chosen in the run."""
        return any(isinstance(view.lights or self.lights, AdaptiveLights) for view in self.views)

    @model_validator(mode="after")
    def _one_exposure_of_chosen_lights(self) -> Plan:
        if not self.chooses_lights:
            return self
        if not isinstance(self.exposure, FixedExposure) or self.repeats > 1:
            raise ValueError("`exposure: {kind: fixed}` and `repeats: 1` with `lights: {kind: adaptive}`")
        if any(isinstance(view.lights or self.lights, NoLights | Panels) for view in self.views):
            raise ValueError("LEDs in each view with `lights: {kind: adaptive}` in one; no panels, no darks alone")
        return self

    @model_validator(mode="after")
    def _lights_to_expose_for(self) -> Plan:
        if not isinstance(self.exposure, AutoExposure):
            return self
        lights = [view.lights or self.lights for view in self.views]
        if any(isinstance(selection, NoLights | Panels) for selection in lights):
            raise ValueError("LEDs in each view with `exposure: {kind: auto}`; panels and darks have no choice")
        if self.repeats > 1:
            raise ValueError("`repeats: 1` with `exposure: {kind: auto}`: its `snr` says how often light is taken")
        return self
