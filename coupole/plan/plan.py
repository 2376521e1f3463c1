"""The plan: views, lights, exposures and object.

Positions are in the support frame (disk centre, z up), in mm; angles in degrees. Every model is frozen and refuses
unknown keys. `coupole.plan.yamlfile` reports refusals with file:line:column.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from coupole.plan.base_model import Degrees, FilePath, Length, Model, Name, Pose, Vector, Words
from coupole.plan.exposures import AutoExposure, Exposures, FixedExposure
from coupole.plan.plan_lights import AdaptiveLights, Lights, NoLights, Panels
from coupole.plan.watch import DARKS_ONLY, EVERYTHING, NOTHING, Watch


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
    """Lights of this view. Without it, the plan's lights are used."""


class Grid(Model):
    """Views from all pairs of azimuth and elevation, named `<name>-az<azimuth>-el<elevation>`."""

    kind: Literal["grid"]
    """Views from all pairs of azimuth and elevation."""
    name: Name
    """First part of the names of the views."""
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
    """Lights of these views. Without it, the plan's lights are used."""


class Joints(Model):
    """One view from given joint angles of the arm."""

    kind: Literal["joints"]
    """One view, from angles of the arm."""
    name: Name
    """Name of the view, in shot ids and file names."""
    joints_deg: tuple[Degrees, Degrees, Degrees, Degrees, Degrees, Degrees]
    """Angles of the six axes, beginning at the base."""
    lights: Lights | None = None
    """Lights of this view. Without it, the plan's lights are used."""


View = Annotated[LookAt | Grid | Joints, Field(discriminator="kind")]
_Candidates = Annotated[tuple[View, ...], Field(min_length=1)]


class EnoughViews(Model):
    """Limits that end the choice of views. The first one that is reached ends it. Time, light and frames are the
    plan's: frames that are taken again are not counted."""

    views: Annotated[int, Field(ge=1, le=400)]
    """Greatest number of views."""
    frames: Annotated[int, Field(ge=1)] | None = None
    """Greatest number of frames, dark frames included."""
    seconds: Annotated[float, Field(gt=0)] | None = None
    """Greatest time of motions and bursts."""
    lux_h: Annotated[float, Field(gt=0)] | None = None
    """Greatest light at the object's point that receives most, by the LED table."""
    coverage: Annotated[float, Field(gt=0, le=1)] | None = None
    """Share of the surface that is shown sharply and not too obliquely by a view, of all that the candidates
    show."""
    gain: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Expected decrease of the uncertainty by the best further view, as a share. A smaller decrease is not worth a
    view."""


class AdaptiveViews(Model):
    """Views that are chosen in the run, one after the other."""

    kind: Literal["adaptive"]
    """Views that are chosen in the run, one after the other."""
    candidates: _Candidates
    """Views that may be chosen. All of them get the plan's lights."""
    until: EnoughViews
    """Limits at which the choice ends."""

    @field_validator("candidates")
    @classmethod
    def _plan_lights(cls, candidates: tuple[View, ...]) -> tuple[View, ...]:
        if names := [view.name for view in candidates if view.lights is not None]:
            raise ValueError(
                f"candidates without `lights` of their own, because all use the plan's lights; found `lights` in "
                f"{names}"
            )
        return candidates


class MeasuredObject(Model):
    """The object on the support: its id, mesh, pose and dose budget."""

    id: Name
    """Id of the object, under which the ledger keeps its dose: for example an accession number."""
    mesh: FilePath | None = None
    """PLY, STL or OBJ file. It is used for collisions, occlusion, dose and pictures."""
    mesh_unit: Literal["mm", "m", "um"] = "mm"
    """Unit of the coordinates in the mesh."""
    support_from_object: Pose = Pose()
    """Pose of the mesh's frame on the support."""
    dose_budget_lux_h: Annotated[float, Field(gt=0, le=1e9)] | None = None
    """Light that the object may receive in its life. Without it, there is no limit."""


class Optics(Model):
    """The intended lens settings; preflight compares them with the rig."""

    focus_distance_mm: Length | None = None
    """Distance from the projection centre to which the lens is to be focused."""
    f_number: Annotated[float, Field(gt=0, le=1000)] | None = None
    """F-number to which the aperture is to be set."""


def _way(watch: bool | Watch) -> Watch:
    return {True: EVERYTHING, False: NOTHING}[watch] if isinstance(watch, bool) else watch


