"""A KUKA controller with EthernetKRL in a world of its own, and its driver."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from arms import KR10_R1100_SIXX
from numpy.typing import NDArray

from coupole.devices import Robot
from coupole.testing.robot_conformance import UNHURRIED_S
from drivers.kuka.eki.driver import KukaEki, Settings
from sim.devices.kuka_eki_controller import KukaEkiController
from sim.devices.kuka_eki_controller import Settings as ControllerSettings
from sim.world.clock import ClockWriter
from sim.world.reactor import Reactor
from sim.world.robot_alone import RobotAlone

SAMPLE_MS = 4


class EkiCell(RobotAlone):
    """A KUKA controller with EthernetKRL, and its driver."""

    def __init__(self, folder: Path, *, speed: float = 10.0, **controller: Any) -> None:
        reactor = Reactor(ClockWriter(folder / "clock", speed=speed))
        arm = KukaEkiController(
            reactor,
            ControllerSettings.model_validate({"address": "127.0.0.1:0", "beat_s": UNHURRIED_S, **controller}),
        )
        self.settings = Settings.model_validate(
            {
                "arm_model": KR10_R1100_SIXX,
                "address": arm.address,
                "controller_is": controller.get("controller_is", "server"),
                "link_timeout_s": 3.0 if speed == 1.0 else 1.0,
            }
        )
        super().__init__(folder / "clock", reactor, arm, SAMPLE_MS)

    def open(self, **settings: object) -> KukaEki:
        opened: KukaEki = self.keep(KukaEki(self.settings.model_copy(update=settings), self.clock))
        return opened

    def hold_until_commanded(
        self, command: Callable[[], None], *, once: Callable[[], bool] = lambda: True
    ) -> NDArray[np.float64]:
        """Where the axes [6] are when `command` is begun, `once` this is so; the world stands still until it has
        come."""
        called_deg = []
        come = threading.Event()

        def hold() -> None:
            if not once():
                self.reactor.after(SAMPLE_MS / 1e3, hold)
                return
            called_deg.append(self.joints_deg())
            command()
            assert self.controller._client is not None
            self.reactor.hold_for(self.controller._client, 20.0)
            come.set()

        self.in_world(hold)
        self.wait_until(come.is_set)
        return called_deg[0]

    def stop_under_way(self, robot: Robot) -> None:
        """At a place of the world, not of a busy machine's: at this speed the way is soon at its end."""
        stopper = threading.Thread(target=robot.stop)
        self.hold_until_commanded(stopper.start, once=self.under_way)
        stopper.join()
