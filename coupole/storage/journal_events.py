"""Events of a run's journal: one frozen model for each, distinguished by its tag `event`.

To add an event: write its model here, add it to `Event`, and handle it where the type checker then reports
`assert_never`. Angles are in degrees, transforms 4x4 in mm. Fields that version 0.1 did not write have a default.
"""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer

from coupole.plan.choices import ChosenBurst
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


class ViewEvent(JournalEvent):
    """Something happened in a view."""

    event: str
    view: str
    """Name of the view."""


class JournalBegun(JournalEvent):
    """The first line of a journal; journals of 0.1 (version 1) do not have it."""

    event: Literal["journal"] = "journal"
    version: int = JOURNAL_VERSION
    """Version of the journal's format."""


class SessionBegun(JournalEvent):
    """A session of the run has opened its devices."""

    event: str
    simulated: bool = False
    """True if the devices belong to a simulated cell."""
    room_c: float | None = None
    """Temperature of the coolest LED board, C; None if the box knows none."""
    acknowledged: str = ""
    """The fault of the arm that the operator confirmed to be repaired."""
    dose_budget_lux_h: float | None = None
    """Light that the object may receive in its life, by its ledger and the plan, at the session's begin; None: no
    budget."""
    trusted: tuple[str, ...] = ()
    """Permissions that a person gives by name in the rig (`any_controller_by`, `without_realtime_by`), in
    words."""


class SessionStarted(SessionBegun):
    """The run's first session has opened its devices."""

    event: Literal["start"] = "start"


class SessionResumed(SessionBegun):
    """A later session of the run has opened its devices (`--resume`)."""

    event: Literal["resume"] = "resume"


class ProcessingAsked(JournalEvent):
    """The session is to end with a result: views are processed beside the acquisition, in another process."""

    event: Literal["processing"] = "processing"
    result: str
    """Folder of the result, an absolute path."""


class ViewBegun(ViewEvent):
    """The arm is about to move to a view."""

    event: Literal["view"] = "view"
    hidden_leds: tuple[int, ...] = ()
    """LEDs that are occluded from everything that this view shows."""


class MoveBegun(ViewEvent):
    """A motion of the arm begins."""

    event: Literal["move"] = "move"
    joints_deg: tuple[Joints, ...]
    """[waypoints, 6] angles of the axes, degrees. The last waypoint is the view's posture."""


class ArmSettled(ViewEvent):
    """The arm is at rest, at this measured pose."""

    event: Literal["settled"] = "settled"
    joints_deg: Joints
    """[6] measured angles of the axes, degrees."""
    base_from_camera: tuple[tuple[float, ...], ...]
    """[4, 4] pose of the camera by these angles, mm. It maps camera to base coordinates."""


class FrameProven(JournalEvent):
    """A shot is proven and its bytes are on disk; written once for each shot of a run."""

    event: Literal["frame"] = "frame"
    shot: Shot
    """Id of the shot, such as `top/led0417/e0`."""
    file: InnerPath
    """The view's file, relative to the run's folder."""
    index: int
    """Its slot in that file."""
    frame_id: int
    """Number that the camera gave the frame."""
    xxh3: str
    """Checksum of the frame's bytes, 16 hexadecimal digits."""


class BurstsChosen(ViewEvent):
    """The next bursts of a view were chosen. The line is synced before the first of them gives light. A resumed
    run repeats these bursts."""

    event: Literal["chosen"] = "chosen"
    bursts: tuple[ChosenBurst, ...]
    """The bursts in their order. An empty list means that the view has enough."""
    reason: str
    """The reason for these bursts, or for no more bursts."""
    figures: dict[str, Any] = Field(default_factory=dict)
    """Numbers behind the reason, and the alternatives that were weighed."""


class ViewChosen(JournalEvent):
    """The next view was chosen. The line is synced before the arm moves to it. A resumed run repeats the
    choice."""

    event: Literal["chosen_view"] = "chosen_view"
    view: str
    """Name of the view; empty if no more views are taken."""
    reason: str
    """The reason for this view, or for no more views."""
    figures: dict[str, Any] = Field(default_factory=dict)
    """Numbers behind the reason, and the best alternatives with theirs."""


class BurstBegun(ViewEvent):
    """A burst is about to give light. The line is synced before the light."""

    event: Literal["begin"] = "begin"
    planned_lux_h: tuple[float, ...]
    """Largest light at each of the object's dose points, lux h."""


class BurstEnded(ViewEvent):
    """A burst has ended, complete or not. The line has the light that it gave."""

    event: Literal["burst"] = "burst"
    steps: int
    """Number of steps that the box has run."""
    on_s: float
    """Sum of the on-times of its LEDs, s."""
    joints_before_deg: Joints | None = None
    """[6] measured angles before the burst, degrees."""
    joints_after_deg: Joints | None = None
    """[6] measured angles after the burst, degrees; None if the arm was not at rest."""
    frames: int
    """Number of frames that came from the camera."""
    table_s: float | None = None
    """Planned duration of the burst's table, s."""
    clocks: dict[str, float] | None = None
    """Fit of the camera's clock against the box's."""
    camera: dict[str, int] | None = None
    """The camera's counters."""
    hottest_board_c: float | None = None
    """Highest temperature of a board in the burst, C; None if the box knows none."""
    given_lux_h: tuple[float, ...] | None = None
    """Light at each of the object's dose points, lux h. It replaces the planned light; None in version 0.1."""


