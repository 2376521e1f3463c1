"""What the drivers of arms share: waiting for a state, the age of the last word, targets within limits."""

from __future__ import annotations

import math
from itertools import count

import numpy as np
import pytest

from coupole.clock import Deadline
from coupole.errors import DeviceFault, DeviceRefused, DeviceTimeout
from drivers.arm_motion import MessageTime, StateReader, checked_target, wait_for

LIMITS_DEG = ((-170.0, 170.0),) * 6


class HandTurnedClock:
    """Stands still until it is turned."""

    def __init__(self) -> None:
        self.t_ns = 5

    def now_ns(self) -> int:
        return self.t_ns

    def sleep(self, seconds: float, at_most_s: float = math.inf) -> None:
        self.t_ns += round(seconds * 1e9)


def waited(clock: HandTurnedClock, done_at: int, *, faulty_at: int = -1) -> None:
    """Wait 1 s at most for the state `done_at`, which rises by one each 0.1 s."""
    states = count()

    def check(state: int) -> None:
        if state == faulty_at:
            raise DeviceFault("robot", expected="no fault", happened="one came", remedy="none")

    reader = StateReader(
        lambda: next(states),
        pause=lambda: clock.sleep(0.1),
        describe=lambda state: f"it is in state {state}",
        remedy="See the controller",
    )
    wait_for(reader, lambda state: state == done_at, Deadline(clock, 1.0), "the arm at rest", check=check)


def test_waiting_ends_with_the_state_that_is_waited_for() -> None:
    clock = HandTurnedClock()
    waited(clock, 4)
    assert clock.t_ns == 5 + 400_000_000


def test_waiting_past_the_deadline_tells_the_last_state() -> None:
    with pytest.raises(DeviceTimeout, match=r"the arm at rest within 1.0 s; it is in state 1[01]"):
        waited(HandTurnedClock(), 50)


def test_a_fault_ends_the_waiting_before_the_state_counts() -> None:
    with pytest.raises(DeviceFault, match="one came"):
        waited(HandTurnedClock(), 3, faulty_at=3)


def test_a_message_count_has_the_time_at_which_it_was_first_read() -> None:
    clock = HandTurnedClock()
    message_time = MessageTime(clock)
    first_ns = message_time.since_ns(1)
    clock.sleep(1.0)
    assert message_time.since_ns(1) == first_ns
    assert message_time.since_ns(2) == first_ns + 10**9


def test_a_target_out_of_limits_names_its_axes() -> None:
    with pytest.raises(DeviceRefused, match=r"A2 would be 170.001 deg.*A6 would be -171.000 deg"):
        checked_target((0, 170.001, 0, 0, 0, -171.0), LIMITS_DEG)


@pytest.mark.parametrize("joints_deg", [(0.0,) * 5, (0.0,) * 5 + (np.nan,)])
def test_anything_but_six_finite_angles_is_refused(joints_deg: tuple[float, ...]) -> None:
    with pytest.raises(DeviceRefused, match="six finite joint angles"):
        checked_target(joints_deg, LIMITS_DEG)
