"""Requests to a bench: one line of JSON each, `{"version": 1, "command": ..., ...}`.

Values are not converted, and other fields are not allowed. docs/reference/bench.md describes the answers.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

from coupole.errors import InputError

VERSION = 1
_MOST_SAID = 6
Axis = Literal["A1", "A2", "A3", "A4", "A5", "A6", "x", "y", "z", "rx", "ry", "rz"]
"""An axis of the arm, or an axis of the robot's base frame. The camera moves along a base axis (`x`) or turns
about it (`rx`)."""
_Finite = Annotated[float, Field(allow_inf_nan=False)]


def _no_truth_value(value: object) -> object:
    """Refuse true and false, which are equal to the numbers 1 and 0."""
    assert not isinstance(value, bool), "expected a number, found true or false"
    return value


class _Request(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    version: Literal[1]


class StateAsked(_Request):
    command: Literal["state"]


class SelfTestAsked(_Request):
    command: Literal["self_test"]
    device: Literal["ledbox", "camera", "robot"]


class ViewOf(BaseModel):
    """A view of a plan."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    view: str
    plan: str
    """The plan's file, an absolute path."""


class Posture(BaseModel):
    """Joint angles."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    joints_deg: Annotated[list[_Finite], Field(min_length=6, max_length=6)]


class PathAsked(_Request):
    command: Literal["plan_path"]
    to: Literal["home", "park"] | ViewOf | Posture


class DriveAsked(_Request):
    command: Literal["drive"]
    path: str
    """The id that `plan_path` gave."""


class StopAsked(_Request):
    command: Literal["stop"]
    why: Annotated[str, Field(max_length=400)] = ""
    """The reason, in words, for the process that requested the work that is stopped."""


class JogAsked(_Request):
    command: Literal["jog"]
    axis: Axis
    direction: Annotated[Literal[1, -1], BeforeValidator(_no_truth_value)]
    share: Annotated[float, Field(ge=0.01, le=1)] = 0.4
    """Share of reduced speed, 250 mm/s."""
    hold: int | None = None
    """The number in the first answer. A request without it counts as a new press of the button."""
    at: Annotated[str, Field(alias="from")]
    """Origin of the request: an address in the rig's `console: at_the_cell:`."""


_Gain = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]
_Gains = Annotated[list[_Gain], Field(min_length=3, max_length=3)]
_Region = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=4, max_length=4)]
"""x, y, width, height in the sensor's pixels."""


class FrameAsked(_Request):
    command: Literal["frame"]
    lights: Annotated[list[int], Field(max_length=16)] = []
    """Ids of LEDs. Each LED gives a picture, and the pictures are added up."""
    panels: Annotated[list[int], Field(max_length=4)] = []
    """Numbers of panels, from 1. Each panel gives a picture, and the pictures are added up."""
    exposure_us: Annotated[int, Field(ge=10)]
    """Exposure time of each picture."""
    gain_db: Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)] = 0.0
    region: _Region | None = None
    """Region of the picture for which separate figures are computed."""
    width_px: Annotated[int, Field(ge=16, le=8192)] = 960
    """Greatest width of the JPEG."""
    marks: list[Literal["saturation", "focus"]] = []
    gains: _Gains = [1.0, 1.0, 1.0]
    """White point: factors of R, G, B in the JPEG."""
    stops: Annotated[int, Field(ge=0)] | None = None
    """Number of stops, from a state. No LED is lit if another stop came since that state."""


class LoupeAsked(_Request):
    command: Literal["loupe"]
    region: _Region
    gains: _Gains = [1.0, 1.0, 1.0]


class MeterAsked(_Request):
    command: Literal["meter"]
    plan: str
    """The plan's file, an absolute path."""
    saturated: Annotated[float, Field(ge=0, le=0.5)] = 1e-3
    snr: Annotated[float, Field(ge=1, le=10_000)] = 30.0
    share: Annotated[float, Field(ge=0.01, le=1)] = 0.9


class CloseAsked(_Request):
    command: Literal["close"]


Request = (
    StateAsked
    | SelfTestAsked
    | PathAsked
    | DriveAsked
    | StopAsked
    | JogAsked
    | FrameAsked
    | LoupeAsked
    | MeterAsked
    | CloseAsked
)
_REQUEST: TypeAdapter[Request] = TypeAdapter(Annotated[Request, Field(discriminator="command")])


def read_request(line: bytes) -> Request:
    """Raises InputError for anything that is not a request of this version."""
    try:
        return _REQUEST.validate_json(line)
    except ValidationError as error:
        problems = [
            (".".join(map(str, problem["loc"])) or "request", problem["msg"])
            for problem in error.errors()[:_MOST_SAID]
        ]
        raise InputError("; ".join(f"{where}: {message}" for where, message in problems)) from error
