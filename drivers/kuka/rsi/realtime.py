"""The right to answer before all other processes. It keeps answers in time on a busy machine."""

from __future__ import annotations

import os
import sys
import threading

PRIORITY = 20
"""Priority under SCHED_FIFO, from 1 to 99. The kernel's network threads have 50."""


def become_realtime() -> bool:
    """True if this thread now runs under SCHED_FIFO. False without the right; it then has normal priority."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError:
        return False
    return True


def may_be_realtime() -> bool:
    """Tell whether a process that this one starts may run under SCHED_FIFO. A short-lived thread tries it."""
    outcomes: list[bool] = []
    thread = threading.Thread(target=lambda: outcomes.append(become_realtime()))
    thread.start()
    thread.join()
    return outcomes == [True]


def how_to_give_the_right() -> str:
    """Return how to give the right, for messages; the full text is in docs/how-to/kuka-controller.md."""
    return (
        f"Run `sudo setcap cap_sys_nice+ep {os.path.realpath(sys.executable)}`, or write "
        f"`@GROUP - rtprio {PRIORITY}` into /etc/security/limits.d/coupole.conf and log in again, or in a "
        f"systemd unit `LimitRTPRIO={PRIORITY}` (docs/how-to/kuka-controller.md)"
    )