class Plan(Model):
    """One acquisition."""

    schema_version: Literal[1]
    """Version of the format of plans."""
    name: Name
    """Name of the run: the last part of the run folder's name."""
    rig: FilePath
    """The rig's file, relative to the plan."""
    object: MeasuredObject | None = None
    """Object that lies on the support."""
    optics: Optics = Optics()
    """The intended lens settings."""
    calibrations: Literal["none"] | tuple[FilePath, ...] | None = None
    """Records that must be in force. Without it, the records that the rig names are used."""
    views: Annotated[tuple[View, ...], Field(min_length=1)] | AdaptiveViews
    """Views from which the camera takes its pictures, or the way to choose them."""
    order: Literal["fastest", "as_written"] = "fastest"
    """Order of the views: on the shortest path, or as written."""
    lights: Lights
    """Lights of each view that has none of its own."""
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1
    """Frames of each light at each exposure."""
    hidden_lights: Literal["mark", "skip"] = "mark"
    """LEDs that arm, camera or object hide from everything that a view shows. Frames of these LEDs are taken and
    marked (`mark`), or left out (`skip`).
    """
    exposure: Exposures
    """Exposure of the frames: one time, or several."""
    gain_db: Annotated[float, Field(ge=0, le=42)] = 0.0
    """Gain of the camera's amplifier."""
    darks_per_view: Annotated[int, Field(ge=0, le=1000)] = 2
    """Frames without light in each view."""
    trigger: Literal["hardware", "software"] = "hardware"
    """The LED box triggers the camera (`hardware`), or the host triggers it light by light (`software`)."""
    reshoot_limit: Annotated[int, Field(ge=0, le=20)] = 3
    """Greatest number of attempts to take unproven frames again."""
    discard: Literal["after_fit"] | None = None
    """`after_fit`: frames are discarded when their samples are safe, except the frames that the check needs."""
    watch: bool | Watch = DARKS_ONLY
    """Watching of the run: `true`, `false`, or its settings. Without it, only dark frames are watched."""
    licence: Words | None = None
    """Terms under which the run's data may be used, for the run's README.txt. Without it, the rig's are used."""
    contact: Words | None = None
    """Person to ask about the data. Without it, the rig's contact is used."""

    @field_validator("watch")
    @classmethod
    def _no_sentinels_of_choices(cls, watch: bool | Watch, info: ValidationInfo) -> bool | Watch:
        views = info.data.get("views", ())
        entries = views.candidates if isinstance(views, AdaptiveViews) else views
        selections = [view.lights or info.data.get("lights") for view in entries]
        has_choice = any(isinstance(selection, AdaptiveLights) for selection in selections)
        if _way(watch).frames == "all" and (has_choice or isinstance(info.data.get("exposure"), AutoExposure)):
            raise ValueError(
                "expected `watch: {frames: darks}`, or no `watch`: LEDs or exposures are chosen in the run, so "
                "no LED can be planned to be lit again and again"
            )
        return watch

    @model_validator(mode="after")
    def _something_to_shoot(self) -> Plan:
        lights = [view.lights or self.lights for view in self.view_entries]
        if any(isinstance(selection, NoLights) for selection in lights) and self.darks_per_view == 0:
            raise ValueError("lights, or at least one dark frame per view: otherwise a view takes no frame")
        return self

    @property
    def view_entries(self) -> tuple[View, ...]:
        """The entries of `views`. If views are chosen in the run, these are the candidates."""
        return self.views.candidates if isinstance(self.views, AdaptiveViews) else self.views

    @property
    def chooses_views(self) -> bool:
        """True if views are chosen in the run."""
        return isinstance(self.views, AdaptiveViews)

    @property
    def views_key(self) -> tuple[str | int, ...]:
        """Key path of the entries of `views`."""
        return ("views", "candidates") if isinstance(self.views, AdaptiveViews) else ("views",)

    @property
    def why_with_result(self) -> str:
        """Return why the plan cannot be run without `--reflectance`; empty if it can."""
        if self.discard is None:
            return ""
        return (
            "expected a run with `--reflectance`: frames are discarded only when their samples are safe, and "
            "without `--reflectance` no samples are taken. Without `discard` all frames are kept"
        )

    @property
    def watching(self) -> Watch:
        """The way in which the run is watched."""
        return _way(self.watch)

    @property
    def takes_sentinels(self) -> bool:
        """True if some LEDs are lit again and again to show changes."""
        return self.watching.frames == "all"

    @property
    def skips_hidden_lights(self) -> bool:
        """True if LEDs that light nothing that a view shows are left out of the view. A choice never takes
        them."""
        return self.hidden_lights == "skip" or self.chooses_lights

    @property
    def chooses_lights(self) -> bool:
        """True if LEDs of some view are chosen in the run."""
        return any(isinstance(view.lights or self.lights, AdaptiveLights) for view in self.view_entries)

    @model_validator(mode="after")
    def _an_object_to_choose_views_of(self) -> Plan:
        if not isinstance(self.views, AdaptiveViews):
            return self
        if self.object is None or self.object.mesh is None:
            raise ValueError(
                "an object with a `mesh` with `views: {kind: adaptive}`: a view is chosen by the part of "
                "the object that it shows"
            )
        if self.lights.kind in ("none", "panels"):
            raise ValueError("LEDs with `views: {kind: adaptive}`; panels and darks alone cannot be judged")
        if self.order == "as_written":
            raise ValueError("no `order: as_written` with `views: {kind: adaptive}`, which chooses the order too")
        if self.discard is not None:
            raise ValueError(
                "no `discard` with `views: {kind: adaptive}`: how much disk space it needs is not known beforehand"
            )
        return self

    @model_validator(mode="after")
    def _one_exposure_of_chosen_lights(self) -> Plan:
        if not self.chooses_lights:
            return self
        if not isinstance(self.exposure, FixedExposure) or self.repeats > 1:
            raise ValueError("`exposure: {kind: fixed}` and `repeats: 1` with `lights: {kind: adaptive}`")
        if any(isinstance(view.lights or self.lights, NoLights | Panels) for view in self.view_entries):
            raise ValueError(
                "LEDs in each view, if one view has `lights: {kind: adaptive}`; panels or dark frames alone are "
                "not allowed"
            )
        return self

    @model_validator(mode="after")
    def _lights_to_expose_for(self) -> Plan:
        if not isinstance(self.exposure, AutoExposure):
            return self
        lights = [view.lights or self.lights for view in self.view_entries]
        if any(isinstance(selection, NoLights | Panels) for selection in lights):
            raise ValueError(
                "LEDs in each view with `exposure: {kind: auto}`; exposures of panels and darks cannot be chosen"
            )
        if self.repeats > 1:
            raise ValueError(
                "`repeats: 1` with `exposure: {kind: auto}`: its `snr` determines the number of exposures"
            )
        return self
