"""The world's event loop: one thread that processes timed events and input, in the order of world time.

Stand-ins have no threads. They register callbacks: at a world time (`at`, `after`), when a file descriptor can be
read (`add_reader`), or from a worker thread (`call_threadsafe`). A timed callback sees its exact world time as
`now_ns`, however late the machine executes it. So events in the world do not depend on the machine's load. The
load affects only the duration of the simulation.
"""

from __future__ import annotations

import heapq
import itertools
import os
import select
import selectors
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from sim.world.clock import FOREVER_NS, ClockWriter

_MAX_LAG_S = 0.02
"""A world that is farther behind its pace than this (machine time) no longer tries to catch up."""
_TIMERS_PER_POLL = 16
_IDLE_TICK_NS = 10_000_000


class Readable(Protocol):
    def fileno(self) -> int: ...


@dataclass(order=True)
class Timer:
    """One pending callback; `cancel()` prevents it."""

    t_ns: int
    order: int
    callback: Callable[[], None] | None = field(compare=False)

    def cancel(self) -> None:
        self.callback = None


class Reactor:
    """Runs the world until `stop()`."""

    def __init__(self, clock: ClockWriter) -> None:
        self.clock = clock
        self._now_ns = 0
        self._timers: list[Timer] = []
        self._order = itertools.count()
        self._selector = selectors.DefaultSelector()
        self._calls: deque[Callable[[], None]] = deque()
        self._waking = threading.RLock()  # reentrant, because a signal handler may run meanwhile
        self._wake_read, self._wake_write = os.pipe()
        self._has_ended = False
        os.set_blocking(self._wake_read, False)
        self._selector.register(self._wake_read, selectors.EVENT_READ, self._run_calls)
        self._stopped = threading.Event()

    @property
    def now_ns(self) -> int:
        """World time of the present event."""
        return self._now_ns

    def at(self, t_ns: int, callback: Callable[[], None]) -> Timer:
        """Call back at world time `t_ns`, or at once if this time is past."""
        timer = Timer(max(t_ns, self._now_ns), next(self._order), callback)
        heapq.heappush(self._timers, timer)
        return timer

    def after(self, seconds: float, callback: Callable[[], None]) -> Timer:
        """Call back `seconds` of world time from now."""
        return self.at(self._now_ns + round(seconds * 1e9), callback)

    def add_reader(self, readable: Readable | int, callback: Callable[[], None]) -> None:
        """Call back whenever `readable` has bytes, or has reached its end."""
        self._selector.register(readable, selectors.EVENT_READ, callback)

    def remove_reader(self, readable: Readable | int) -> None:
        self._selector.unregister(readable)

    def call_threadsafe(self, callback: Callable[[], None]) -> None:
        """Let the reactor's thread call back soon. This is for worker threads."""
        self._calls.append(callback)
        self._wake()

    @staticmethod
    def hold_for(readable: Readable, machine_s: float) -> bool:
        """Pause world time until `readable` has bytes; False if it had none after `machine_s`.

        A stand-in in lock-step with a client uses this: the world waits for the client's answer.
        """
        return bool(select.select([readable], [], [], machine_s)[0])

    def stop(self) -> None:
        """End `run()`; safe from any thread and from signal handlers."""
        self._stopped.set()
        self._wake()

    def _wake(self) -> None:
        with self._waking:
            if not self._has_ended:
                os.write(self._wake_write, b"!")

    def run(self) -> None:
        """Process events until stopped. It cannot be started again."""
        while not self._stopped.is_set():
            next_ns = self._next_ns()
            wait_s = self.clock.machine_s_until(next_ns)
            for key, _ in self._selector.select(max(0.0, wait_s)):
                if self._selector.get_map().get(key.fd) is not key:
                    continue  # an earlier callback may have removed it
                self._now_ns = max(self._now_ns, min(self.clock.paced_ns(), next_ns))
                key.data()
            self._run_due_timers()
            self._publish()
        self.clock.close()
        with self._waking:
            self._has_ended = True
            self._selector.unregister(self._wake_read)
            os.close(self._wake_read)
            os.close(self._wake_write)

    def _next_ns(self) -> int:
        while self._timers and self._timers[0].callback is None:
            heapq.heappop(self._timers)
        tick_ns = self._now_ns + _IDLE_TICK_NS
        return min(self._timers[0].t_ns, tick_ns) if self._timers else tick_ns

    def _run_due_timers(self) -> None:
        paced_ns = self.clock.paced_ns()
        for _ in range(_TIMERS_PER_POLL):
            next_ns = self._next_ns()
            if next_ns > paced_ns:
                break
            if not self._timers or self._timers[0].t_ns > next_ns:
                self._now_ns = next_ns
                continue
            timer = heapq.heappop(self._timers)
            self._now_ns = max(self._now_ns, timer.t_ns)
            if timer.callback is not None:
                timer.callback()

    def _publish(self) -> None:
        next_ns = self._next_ns()
        max_lag_ns = int(_MAX_LAG_S * self.clock.speed * 1e9)
        if self.clock.paced_ns() - next_ns > max_lag_ns:
            self.clock.slip_to(next_ns)
        self.clock.publish(min(next_ns, FOREVER_NS))

    def _run_calls(self) -> None:
        try:
            os.read(self._wake_read, 4096)
        except BlockingIOError:
            return
        while self._calls:
            self._calls.popleft()()
