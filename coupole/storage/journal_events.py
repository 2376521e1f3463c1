"""Events of a run's journal: one frozen model for each, distinguished by its tag `event`.

To add an event: write its model here, add it to `Event`, and handle it where the type checker then reports
`assert_never`. Angles are in degrees, transforms 4x4 in mm. Fields that version 0.1 did not write have a default.
"""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer

from coupole.plan.shot_id import ShotId
from coupole.storage.inner_path import InnerPath
from coupole.storage.line_file import utc_now

JOURNAL_VERSION = 2


def _shot(value: object) -> object:
    return ShotId.parse(value) if isinstance(value, str) else value


def _time(text: str) -> str:
    if text and datetime.fromisoformat(text).tzinfo is None:
        raise ValueError("expected a time with its zone")
    return text


Shot = Annotated[ShotId, BeforeValidator(_shot), PlainSerializer(str, return_type=str)]
"""A shot's id, as text on disk."""
Joints = tuple[float, ...]


class JournalEvent(BaseModel):
    """Frozen; unknown keys are errors."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    t: Annotated[str, AfterValidator(_time)] = Field(default_factory=utc_now)
    """Time, UTC, ISO 8601."""


class JournalBegun(JournalEvent):
    """The first line of a journal; journals of 0.1 (version 1) do not have it."""

    event: Literal["journal"] = "journal"
    version: int = JOURNAL_VERSION


class SessionStarted(JournalEvent):
    """The run's first session has opened its devices."""

    event: Literal["start"] = "start"
    simulated: bool = False
    room_c: float | None = None
    """Temperature of the coolest LED board."""
    acknowledged: str = ""
    """The fault of the arm that the operator confirmed to be repaired."""
    dose_budget_lux_h: float | None = None
    """Light that the object may receive in its life, by its ledger and the plan, as the session begins."""
    trusted: tuple[str, ...] = ()
    """Permissions that a person gives by name in the rig (`any_controller_by`, `without_realtime_by`), in
    words."""


class SessionResumed(JournalEvent):
    """A later session of the run has opened its devices (`--resume`)."""

    event: Literal["resume"] = "resume"
    simulated: bool = False
    room_c: float | None = None
    acknowledged: str = ""
    dose_budget_lux_h: float | None = None
    trusted: tuple[str, ...] = ()


class ViewBegun(JournalEvent):
    """The arm is about to move to a view."""

    event: Literal["view"] = "view"
    view: str
    hidden_leds: tuple[int, ...] = ()
    """LEDs that are occluded from everything that this view sees."""


class MoveBegun(JournalEvent):
    """A motion of the arm begins."""

    event: Literal["move"] = "move"
    view: str
    joints_deg: tuple[Joints, ...]
    """Joint angles of each waypoint, the view's last."""


class ArmSettled(JournalEvent):
    """The arm is at rest, at this measured pose."""

    event: Literal["settled"] = "settled"
    view: str
    joints_deg: Joints
    base_from_camera: tuple[tuple[float, ...], ...]


class FrameProven(JournalEvent):
    """A shot is proven and its bytes are on disk; written once for each shot of a run."""

    event: Literal["frame"] = "frame"
    shot: Shot
    file: InnerPath
    """The view's file, relative to the run's folder."""
    index: int
    """Its slot in that file."""
    frame_id: int
    xxh3: str
    """Checksum of the frame's bytes, 16 hexadecimal digits."""


class BurstBegun(JournalEvent):
    """A burst is about to give light; synced before it does."""

    event: Literal["begin"] = "begin"
    view: str
    planned_lux_h: tuple[float, ...]
    """Largest light at each of the object's dose points."""


class BurstEnded(JournalEvent):
    """A burst has ended, complete or not; the light that it gave."""

    event: Literal["burst"] = "burst"
    view: str
    steps: int
    on_s: float
    """Sum of the on-times of its LEDs."""
    joints_before_deg: Joints | None = None
    joints_after_deg: Joints | None = None
    """None if the arm was not at rest."""
    frames: int
    table_s: float | None = None
    clocks: dict[str, float] | None = None
    """Fit of the camera's clock against the box's."""
    camera: dict[str, int] | None = None
    """The camera's counters."""
    hottest_board_c: float | None = None
    given_lux_h: tuple[float, ...] | None = None
    """Light at each of the object's dose points, in place of what was planned; None in version 0.1."""


class GapFound(JournalEvent):
    """Frames of a burst are not proven."""

    event: Literal["gap"] = "gap"
    view: str
    shots: tuple[Shot, ...]
    missing: int
    lost_in_transfer: int
    surplus: int
    dead_leds: tuple[Shot, ...] = ()
    """Shots whose LED drew no current."""
    reason: str = ""


class ReshootBegun(JournalEvent):
    """Shots are taken again."""

    event: Literal["reshoot"] = "reshoot"
    view: str
    attempt: int
    shots: tuple[Shot, ...]


class FaultNoted(JournalEvent):
    """Something failed."""

    event: Literal["fault"] = "fault"
    kind: str
    message: str
    device: str = ""
    """The device that failed, by its kind in the rig; empty if none did."""


class InputsChanged(JournalEvent):
    """Files of the run were changed on the disk after they were read; the run goes on with what was read."""

    event: Literal["changed"] = "changed"
    files: tuple[str, ...]
    """Path and what happened, a sentence each."""


class Paused(JournalEvent):
    """The operator paused the session; lights are off."""

    event: Literal["pause"] = "pause"


class Continued(JournalEvent):
    """The operator continued the session after a pause."""

    event: Literal["continue"] = "continue"


class TextUnread(JournalEvent):
    """The reader of the session's text (a terminal, a pipe) did not take it; the session did not wait for it."""

    event: Literal["unread"] = "unread"
    lost_lines: int
    lost_bytes: int
    waiting_bytes: int
    """Kept for the reader when this was written."""
    stalled_s: float
    """Time for which nothing had been taken, s."""


class ViewSealed(JournalEvent):
    """The session has finished a view, complete or not."""

    event: Literal["seal"] = "seal"
    view: str


class SessionStopped(JournalEvent):
    """The session's last line."""

    event: Literal["stop"] = "stop"
    outcome: Literal["done", "interrupted", "failed"]
    reason: str = ""
    """Why, if not all was done: who stopped it, or what failed."""
    robot: dict[str, Any] = Field(default_factory=dict)
    """Figures of the robot's link."""


Event: TypeAlias = (
    JournalBegun
    | SessionStarted
    | SessionResumed
    | ViewBegun
    | MoveBegun
    | ArmSettled
    | FrameProven
    | BurstBegun
    | BurstEnded
    | GapFound
    | ReshootBegun
    | FaultNoted
    | InputsChanged
    | Paused
    | Continued
    | TextUnread
    | ViewSealed
    | SessionStopped
)
