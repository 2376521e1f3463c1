"""Other ends of the wires of arms, for the conformance of their drivers."""

from __future__ import annotations

import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from arms import KR10_R1100_SIXX
from numpy.typing import NDArray

from coupole.devices import Robot
from coupole.errors import DeviceError
from drivers.kuka.rsi.driver import KukaRsi, Settings
from sim.devices.kuka_controller import ALIKE, KukaController
from sim.devices.kuka_controller import Settings as ControllerSettings
from sim.world.clock import ClockWriter, SharedClock
from sim.world.reactor import Reactor

HOME_DEG = np.array([0.0, -90.0, 90.0, 0.0, 90.0, 0.0])
AWAY_DEG = np.array([50.0, -50.0, 40.0, 30.0, 60.0, -70.0])
UNHURRIED_S = 0.5
"""A motion ends without a look for so long: a test's own thread may wait for its turn on a busy machine."""


class RobotCell(ABC):
    """A controller in a world of its own, and drivers that talk to it."""

    settings: Any
    """Of the driver."""

    def __init__(self, clock_path: Path, reactor: Reactor, controller: Any, cycle_ms: float) -> None:
        self.clock_path, self.reactor, self.controller = clock_path, reactor, controller
        self.cycle_ms = cycle_ms
        self.trace_deg: list[tuple[float, ...]] = []
        self.reactor.after(0.5 * cycle_ms / 1e3, self._sample)
        self._thread = threading.Thread(target=self.reactor.run)
        self._thread.start()
        self.clock = SharedClock(self.clock_path)
        self._drivers = ExitStack()
        self.robot: Robot | None = None
        """The driver opened last."""

    def kept(self, robot: Any) -> Any:
        """A driver that is closed with the cell."""
        self.robot = self._drivers.enter_context(closing(robot))
        return robot

    @abstractmethod
    def open(self) -> Robot:
        """A driver, closed with the cell."""

    def in_world(self, action: Callable[[], object]) -> None:
        """Do something on the world's thread and wait until it is done."""
        done = threading.Event()

        def act() -> None:
            action()
            done.set()

        self.reactor.call_threadsafe(act)
        assert done.wait(30.0)

    def joints_deg(self) -> NDArray[np.float64]:
        return np.array(self.controller.joints_deg)

    def wait_until(self, condition: Callable[[], bool]) -> None:
        give_up = time.monotonic() + 30.0
        while not condition():
            with suppress(DeviceError):  # a motion that nobody looks at is ended
                if self.robot is not None:
                    self.robot.measured()
            assert time.monotonic() < give_up
            time.sleep(0.001)

    def under_way(self) -> bool:
        """True if a motion from home has begun in earnest."""
        return bool(np.max(np.abs(self.joints_deg() - HOME_DEG)) > 8.0)

    def wait_until_under_way(self) -> None:
        self.wait_until(self.under_way)

    def stop_under_way(self, robot: Robot) -> None:
        self.wait_until_under_way()
        robot.stop()

    def close(self) -> None:
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
        """Speed, acceleration and jerk of all that was sampled are within the driver's limits. In real time a late
        answer halts the arm for a cycle, so there nothing is asserted."""
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
        """The arm does not move for half a second of world time."""
        before = self.joints_deg()
        self.clock.sleep(0.5)
        assert not self.controller.moving
        assert np.abs(self.joints_deg() - before).max() < 1e-4  # the last cycle's correction may still arrive


class KukaCell(RobotCell):
    """A KUKA controller and its RSI driver."""

    def __init__(
        self, folder: Path, cycle_ms: int = 4, *, speed: float = 10.0, lock_step: bool = True, **controller: Any
    ) -> None:
        """`controller` are more settings of the stand-in; the driver's are made to fit."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self.address = f"127.0.0.1:{probe.getsockname()[1]}"
        self.lock_step = lock_step
        reactor = Reactor(ClockWriter(folder / "clock", speed=speed))
        # In real time a busy machine is late now and then: that is counted, but must not fail a test.
        delay = {} if lock_step else {"delay_limit": 1_000_000}
        theirs = {"sends_to": self.address, "cycle_ms": cycle_ms, "lock_step": lock_step, "answer_limit_s": 0.5}
        arm = KukaController(reactor, ControllerSettings.model_validate(theirs | delay | controller))
        ours = {"listen": self.address, "cycle_ms": cycle_ms, "link_timeout_s": 0.5, "connect_timeout_s": 20.0}
        ours["attention_s"] = UNHURRIED_S
        alike = {name: value for name, value in controller.items() if name in ALIKE}
        if lock_step:
            ours["declared_cycle_ms"] = cycle_ms
        self.settings = Settings.model_validate({"arm_model": KR10_R1100_SIXX} | ours | delay | alike)
        super().__init__(folder / "clock", reactor, arm, cycle_ms)

    def open(self, **settings: object) -> KukaRsi:
        opened: KukaRsi = self.kept(KukaRsi(self.settings.model_copy(update=settings), self.clock))
        return opened
