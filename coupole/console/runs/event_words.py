"""A run's journal in plain words for operators."""

from __future__ import annotations

from typing import assert_never

from coupole.storage import journal_events as events


def words_of(event: events.Event) -> str:  # noqa: PLR0912  a case for each event
    """Describe an event; empty for events that people need not read (each proven frame, and the file's head)."""
    match event:
        case events.JournalBegun() | events.FrameProven() | events.ArmSettled():
            return ""
        case events.SessionStarted():
            return "; ".join(("began: the devices are open", *event.trusted))
        case events.SessionResumed():
            return "; ".join(("resumed: the devices are open", *event.trusted))
        case events.ProcessingAsked():
            return f"views are processed beside it, into {event.result}"
        case events.ViewBegun():
            hidden_words = f"; {len(event.hidden_leds)} LEDs are hidden from it" if event.hidden_leds else ""
            return f"view {event.view}{hidden_words}"
        case events.MoveBegun():
            return f"the arm moves to {event.view}"
        case events.BurstsChosen():
            return f"{event.view}: {event.reason}"
        case events.ViewChosen():
            return f"next view {event.view}: {event.reason}" if event.view else f"no more views: {event.reason}"
        case events.BurstBegun():
            return f"{event.view}: a burst begins, at most {max(event.planned_lux_h, default=0.0):.3f} lux h"
        case events.BurstEnded():
            hot = f", hottest board {event.hottest_board_c:.0f} C" if event.hottest_board_c is not None else ""
            return f"{event.view}: {event.frames} frames of {event.steps} steps{hot}"
        case events.GapFound():
            why = f" ({event.reason})" if event.reason else ""
            dead = f"; {len(event.dead_leds)} LEDs drew no current" if event.dead_leds else ""
            return f"{event.view}: {len(event.shots)} frames are not proven{why}{dead}"
        case events.ReshootBegun():
            return f"{event.view}: {len(event.shots)} shots are taken again"
        case events.FindingNoted():
            return f"{event.view}: {event.kind}: {event.message}; {len(event.shots)} shots are concerned"
        case events.FramesDiscarded():
            return (
                f"{event.view}: {len(event.frames)} frames are discarded, as the plan says: their samples are safe"
            )
        case events.FaultNoted():
            return f"{'held' if event.is_hold else 'fault'}: {event.message}"
        case events.InputsChanged():
            return (
                "these files were changed on the disk, but the run uses them as it read them: "
                f"{'; '.join(event.files)}"
            )
        case events.Paused():
            return "paused: lights off, arm still"
        case events.Continued():
            return "went on"
        case events.TextUnread():
            waiting = f"{event.waiting_bytes} bytes waited"
            return f"nobody read the text output: {event.lost_lines} lines were dropped, {waiting}"
        case events.ViewSealed():
            return f"view {event.view} is finished"
        case events.SessionStopped():
            why = f": {event.reason}" if event.reason else ""
            return {"done": "done", "interrupted": "stopped", "failed": "failed"}[event.outcome] + why
        case _:
            assert_never(event)
