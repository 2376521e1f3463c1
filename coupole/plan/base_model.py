"""The base of all models of plans and rigs: names, numbers with their bounds, poses.

Every model is frozen and refuses unknown keys.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetJsonSchemaHandler

from coupole.errors import InputError
from coupole.geometry import Transform, transform
from coupole.intake.user_home import with_home

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
Name = Annotated[str, Field(pattern=NAME_PATTERN)]
"""Letters, digits, dot, underscore and hyphen, because it becomes part of file names and shot ids."""
Words = Annotated[str, Field(min_length=1, max_length=500)]
Millimetres = Annotated[float, Field(ge=-20_000, le=20_000)]
"""A coordinate in a cell. The bound of 20 m is larger than any cell."""
Vector = tuple[Millimetres, Millimetres, Millimetres]
Length = Annotated[float, Field(gt=0, le=20_000)]
"""A length in mm."""
Degrees = Annotated[float, Field(ge=-360.0, le=360.0)]
Angles = tuple[Degrees, Degrees, Degrees]
ExposureUs = Annotated[int, Field(ge=10, le=2_000_000)]
LedId = Annotated[int, Field(ge=0, le=65534)]


def possible_path(path: Path) -> Path:
    """Return the path itself. Raises ValueError if no file can have it."""
    if any(len(part.encode("utf-8", "replace")) > 255 for part in path.parts) or len(str(path)) > 2000:
        raise ValueError("a path of at most 2000 characters, each of its names of at most 255 bytes")
    if "\0" in str(path):
        raise ValueError("a path without NUL characters")
    if str(path).startswith("~"):
        try:
            with_home(path)
        except InputError as error:
            raise ValueError(f"a path in the home folder of a user of this machine: {error}") from error
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
    """x, y and z, mm."""
    abc_deg: Angles = (0.0, 0.0, 0.0)
    """KUKA's A, B, C, degrees: turns about z, then the new y, then the new x."""

    def matrix(self) -> Transform:
        return transform(self.translation_mm, self.abc_deg)
