"""A run's journal in plain words for operators."""

from __future__ import annotations

from typing import assert_never

from coupole.storage.journal_events import (
    ArmSettled,
    BurstBegun,
    BurstEnded,
    BurstsChosen,
    Continued,
    Event,
    FaultNoted,
    FindingNoted,
    FrameProven,
    FramesDiscarded,
    GapFound,
    InputsChanged,
    JournalBegun,
    MoveBegun,
    Paused,
    ProcessingAsked,
    ReshootBegun,
    SessionResumed,
    SessionStarted,
    SessionStopped,
    TextUnread,
    ViewBegun,
    ViewChosen,
    ViewSealed,
)


def words_of(event: Event) -> str:  # noqa: PLR0912  a case for each event
    """Describe an event; empty for events that people need not read (each proven frame, and the file's head)."""
    match event:
        case JournalBegun() | FrameProven() | ArmSettled():
            return ""
        case SessionStarted():
            return "; ".join(("began: the devices are open", *event.trusted))
        case SessionResumed():
            return "; ".join(("resumed: the devices are open", *event.trusted))
        case ProcessingAsked():
            return f"views are processed beside it, into {event.result}"
        case ViewBegun():
            hidden_words = f"; {len(event.hidden_leds)} LEDs are hidden from it" if event.hidden_leds else ""
            return f"view {event.view}{hidden_words}"
        case MoveBegun():
            return f"the arm moves to {event.view}"
        case BurstsChosen():
            return f"{event.view}: {event.reason}"
        case ViewChosen():
            return f"next view {event.view}: {event.reason}" if event.view else f"no more views: {event.reason}"
        case BurstBegun():
            return f"{event.view}: a burst begins, at most {max(event.planned_lux_h, default=0.0):.3f} lux h"
        case BurstEnded():
            hot = f", hottest board {event.hottest_board_c:.0f} C" if event.hottest_board_c is not None else ""
            return f"{event.view}: {event.frames} frames of {event.steps} steps{hot}"
        case GapFound():
            why = f" ({event.reason})" if event.reason else ""
            dead = f"; {len(event.dead_leds)} LEDs drew no current" if event.dead_leds else ""
            return f"{event.view}: {len(event.shots)} frames are not proven{why}{dead}"
        case ReshootBegun():
            return f"{event.view}: {len(event.shots)} shots are taken again"
        case FindingNoted():
            return f"{event.view}: {event.kind}: {event.message}; {len(event.shots)} shots are concerned"
        case FramesDiscarded():
            return (
                f"{event.view}: {len(event.frames)} frames are discarded, as the plan says: their samples are safe"
            )
        case FaultNoted():
            return f"{'held' if event.is_hold else 'fault'}: {event.message}"
        case InputsChanged():
            return f"changed on the disk, but the run uses the files as it read them: {'; '.join(event.files)}"
        case Paused():
            return "paused: lights off, arm still"
        case Continued():
            return "went on"
        case TextUnread():
            waiting = f"{event.waiting_bytes} bytes waited"
            return f"nobody read the text: {event.lost_lines} lines were dropped, {waiting}"
        case ViewSealed():
            return f"view {event.view} is finished"
        case SessionStopped():
            why = f": {event.reason}" if event.reason else ""
            return {"done": "done", "interrupted": "stopped", "failed": "failed"}[event.outcome] + why
        case _:
            assert_never(event)
