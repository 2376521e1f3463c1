"""The restoration file: hypotheses with their sources and materials, and the settings of their pictures
(docs/reference/restorations.md).

Lengths are mm, angles degrees; z is up in the scene, and the object's front faces -y.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from coupole.appearance.render.lights import Light
from coupole.appearance.render.materials import Material
from coupole.appearance.render.model import Model, Pose
from coupole.appearance.render.objects import Object
from coupole.appearance.render.scene_file import (
    Bands,
    Camera,
    Display,
    FieldOfView,
    Name,
    Outputs,
    Pixels,
    Scene,
    files,
)
from coupole.errors import InputError, Problem
from coupole.heritage.restoration.painted_mesh import Floats
from coupole.heritage.restoration.parts_file import PartName
from coupole.plan import yamlfile
from coupole.plan.yamlfile import Document

_MARGIN = 1.08
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)

SourceText = Annotated[str, Field(min_length=1, max_length=2000)]


class Source(Model):
    """Source of a hypothesis: a person, publication or analysis."""

    says: SourceText
    """Statement of the source, in the author's own words."""
    reference: SourceText
    """Citation of a publication, archive, analysis or person."""

    def __str__(self) -> str:
        return f"{self.reference}: {self.says}"


class Hypothesis(Model):
    """One state that the object may have had."""

    name: Name
    title: SourceText
    sources: Annotated[tuple[Source, ...], Field(min_length=1)]
    materials: Annotated[dict[PartName, Material], Field(min_length=1)]
    """Materials of every part."""


class Turntable(Model):
    """Cameras around the object, far enough to see all of it; the first one sees its front."""

    kind: Literal["turntable"]
    views: Annotated[int, Field(ge=1, le=360)] = 8
    height_deg: Annotated[float, Field(gt=-90, lt=90)] = 8.0
    field_deg: Annotated[float, Field(ge=2, le=90)] = 24.0
    width_px: Pixels = 800
    height_px: Pixels = 1000


