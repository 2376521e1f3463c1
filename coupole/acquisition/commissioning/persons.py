"""Persons who answer in a commissioning: one at the terminal; for a simulated cell, the simulation itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from coupole.acquisition.observer import Control
from coupole.plan.registry import WORLD, load_class
from coupole.viewing.questions import ask, ask_number
from coupole.viewing.terminal import alarm


class PersonAtTerminal:
    """A `Person` who reads and types here. A question is withdrawn when the session must end."""

    def __init__(self, control: Control) -> None:
        self._is_over = control.stop.is_set

    def is_ready(self, announcement: str) -> bool:
        return ask(f"\n{announcement}\nGo on?", self._is_over)

    def confirms(self, question: str) -> bool:
        return ask(question, self._is_over)

    def measures(self, quantity: str, question: str) -> float | None:
        return ask_number(f"Measure, in mm: {question}:", self._is_over)

    def tell(self, message: str) -> None:
        alarm(message)

    def hold_enabling_switch(self, *, is_held: bool) -> None:
        alarm("HOLD the enabling switch at the cell now." if is_held else "RELEASE the enabling switch now.")

    def press_emergency_stop(self) -> None:
        alarm("PRESS THE EMERGENCY STOP NOW, while the arm moves.")


class SimulatedPerson:
    """A `Person` for `--yes` with a simulated cell: agrees to everything, and presses its emergency stop."""

    def __init__(self, console: Console, world_endpoints: Mapping[str, Any]) -> None:
        self._console, self._endpoints = console, world_endpoints

    def is_ready(self, announcement: str) -> bool:
        self._console.print(announcement, markup=False)
        return True

    def confirms(self, question: str) -> bool:
        self._console.print(f"{question} (not asked: simulated)", markup=False)
        return True

    def measures(self, quantity: str, question: str) -> float | None:
        """Measure with a ruler that the simulated cell has: it knows nothing of the rig."""
        length_mm = load_class(WORLD)(self._endpoints).ask("ruler").get(quantity)
        self._console.print(f"{question}: {length_mm} mm (measured in the simulation)", markup=False)
        return length_mm if length_mm is None else float(length_mm)

    def tell(self, message: str) -> None:
        self._console.print(message, markup=False)

    def hold_enabling_switch(self, *, is_held: bool) -> None:
        load_class(WORLD)(self._endpoints).ask("fault", fault={"kind": "enabling_switch", "held": is_held})

    def press_emergency_stop(self) -> None:
        load_class(WORLD)(self._endpoints).ask("fault", fault={"kind": "emergency_stop"})
