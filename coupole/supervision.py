"""Times for which the arm may move, and lamps may shine, without news of whoever supervises them.

An arm or a lamp is never left alone by something that merely *stops*: a frozen process, a hung call, a cable. So
whoever moves or shines hears a beat of whoever watches, and makes itself safe when the beats end. A beat comes
from the supervising thread itself, when it has looked at the arm; a helper thread, which would live on beside a
hung one, never beats for it. The chain, from the arm backwards:

======================  =====================================  ======================  ==========================
moves or shines         beaten by                              silent for at most      then
======================  =====================================  ======================  ==========================
KUKA's RSI              each answer of the answering process   one cycle               the arm holds; after the
                                                                                       delay limit RSI stops
the answering process   the thread that called `move_to`, by   `ATTENTION_S`           the axes brake on their
(RSI), ur-rtde's        `measured` or `wait_settled`                                   path; a new motion is to
process (UR)                                                                           be asked for
KUKA's EKI program      the same thread, by a command BEAT     `ATTENTION_S`           the same, in the program
UR's program            ur-rtde's process, by RTDE's watchdog  the rig's `watchdog_s`  the program ends, the
                                                                                       controller brakes
the LED box             the session, by any command            the rig's `watchdog_s`  dark
children of a session   their parent's life                    0.05 s                  they brake and end
======================  =====================================  ======================  ==========================

All of these are times of the machine's monotonic clock, whatever the rig's clock does. A motion is watched from
its command until its axes are at rest. After a freeze of `ASKS_FROM_S` a person is asked; after a shorter one,
or a lapse that a busy machine explains, the session goes on along the checked path by itself.
docs/reference/safety.md has the table.
"""

from __future__ import annotations

import threading
import time

ATTENTION_S = 0.1
"""A motion that nobody has looked at for this long ends: the axes brake."""
LOOK_S = 0.02
"""The supervisor of a moving arm checks it again after at most this time, on the machine's clock."""
ASKS_FROM_S = 1.0
"""A process that did not run for so long was frozen, or its machine slept: a person decides whether to go on."""
HEARD_WITHIN_S = 0.5
"""A freeze is heard of (SIGCONT) within this time after it runs again."""
ASKS_AFTER_LAPSE_S = 5.0
"""The same for a lapse of attention that nothing explains: a busy machine, or a call that took its time."""
_LISTENED_NS = 100_000_000


class Silence:
    """Time for which a process that beats has been silent, counted only while its listener itself runs."""

    def __init__(self) -> None:
        self._beat = 0
        self._heard_ns = time.monotonic_ns()
        self._silent_ns = 0

    def after(self, beat: int) -> float:
        """Seconds since the last new beat, `beat` being the latest. A gap between two calls counts at most 0.1 s:
        a listener that was frozen, or whose machine slept, has not listened."""
        now_ns = time.monotonic_ns()
        gap_ns, self._heard_ns = now_ns - self._heard_ns, now_ns
        waits = beat == self._beat != 0  # 0: it has not begun
        self._silent_ns = self._silent_ns + min(gap_ns, _LISTENED_NS) if waits else 0
        self._beat = beat
        return self._silent_ns / 1e9


class Attention:
    """The beats of the thread that watches a motion, on the watching side: `drivers` give one to each arm.

    The watching thread is the one that began the motion. Its gaps are measured where it looks; whether a motion
    was ended for one is decided where the motion is made.
    """

    def __init__(self) -> None:
        self._thread = 0
        self._looked_ns = 0
        self._longest_ns = 0

    def begin(self) -> int:
        """This thread commands a motion, and watches it from now on; the time of this beat, ns."""
        self._thread, self._longest_ns = threading.get_ident(), 0
        self._looked_ns = time.monotonic_ns()
        return self._looked_ns

    def look(self) -> int | None:
        """The time of a beat, ns, to be passed on; None in any other thread than the one that watches."""
        if threading.get_ident() != self._thread:
            return None
        now_ns = time.monotonic_ns()
        self._longest_ns = max(self._longest_ns, now_ns - self._looked_ns)
        self._looked_ns = now_ns
        return now_ns

    def longest_gap_s(self) -> float:
        """Longest time between two looks of the motion under way, or of the last one; asked for by the thread that
        watches, this is a look: it may have been frozen since the last one."""
        self.look()
        return self._longest_ns / 1e9