class GapFound(ViewEvent):
    """Frames of a burst are not proven."""

    event: Literal["gap"] = "gap"
    shots: tuple[Shot, ...]
    """Shots that are not proven."""
    missing: int
    """Number of steps that sent an edge and have no frame."""
    lost_in_transfer: int
    """Number of these frames that the camera exposed, but that did not arrive."""
    surplus: int
    """Number of frames that no step has triggered."""
    dead_leds: tuple[Shot, ...] = ()
    """Shots whose LED drew no current."""
    reason: str = ""
    """Reason why nothing, or not everything, could be proven. It is empty if all frames that came were proven."""


class ReshootBegun(ViewEvent):
    """Shots are taken again."""

    event: Literal["reshoot"] = "reshoot"
    attempt: int
    """Number of this attempt, from 1."""
    shots: tuple[Shot, ...]
    """Shots that are taken again."""


class FindingNoted(ViewEvent):
    """Something changed in a burst but should not have changed. This line marks the shots; they may be taken
    again."""

    event: Literal["finding"] = "finding"
    kind: str
    """Name of the finding: `ambient light`, `LED`, `drift`, `moved`, `smudge`, `exposure step` or `thing in the
    field`. It is `not watched` if the watching itself has failed and ended."""
    shots: tuple[Shot, ...]
    """Shots that it concerns."""
    figure: float
    """Size of the change."""
    limit: float
    """Limit that the figure exceeds, from the rig's figures of noise."""
    unit: str
    """Unit of figure and limit."""
    message: str
    """Description of the finding, in a sentence."""
    picture: InnerPath | Literal[""] = ""
    """A PNG file with the light before, after, and their difference, relative to the run's folder."""


class FramesDiscarded(ViewEvent):
    """Frames of a view are discarded, as its plan says, because their samples are safe. The line is synced before
    the first frame is changed."""

    event: Literal["discard"] = "discard"
    frames: tuple[tuple[Shot, str], ...]
    """Each frame with the checksum of its bytes, 16 hexadecimal digits, as in its `frame` line."""
    result: str
    """Folder of the result that has their samples, an absolute path."""
    samples: InnerPath
    """The file with the samples, relative to that folder."""
    digest: str
    """SHA-256 digest of the arrays in that file. The digest was the same when the arrays were written and when
    they were read back.
    """


class FaultNoted(JournalEvent):
    """Something failed."""

    event: Literal["fault"] = "fault"
    kind: str
    """Name of the error, such as `DeviceTimeout`. `unsafe` means that a device could not be made safe."""
    message: str
    """Message of the error."""
    device: str = ""
    """The failed device, by its kind in the rig; empty if no device failed."""

    @property
    def is_hold(self) -> bool:
        """Tell whether nothing failed: the session was only held until a person let it go on, after Ctrl-Z or a
        freeze."""
        return self.kind == "Held"


class InputsChanged(JournalEvent):
    """Files of the run were changed on the disk after they were read; the run goes on with the content that was
    read."""

    event: Literal["changed"] = "changed"
    files: tuple[str, ...]
    """Path and change of each file, a sentence each."""


class Paused(JournalEvent):
    """The operator paused the session; lights are off."""

    event: Literal["pause"] = "pause"


class Continued(JournalEvent):
    """The operator continued the session after a pause."""

    event: Literal["continue"] = "continue"


class TextUnread(JournalEvent):
    """The reader of the session's text (a terminal, a pipe) did not take it. The session did not wait for it."""

    event: Literal["unread"] = "unread"
    lost_lines: int
    """Number of lines that were dropped."""
    lost_bytes: int
    """Bytes of these lines."""
    waiting_bytes: int
    """Bytes that were kept for the reader when this was written."""
    stalled_s: float
    """Time for which no text had been taken, s."""


class ViewSealed(ViewEvent):
    """The session has finished a view, complete or not."""

    event: Literal["seal"] = "seal"


class SessionStopped(JournalEvent):
    """The session's last line."""

    event: Literal["stop"] = "stop"
    outcome: Literal["done", "interrupted", "failed"]
    """End of the session, in one word."""
    reason: str = ""
    """Reason why not all was done: the person or signal that stopped it, or the failure. It is empty if all was
    done."""
    robot: dict[str, Any] = Field(default_factory=dict)
    """Figures of the robot's link."""
    took_s: float | None = None
    """Duration of the session by a monotonic clock, s. Journals of earlier versions have none."""


Event: TypeAlias = (
    JournalBegun
    | SessionStarted
    | SessionResumed
    | ProcessingAsked
    | ViewBegun
    | MoveBegun
    | ArmSettled
    | FrameProven
    | BurstsChosen
    | ViewChosen
    | BurstBegun
    | BurstEnded
    | GapFound
    | ReshootBegun
    | FindingNoted
    | FramesDiscarded
    | FaultNoted
    | InputsChanged
    | Paused
    | Continued
    | TextUnread
    | ViewSealed
    | SessionStopped
)
