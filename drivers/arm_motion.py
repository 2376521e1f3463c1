"""Functions that the arm drivers share: checks of targets, stopping times and angles, waiting, age of the last
message.

Angles are degrees of the arm's six axes; speeds, accelerations and jerks are of the same axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.clock import Clock, Deadline
from coupole.errors import DeviceRefused, DeviceTimeout

State = TypeVar("State")
_LIMIT_TOLERANCE_DEG = 1e-9


def refusal(expectation: str, observation: str) -> DeviceRefused:
    """Return the error for a refused motion, or for a refused wait for a motion."""
    return DeviceRefused("robot", expected=expectation, happened=observation, remedy="Ask for another pose")


def overtaken() -> DeviceRefused:
    """Return the error for the case that another command has ended a wait."""
    return refusal("the arm to continue to its target", "another command ended the motion")


def checked_target(
    joints_deg: ArrayLike, limits_deg: Sequence[tuple[float, float]]
) -> tuple[float, float, float, float, float, float]:
    """Return six finite angles within the limits of each axis. Raises DeviceRefused, which names the axes."""
    target = np.asarray(joints_deg, dtype=np.float64)
    if target.shape != (6,) or not np.all(np.isfinite(target)):
        raise refusal("six finite joint angles in degrees", f"got {joints_deg!r}")
    a1, a2, a3, a4, a5, a6 = target.tolist()
    outside = [
        f"A{axis} would be {angle:.3f} deg, its limits are {low:g} to {high:g} deg"
        for axis, (angle, (low, high)) in enumerate(zip(target, limits_deg, strict=True), start=1)
        if not low - _LIMIT_TOLERANCE_DEG <= angle <= high + _LIMIT_TOLERANCE_DEG
    ]
    if outside:
        raise refusal("joint angles within the arm's limits", "; ".join(outside))
    return a1, a2, a3, a4, a5, a6


def checked_speed(speed: float) -> float:
    """Return a share of the driver's speeds. Raises DeviceRefused for any other number."""
    if not 0.0 < speed <= 1.0:
        raise refusal("a speed above 0 and at most 1, as a share of the arm's greatest speed", f"got {speed!r}")
    return float(speed)


def longest_stop_s(velocity_deg_s: Sequence[float], acceleration_deg_s2: float, jerk_deg_s3: float) -> float:
    """Return the longest time that any axis needs to come to rest: v/a, and twice a/jerk for the rise of the
    deceleration."""
    return max(velocity_deg_s) / acceleration_deg_s2 + 2.0 * acceleration_deg_s2 / jerk_deg_s3


def farthest_stop_deg(
    velocity_deg_s: Sequence[float], acceleration_deg_s2: float, jerk_deg_s3: float, delay_s: float
) -> NDArray[np.float64]:
    """Return the largest angle that each axis [6] can turn after a stop command: highest speed times braking time.

    Braking from speed v takes v/a + a/j, at half the speed on average. An axis that is still accelerating needs
    a/j before that. All axes take the time of the slowest one. `delay_s`, from the call until the arm begins to
    brake, is added.
    """
    speeds_deg_s = np.asarray(velocity_deg_s, dtype=np.float64)
    rise_s = acceleration_deg_s2 / jerk_deg_s3
    brake_s = speeds_deg_s.max() / acceleration_deg_s2 + rise_s
    farthest_deg: NDArray[np.float64] = speeds_deg_s * (rise_s + 0.5 * brake_s + delay_s)
    return farthest_deg


@dataclass(frozen=True)
class StateReader(Generic[State]):
    """A function of a driver that reads the state of its arm, and the words that describe this state."""

    read_state: Callable[[], State]
    pause: Callable[[], None]
    """Waits until the next reading."""
    describe: Callable[[State], str]
    remedy: str
    """Advice for an arm that does not come to the expected state."""


def wait_for(
    reader: StateReader[State],
    is_done: Callable[[State], bool],
    deadline: Deadline,
    expectation: str,
    *,
    check: Callable[[State], None] | None,
) -> None:
    """Read the arm's state until it is `is_done`; `check` is applied to every state.

    Errors of the reader and of `check` are raised unchanged. Raises DeviceTimeout at the deadline, with the last
    state in the reader's words.
    """
    while True:
        state = reader.read_state()
        if check is not None:
            check(state)
        if is_done(state):
            return
        if deadline.has_expired:
            raise DeviceTimeout(
                "robot",
                expected=f"{expectation} within {deadline.seconds:.1f} s",
                happened=reader.describe(state),
                remedy=reader.remedy,
            )
        reader.pause()


class MessageTime:
    """Rig time of the controller's latest message. It does not change while no message comes."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._count = -1
        self._since_ns = 0

    def since_ns(self, count: int) -> int:
        """Return the rig time at which the message count was first found to be `count`."""
        if count != self._count:
            self._count, self._since_ns = count, self._clock.now_ns()
        return self._since_ns
