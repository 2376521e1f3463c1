"""UR's dashboard server: one line per question, one per answer (Universal Robots, "Dashboard Server e-Series").

It is used to check the controller before ur-rtde connects to it, and to end a program without ur-rtde.
"""

from __future__ import annotations

import contextlib
import socket
import time
from typing import Literal

from drivers.ur.messages import Config, Failure

_PORT = 29999
_LINE_BYTES = 4096
_TIMEOUT_S = 2.0
_CONDITIONS = (
    ("safetystatus", ("Safetystatus: NORMAL", "Safetystatus: REDUCED"), "Check the cell and acknowledge"),
    ("robotmode", ("Robotmode: RUNNING",), "Power the arm and release its brakes"),
    ("is in remote control", ("true",), "Switch the pendant to remote control"),
)
"""Conditions for running the program: question, accepted answers, remedy for any other."""


class CannotBegin(Exception):
    """Passes a `Failure` to the driver."""

    def __init__(
        self, kind: Literal["refused", "fault", "lost"], expectation: str, observation: str, remedy: str
    ) -> None:
        self.failure = Failure(kind, expectation, observation, remedy)
        super().__init__(observation)


class Dashboard:
    """A connection for a few questions. Raises OSError if the link fails or is silent for 2 s."""

    def __init__(self, host: str) -> None:
        self._link = socket.create_connection((host, _PORT), timeout=_TIMEOUT_S)
        self._lines = self._link.makefile("rwb")
        self._lines.readline(_LINE_BYTES)  # the greeting

    def ask(self, question: str) -> str:
        self._lines.write(question.encode() + b"\n")
        self._lines.flush()
        line = self._lines.readline(_LINE_BYTES)
        if not line.endswith(b"\n"):
            raise ConnectionError(f"the dashboard server closed instead of answering {question!r}")
        return line.decode(errors="replace").strip()

    def close(self) -> None:
        self._lines.close()
        self._link.close()


def ready_controller(config: Config) -> tuple[str, str, str]:
    """Model, serial number and firmware; raises CannotBegin unless the controller is ready to run a program.

    This is checked first, because ur-rtde's constructor hangs while another program runs.
    """
    wait_until_s = time.monotonic() + 2.0 * config.watchdog_s + 0.5
    try:
        with contextlib.closing(Dashboard(config.host)) as dashboard:
            for question, fit, remedy in _CONDITIONS:
                if (answer := dashboard.ask(question)) not in fit:
                    answer_text = "not in remote control" if answer == "false" else answer
                    raise CannotBegin("fault", f"{fit[0]!r} to the question {question!r}", answer_text, remedy)
            while not (state := dashboard.ask("programState")).startswith("STOPPED"):
                if time.monotonic() > wait_until_s:
                    raise CannotBegin("refused", "no program on the controller", state, "Stop it at the pendant")
                time.sleep(0.05)
            return (
                dashboard.ask("get robot model"),
                dashboard.ask("get serial number"),
                dashboard.ask("PolyscopeVersion"),
            )
    except OSError as error:
        failure = f"{type(error).__name__}: {error}"
        raise CannotBegin(
            "lost", f"a dashboard server at {config.host}", failure, "Check address and cable"
        ) from error


def why_ended(host: str) -> str:
    """Return the name of the fault of a program that ended although the driver did not stop it."""
    with contextlib.suppress(OSError), contextlib.closing(Dashboard(host)) as dashboard:
        if dashboard.ask("is in remote control") == "false":
            return "not in remote control: the program was stopped at the pendant"
    return "program stopped"


def end_program(host: str) -> None:
    """End the program that runs or is paused. A failing link is ignored, because the link's time-out detects
    it."""
    with contextlib.suppress(OSError), contextlib.closing(Dashboard(host)) as dashboard:
        dashboard.ask("stop")
