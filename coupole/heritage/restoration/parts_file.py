"""The parts file, which assigns the triangles of a mesh to parts such as hair, robe and stone
(docs/reference/restorations.md).

Rules are applied in their order, and later ones win. Lengths are mm in the mesh's own frame.
"""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from coupole.appearance.render.model import Model, Vector
from coupole.errors import InputError
from coupole.intake.plain_data import read_json
from coupole.plan import yamlfile
from coupole.plan.yamlfile import Document

PartName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]{0,63}$")]
Colour = Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$")]
"""sRGB as `#rrggbb`."""
Tolerance = Annotated[float, Field(ge=0, le=120)]
"""Largest distance of a colour from the table's, in 8-bit steps of sRGB."""
_MOST_BYTES = 64 * 1024**2


class VertexColours(Model):
    """A rule: a triangle belongs to the part with the colour that most of its corners have."""

    kind: Literal["vertex_colours"]
    colours: Annotated[dict[PartName, Colour], Field(min_length=1)]
    tolerance: Tolerance = 8.0


class Texture(Model):
    """A rule: a triangle belongs to the part with the colour of the picture at the triangle's middle."""

    kind: Literal["texture"]
    colours: Annotated[dict[PartName, Colour], Field(min_length=1)]
    image: Path | None = None
    """Picture that is used instead of the one named in the mesh."""
    tolerance: Tolerance = 8.0


class Box(Model):
    """A rule for triangles with their middle inside a box."""

    kind: Literal["box"]
    part: PartName
    low_mm: Vector
    high_mm: Vector

    @model_validator(mode="after")
    def _has_room(self) -> Box:
        if any(low >= high for low, high in zip(self.low_mm, self.high_mm, strict=True)):
            raise ValueError(
                "the box is empty: each number of `low_mm` must be less than the same number of `high_mm`"
            )
        return self


class HalfSpace(Model):
    """A rule for triangles with their middle on the side of a plane to which the plane's normal points."""

    kind: Literal["plane"]
    part: PartName
    point_mm: Vector
    normal: Vector

    @model_validator(mode="after")
    def _points(self) -> HalfSpace:
        if not any(self.normal):
            raise ValueError("the normal has no direction: give one of x, y, z another value than 0")
        return self


class PickedFile(Model):
    """A file from the page of `coupole restore pick`."""

    kind: Literal["picked"]
    path: Path


Rule = Annotated[VertexColours | Texture | Box | HalfSpace | PickedFile, Field(discriminator="kind")]


class PartsFile(Model):
    schema_version: Literal[1]
    rules: Annotated[tuple[Rule, ...], Field(min_length=1)]
    rest: PartName | None = None
    """The part of all triangles that no rule names. Without it, each triangle must be named by a rule."""


class PickedParts(Model):
    """Painted triangles with their mesh: base64 of little-endian numbers."""

    schema_version: Literal[1]
    kind: Literal["picked parts"]
    names: Annotated[tuple[PartName, ...], Field(min_length=1, max_length=254)]
    vertices_mm: str
    """float32 [n, 3]"""
    triangles: str
    """uint32 [m, 3]"""
    parts: str
    """uint8 [m]: 0 for not painted, k for the k-th name."""

    @field_validator("names")
    @classmethod
    def _differ(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) < len(names):
            raise ValueError("two parts have the same name")
        return names


@dataclass(frozen=True, eq=False)
class Picked:
    """Parts from a page, as numbers."""

    names: tuple[str, ...]
    vertices_mm: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    parts: NDArray[np.uint8]


def read_parts(path: Path) -> tuple[Document, PartsFile]:
    """Read a parts file, or a picked file as its only rule. Raises InputError with its place."""
    if path.suffix.lower() == ".json":
        document = _read_json(path)
        if document.data.get("kind") == "picked parts":
            return document, PartsFile(schema_version=1, rules=(PickedFile(kind="picked", path=path.resolve()),))
    else:
        document = yamlfile.read_document(path)
    return document, document.validate(PartsFile)


def read_picked(path: Path) -> Picked:
    """Read a picked file. Raises InputError if the file is of another kind, or if its numbers do not fit
    together."""
    picked_parts = _read_json(path).validate(PickedParts)
    vertices = _numbers(path, "vertices_mm", picked_parts.vertices_mm, "<f4").reshape(-1, 3)
    triangles = _numbers(path, "triangles", picked_parts.triangles, "<u4").reshape(-1, 3)
    parts = _numbers(path, "parts", picked_parts.parts, "u1", columns=1)
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: vertices_mm: expected finite coordinates; save the file from the page again")
    if len(triangles) == 0 or triangles.max() >= len(vertices) or len(parts) != len(triangles):
        raise InputError(
            f"{path}: {len(vertices)} vertices, {len(triangles)} triangles and {len(parts)} marks do not fit "
            "together; save the file from the page again"
        )
    if parts.max() > len(picked_parts.names):
        raise InputError(f"{path}: parts: found part {parts.max()}, but {len(picked_parts.names)} names")
    return Picked(picked_parts.names, vertices, triangles, parts)


# -- helpers --------------------------------------------------------------------------------------------------


def _read_json(path: Path) -> Document:
    """Read JSON as a document; its problems have the file's first line and the key."""
    try:
        if not path.is_file():
            raise InputError(f"{path}: no such file")
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{path}: expected at most {_MOST_BYTES} bytes")
        data: Any = read_json(path, allow_nan=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be read as JSON: {error}") from error
    if not isinstance(data, dict):
        raise InputError(f"{path}:1:1: expected an object of keys and values")
    return Document(path, data, {(): (1, 1)}, {}, "")


def _numbers(path: Path, key: str, text: str, kind: str, columns: int = 3) -> NDArray[Any]:
    try:
        raw = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise InputError(f"{path}: {key}: expected base64; {error}") from error
    size = np.dtype(kind).itemsize * columns
    if len(raw) % size:
        raise InputError(f"{path}: {key}: expected a multiple of {size} bytes, found {len(raw)}")
    return np.frombuffer(raw, kind)
