"""Other ends of the wires of arms, for the conformance of their drivers."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

from arms import KR10_R1100_SIXX

from coupole.testing.robot_conformance import UNHURRIED_S
from drivers.kuka.rsi.driver import KukaRsi, Settings
from sim.devices.kuka_controller import ALIKE, KukaController
from sim.devices.kuka_controller import Settings as ControllerSettings
from sim.world.clock import ClockWriter
from sim.world.reactor import Reactor
from sim.world.robot_alone import RobotAlone


class KukaCell(RobotAlone):
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
        opened: KukaRsi = self.keep(KukaRsi(self.settings.model_copy(update=settings), self.clock))
        return opened
