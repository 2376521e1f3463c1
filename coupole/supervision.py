"""Times for which the arm may move, and lamps may shine, without news from their supervisor.

A moving arm or a lit lamp never depends on a single process that may simply *stop*, such as a frozen process, a
hung call or a cut cable. So each moving or shining part receives beats from its supervisor, and makes itself safe
when the beats end. The supervising thread itself gives a beat, each time it has checked the arm. A helper thread
never gives the beat, because it would continue even if the supervising thread hung. The chain, from the arm
backwards:

======================  =====================================  ======================  ==========================
part                    gets its beats from                    silent for at most      then
======================  =====================================  ======================  ==========================
KUKA's RSI              each answer of the answering process   one cycle               the arm holds; after the
                                                                                       delay limit RSI stops
the answering process   the thread that called `move_to`, by   `ATTENTION_S`           the axes brake on their
(RSI), ur-rtde's        `measured` or `wait_settled`                                   path; a new motion must
process (UR)                                                                           be requested
KUKA's EKI program      the same thread, by a command BEAT     `ATTENTION_S`           the same, in the program
UR's program            ur-rtde's process, by RTDE's watchdog  the rig's `watchdog_s`  the program ends, the
                                                                                       controller brakes
the LED box             the session, by any command            the rig's `watchdog_s`  dark
children of a session   their parent's life                    0.05 s                  they brake and end
======================  =====================================  ======================  ==========================

All these times are on the machine's monotonic clock, whatever the rig's clock does. A motion is watched from its
command until its axes are at rest. After a freeze of `ASKS_FROM_S` a person is asked. After a shorter freeze, or a
lapse that a busy machine explains, the session goes on along the checked path by itself. docs/reference/safety.md
has the table.
"""

from __future__ import annotations

import threading
import time

ATTENTION_S = 0.1
"""Longest time for which a motion may go unchecked. Then it ends: the axes brake."""
LOOK_S = 0.02
"""The supervisor of a moving arm checks it again after at most this time, on the machine's clock."""
ASKS_FROM_S = 1.0
"""A process that did not run for this time was frozen, or its machine slept. A person then decides whether to go
on."""
HEARD_WITHIN_S = 0.5
"""A process that runs again after a freeze learns of the freeze (SIGCONT) within this time."""
ASKS_AFTER_LAPSE_S = 5.0
"""A person also decides after a lapse of attention of this length that is not a freeze: the machine was busy, or a
call took long."""
_LISTENED_NS = 100_000_000


class Silence:
    """Time since the last beat of another process, counted only while the listening process itself runs."""

    def __init__(self) -> None:
        self._beat = 0
        self._heard_ns = time.monotonic_ns()
        self._silent_ns = 0

    def after(self, beat: int) -> float:
        """Return the seconds since the last new beat; `beat` is the latest one. A gap between two calls counts as
        at most 0.1 s, because a listener that was frozen, or whose machine slept, has not listened."""
        now_ns = time.monotonic_ns()
        gap_ns, self._heard_ns = now_ns - self._heard_ns, now_ns
        waits = beat == self._beat != 0  # 0: it has not begun
        self._silent_ns = self._silent_ns + min(gap_ns, _LISTENED_NS) if waits else 0
        self._beat = beat
        return self._silent_ns / 1e9


class Attention:
    """The beats of the thread that watches a motion, on the watching side. `drivers` give each arm one such
    object.

    The watching thread is the one that began the motion. The gaps between its beats are measured here, in the
    watching process. The process that makes the motion decides whether a gap ends the motion.
    """

    def __init__(self) -> None:
        self._thread = 0
        self._looked_ns = 0
        self._longest_ns = 0

    def begin(self) -> int:
        """Begin to watch a motion that this thread commands. Return the time of this beat, ns."""
        self._thread, self._longest_ns = threading.get_ident(), 0
        self._looked_ns = time.monotonic_ns()
        return self._looked_ns

    def look(self) -> int | None:
        """Return the time of a beat, ns, to be passed on; None in a thread that does not watch the motion."""
        if threading.get_ident() != self._thread:
            return None
        now_ns = time.monotonic_ns()
        self._longest_ns = max(self._longest_ns, now_ns - self._looked_ns)
        self._looked_ns = now_ns
        return now_ns

    def longest_gap_s(self) -> float:
        """Return the longest time between two looks at the present or last motion. A call from the watching thread
        is also a look, because the thread may have been frozen since the last one."""
        self.look()
        return self._longest_ns / 1e9