class Cameras(Model):
    kind: Literal["cameras"]
    cameras: Annotated[tuple[Camera, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _differ(self) -> Cameras:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise ValueError("two cameras have the same name; their pictures would overwrite each other")
        return self


class Auto(Model):
    """Views from the front, and from a direction turned by 35 degrees."""

    kind: Literal["auto"]
    width_px: Pixels = 800
    height_px: Pixels = 1000


Views = Literal["auto"] | Annotated[Turntable | Cameras | Auto, Field(discriminator="kind")]


class OtherLights(Model):
    """Lights that may be used instead of `lights`."""

    name: Name
    lights: Annotated[tuple[Light, ...], Field(min_length=1)]


class RestorationFile(Model):
    schema_version: Literal[1]
    name: Name
    object: Pose = Pose()
    """Pose of the mesh in the scene."""
    smooth: bool = True
    """True for smooth shading, also across the borders of parts."""
    hypotheses: Annotated[tuple[Hypothesis, ...], Field(min_length=1)]
    views: Views = "auto"
    """Views. The word `auto` alone means the kind `auto` with its defaults."""
    lights: Annotated[tuple[Light, ...], Field(min_length=1)]
    other_lights: tuple[OtherLights, ...] = ()
    """Other sets of lights for the same hypotheses, each with a name."""
    surroundings: tuple[Object, ...] = ()
    """Other things of the scene: a floor, a niche."""
    observer: Literal["10 deg", "2 deg"] = "10 deg"
    bands: Bands = Bands(step_nm=20)
    samples: Annotated[int, Field(ge=1, le=1_000_000)] = 64
    noise: Annotated[float, Field(gt=0, lt=1)] | None = None
    depth: Annotated[int, Field(ge=1, le=100)] = 6
    seed: Annotated[int, Field(ge=0, le=2**31)] = 1
    display: Display = Display()
    """Display of all pictures. Without `white_cd_m2`, one level is used for all hypotheses and views."""
    outputs: Outputs = Outputs()

    @model_validator(mode="after")
    def _names(self) -> RestorationFile:
        names = [hypothesis.name for hypothesis in self.hypotheses]
        if len(set(names)) < len(names):
            raise ValueError("two hypotheses have the same name; their pictures would overwrite each other")
        set_names = [light_set.name for light_set in self.other_lights]
        if len(set(set_names)) < len(set_names):
            raise ValueError("two of `other_lights` have the same name; nobody could tell them apart")
        if not self.outputs.xyz:
            raise ValueError(
                "`outputs: {xyz: false}`: pictures are shown and compared by X, Y, Z; leave this setting out"
            )
        return self


class Stage(Scene):
    """A scene that may have no objects, because the restored object is given as pieces."""

    objects: tuple[Object, ...] = ()


def read_restoration(path: Path) -> tuple[Document, RestorationFile]:
    """Read and check a file, and the existence of the files that it names. Raises InputError with
    file:line:column."""
    document = yamlfile.read_document(path)
    restoration = document.validate(RestorationFile)
    missing = [
        document.problem(at, f"no such file: {document.resolve(file)}")
        for at, file in _files(restoration)
        if not document.resolve(file).is_file()
    ]
    if missing:
        raise InputError(missing)
    return document, restoration


@dataclass(frozen=True)
class Choice:
    """The part of a restoration file to render, and its fineness."""

    hypotheses: tuple[str, ...] = ()
    """Names of hypotheses; all if empty."""
    lights: str | None = None
    """Name of a set of `other_lights`."""
    samples: int | None = None
    width_px: int | None = None
    step_nm: int | None = None


def chosen_file(document: Document, restoration_file: RestorationFile, choice: Choice) -> RestorationFile:
    """Return the file with the chosen lights, and fewer samples, narrower pictures or coarser bands, for a quick
    look. Raises InputError for unknown lights, and for a step other than 5, 10, 20 or 40 nm."""
    if choice.step_nm not in {None, 5, 10, 20, 40}:
        raise InputError(f"--step: expected 5, 10, 20 or 40, found {choice.step_nm}; choose one of them")
    changes: dict[str, Any] = {"other_lights": ()}
    if choice.lights:
        by_name = {light_set.name: light_set.lights for light_set in restoration_file.other_lights}
        if choice.lights not in by_name:
            known_names = ", ".join(by_name) or "none; name some as `other_lights`"
            raise InputError(
                f"--lights {choice.lights}: expected one of the lights of {document.path}: {known_names}"
            )
        changes["lights"] = by_name[choice.lights]
    if choice.samples:
        changes["samples"] = choice.samples
    if choice.step_nm:
        changes["bands"] = Bands.model_validate({"step_nm": choice.step_nm})
    if choice.width_px:
        changes["views"] = _narrowed_views(_in_full(restoration_file.views), choice.width_px)
    return restoration_file.model_copy(update=changes)


def named_files(restoration_file: RestorationFile, document: Document) -> tuple[Path, ...]:
    """Return all files that a restoration file names, each once."""
    return tuple(dict.fromkeys(document.resolve(named_path) for _, named_path in _files(restoration_file)))


def chosen_hypotheses(
    document: Document, restoration_file: RestorationFile, names: Sequence[str]
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses with these names, in the file's order; all if no names are given. Raises InputError
    for an unknown name."""
    known_names = [hypothesis.name for hypothesis in restoration_file.hypotheses]
    if unknown := [name for name in names if name not in known_names]:
        raise InputError(f"--hypothesis {unknown[0]}: expected one of {', '.join(known_names)} of {document.path}")
    return tuple(candidate for candidate in restoration_file.hypotheses if not names or candidate.name in names)


def names_of_parts(restoration_file: RestorationFile) -> list[str]:
    """Return the names of the parts with materials in the hypotheses, in the file's order."""
    return list(dict.fromkeys(name for hypothesis in restoration_file.hypotheses for name in hypothesis.materials))


def expect_parts(document: Document, restoration_file: RestorationFile, names: Sequence[str], parts: Path) -> None:
    """Raise InputError unless every hypothesis has a material for each part, and for no other."""
    problems: list[Problem] = []
    for number, hypothesis in enumerate(restoration_file.hypotheses):
        at = ("hypotheses", number, "materials")
        for name in hypothesis.materials:
            if name not in names:
                message = f"{parts} has no part {name!r}; it has {', '.join(names)}"
                problems.append(document.problem((*at, name), message))
        for name in names:
            if name not in hypothesis.materials:
                message = (
                    f"hypothesis {hypothesis.name} has no material for the part {name!r} of {parts}; give one"
                )
                problems.append(document.problem(at, message))
    if problems:
        raise InputError(problems)


def cameras_of(restoration_file: RestorationFile, low_mm: Floats, high_mm: Floats) -> tuple[Camera, ...]:
    """Return the cameras for an object with this box in the scene's frame."""
    match _in_full(restoration_file.views):
        case Cameras() as given:
            return given.cameras
        case Turntable() as table:
            names = [f"view{number:03d}" for number in range(table.views)]
            turns = np.arange(table.views) * 360.0 / table.views
        case Auto() as auto:
            names, turns = ["front", "turned"], np.array([0.0, 35.0])
            table = Turntable(kind="turntable", width_px=auto.width_px, height_px=auto.height_px)
    corners = low_mm + _CORNERS * (high_mm - low_mm)
    return tuple(_about(name, float(turn), table, corners) for name, turn in zip(names, turns, strict=True))


# -- helpers --------------------------------------------------------------------------------------------------


def _in_full(views: Views) -> Turntable | Cameras | Auto:
    return Auto(kind="auto") if views == "auto" else views


def _narrowed_views(views: Turntable | Cameras | Auto, width_px: int) -> Turntable | Cameras | Auto:
    if isinstance(views, Cameras):
        return views.model_copy(
            update={"cameras": tuple(camera.narrowed_to(width_px) for camera in views.cameras)}
        )
    if width_px >= views.width_px:
        return views
    height_px = max(4, round(views.height_px * width_px / views.width_px))
    return views.model_copy(update={"width_px": width_px, "height_px": height_px})


def _about(name: str, turn_deg: float, table: Turntable, corners: Floats) -> Camera:
    """Return a camera that sees all corners [8, 3], turned from -y towards +x."""
    turn, height = np.radians([turn_deg, table.height_deg])
    back = np.array([np.sin(turn) * np.cos(height), -np.cos(turn) * np.cos(height), np.sin(height)])
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    up = np.cross(back, right)
    middle = corners.mean(axis=0)
    wide = np.tan(np.radians(table.field_deg / 2))
    ways = corners - middle
    reach = np.maximum(np.abs(ways @ right) / wide, np.abs(ways @ up) / (wide * table.height_px / table.width_px))
    distance_mm = float((_MARGIN * reach + ways @ back).max())
    x, y, z = (float(value) for value in middle + distance_mm * back)
    return Camera(
        name=name,
        position_mm=(x, y, z),
        target_mm=(float(middle[0]), float(middle[1]), float(middle[2])),
        optics=FieldOfView(kind="field", degrees=table.field_deg),
        width_px=table.width_px,
        height_px=table.height_px,
    )


def _files(restoration_file: RestorationFile) -> Iterator[tuple[tuple[str | int, ...], Path]]:
    yield from files(restoration_file)
    for number, hypothesis in enumerate(restoration_file.hypotheses):
        for part, material in hypothesis.materials.items():
            yield from files(material, ("hypotheses", number, "materials", part))
