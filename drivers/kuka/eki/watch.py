"""Evaluates a controller's statuses over time: whether the arm is settled or off its target, and whether the
session is in a fault.

All times are the controller's own, taken from the statuses. So a host that reads them late does not change the
result. This module uses neither socket nor thread.
"""

from __future__ import annotations

from dataclasses import dataclass

from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceRefused
from drivers.kuka.eki import wire
from drivers.kuka.eki.wire import Six, Status


@dataclass(frozen=True)
class Fault:
    """Fault that has ended the session; only the first one is kept."""

    kind: type[DeviceError]
    text: str


@dataclass(frozen=True)
class Tolerances:
    """See the fields of the same names in `drivers.kuka.eki.driver.Settings`."""

    settle_deg: float
    settle_deg_s: float
    follow_deg: float
    follow_cycles: int


class Watch:
    """The state of one session, status by status."""

    def __init__(self, session: int, tolerances: Tolerances) -> None:
        self.session = session
        self.status: Status | None = None
        """The last status of this session."""
        self.statuses = self.foreign = self.max_gap_ms = 0
        """Statuses of this session and of others; longest time between two of this session (controller time)."""
        self.fault: Fault | None = None
        self.link_lost = False
        """True if no further status will come, whatever the first fault was."""
        self.order = 0
        """Number of the last STOP or MOVE."""
        self.taken_ms: int | None = None
        """Controller time of the first status that acknowledges the last command, of any kind."""
        self.settled_cycles = 0
        self.speed_deg_s = 0.0
        self._tolerances = tolerances
        self._rest_deg: Six | None = None
        """Axes at which the arm must be when the order is done. None means wherever it comes to rest."""
        self._asked = self._astray_cycles = 0

    @property
    def has_lapsed(self) -> bool:
        """True if the controller ended the last order because nobody watched it."""
        return self.status is not None and self.status.lapsed == self.order != 0

    @property
    def moving(self) -> bool:
        """True while an order is pending or the axes turn. After a fault only the axes count."""
        if self.status is None:
            return False
        waiting = self.fault is None and self.status.done != self.order
        return waiting or self.status.moving or self.speed_deg_s > self._tolerances.settle_deg_s

    def note_order(self, number: int, target_deg: Six | None) -> None:
        """Note that a STOP (without a target) or a MOVE is about to be sent."""
        self.order = number
        self._rest_deg = target_deg
        self.note_command(number)

    def note_command(self, number: int) -> None:
        """Note that a command of any kind is about to be sent. From now on, only statuses after the controller has
        taken it count."""
        self._asked, self.taken_ms = number, None
        self.settled_cycles = self._astray_cycles = 0

    def fail(self, kind: type[DeviceError], text: str) -> None:
        self.fault = self.fault or Fault(kind, text)
        self.link_lost |= kind is DeviceLost

    def take(self, status: Status) -> None:
        """Evaluate the next status."""
        if status.session != self.session:
            self.foreign += 1
            return
        self.statuses += 1
        last, self.status = self.status, status
        elapsed_ms = status.time_ms - last.time_ms if last else 0
        self.max_gap_ms = max(self.max_gap_ms, elapsed_ms)
        if last and elapsed_ms > 0:
            steps_deg = map(float.__sub__, status.joints_deg, last.joints_deg)
            self.speed_deg_s = max(map(abs, steps_deg)) * 1e3 / elapsed_ms
        if status.taken >= self._asked and self.taken_ms is None:
            self.taken_ms = status.time_ms
            self.settled_cycles = self._astray_cycles = 0
        if status.fault != wire.NO_FAULT:
            kind = DeviceRefused if status.fault == wire.TARGET_REFUSED else DeviceFault
            self.fail(kind, wire.FAULTS.get(status.fault, f"the controller reports fault {status.fault}"))
        self._evaluate_rest(status, known_speed=elapsed_ms > 0)

    def _evaluate_rest(self, status: Status, *, known_speed: bool) -> None:
        if self.moving:
            self.settled_cycles = self._astray_cycles = 0
            return
        if self._rest_deg is None or self.has_lapsed:
            self._rest_deg = status.joints_deg
        error_deg = max(map(abs, map(float.__sub__, status.joints_deg, self._rest_deg)))
        is_settled = known_speed and error_deg <= self._tolerances.settle_deg
        self.settled_cycles = self.settled_cycles + 1 if is_settled else 0
        self._astray_cycles = self._astray_cycles + 1 if error_deg > self._tolerances.follow_deg else 0
        if self._astray_cycles >= self._tolerances.follow_cycles:
            self.fail(
                DeviceFault,
                f"the arm does not follow: it is {error_deg:.2f} deg from where it was sent "
                f"(brakes, collision, or moved by hand)",
            )

    def overdue(self, limit_s: float) -> bool:
        """True if the last command was taken more than `limit_s` ago, on the controller's clock."""
        if self.status is None or self.taken_ms is None:
            return False
        return self.status.time_ms - self.taken_ms > 1e3 * limit_s
