"""A world with nothing but an arm's controller in it, on a thread of its own: the other end of the wire of a
robot's driver, for `coupole.testing.RobotConformance`."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.devices import Robot
from coupole.errors import DeviceError
from sim.world.clock import SharedClock
from sim.world.reactor import Reactor


class RobotAlone(ABC):
    """A controller in a world of its own, and drivers that talk to it: a `coupole.testing.RobotCell`.

    `controller` is the stand-in, on the world's event loop (`reactor`), which this class runs in a thread. Its
    `joints_deg` are the arm's true angles.
    """

    settings: Any
    """Settings of the driver."""

    def __init__(self, clock_path: Path, reactor: Reactor, controller: Any, cycle_ms: float) -> None:
        self.clock_path, self.reactor, self.controller = clock_path, reactor, controller
        self.cycle_ms = cycle_ms
        self.home_deg = self.joints_deg()
        """[6] angles of the arm when the world began."""
        self.trace_deg: list[tuple[float, ...]] = []
        self.reactor.after(0.5 * cycle_ms / 1e3, self._sample)
        self._thread = threading.Thread(target=self.reactor.run)
        self._thread.start()
        self.clock = SharedClock(self.clock_path)
        self._drivers = ExitStack()
        self.robot: Robot | None = None
        """The driver opened last."""

    def keep(self, robot: Any) -> Any:
        """Keep a driver, to be closed with the cell."""
        self.robot = self._drivers.enter_context(closing(robot))
        return robot

    @abstractmethod
    def open(self) -> Robot:
        """Open a driver, which is closed with the cell."""

    def in_world(self, action: Callable[[], object]) -> None:
        """Run an action on the world's thread, and wait until it is done."""
        is_done = threading.Event()

        def act() -> None:
            action()
            is_done.set()

        self.reactor.call_threadsafe(act)
        assert is_done.wait(30.0)

    # What a test does to the arm.

    @property
    def is_moving(self) -> bool:
        """True while the arm moves."""
        return bool(self.controller.moving)

    @property
    def repeatability_mm(self) -> float:
        """Standard deviation of the place where the arm comes to rest, mm."""
        return float(self.controller.errors.repeatability_um) / 1e3

    def true_base_from_flange(self) -> NDArray[np.float64]:
        """Return [4, 4], the true pose of the flange, mm."""
        return np.array(self.controller.true_base_from_flange())

    def emergency_stop(self) -> None:
        """Press the emergency stop."""
        self.in_world(self.controller.estop)

    def reset(self) -> None:
        """Release the emergency stop, and switch the drives on."""
        self.in_world(self.controller.reset)

    def lose_link(self, seconds: float) -> None:
        """Let no packet come through for this time."""
        self.in_world(lambda: self.controller.lose_link(seconds))

    def push_aside(self, turns_deg: tuple[float, ...]) -> None:
        """Turn the axes by these angles, without a command of the driver."""
        self.in_world(lambda: self.controller.nudge(turns_deg))

    def joints_deg(self) -> NDArray[np.float64]:
        """Return [6], the true angles of the axes."""
        return np.array(self.controller.joints_deg)

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition of the world, and look at the arm meanwhile, as every supervisor of a motion
        must."""
        give_up = time.monotonic() + 30.0
        while not condition():
            with suppress(DeviceError):  # a motion ends if nobody looks at the arm
                if self.robot is not None:
                    self.robot.measured()
            assert time.monotonic() < give_up
            time.sleep(0.001)

    def under_way(self) -> bool:
        """True if a motion from home is clearly under way."""
        return bool(np.max(np.abs(self.joints_deg() - self.home_deg)) > 8.0)

    def wait_until_under_way(self) -> None:
        """Wait until a motion from home is clearly under way."""
        self.wait_until(self.under_way)

    def stop_under_way(self, robot: Robot) -> None:
        """Stop a motion from home on its way."""
        self.wait_until_under_way()
        robot.stop()

    def close(self) -> None:
        """Close all drivers, and end the world."""
        self._drivers.close()
        self.reactor.stop()
        self._thread.join()
        self.controller.close()

    def _sample(self) -> None:
        self.trace_deg.append(self.controller.joints_deg)
        self.reactor.after(self.cycle_ms / 1e3, self._sample)

    @property
    def velocity_deg_s(self) -> NDArray[np.float64]:
        """[6] greatest speeds of the driver's motions."""
        return np.array(self.settings.arm().velocity_deg_s)

    def assert_smooth(self) -> None:
        """Assert that speed, acceleration and jerk of all samples are within the driver's limits. In real time a
        late answer halts the arm for a cycle, so nothing is asserted then."""
        if not getattr(self, "lock_step", True):
            return
        dt_s = self.cycle_ms / 1e3
        axes_deg = np.array(self.trace_deg)
        arm = self.settings.arm()
        for order, limit in enumerate((arm.velocity_deg_s, arm.acceleration_deg_s2, arm.jerk_deg_s3), start=1):
            rounding = 2.0**order * 1e-6 / dt_s**order
            assert np.all(
                np.abs(np.diff(axes_deg, order, axis=0)) / dt_s**order <= np.array(limit) * 1.001 + rounding
            )

    def assert_stands(self) -> None:
        """Assert that the arm does not move for half a second of world time."""
        before = self.joints_deg()
        self.clock.sleep(0.5)
        assert not self.controller.moving
        assert np.abs(self.joints_deg() - before).max() < 1e-4  # the last cycle's correction may still arrive
