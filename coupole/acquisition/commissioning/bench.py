"""Common data of all steps of a commissioning: the opened cell, the person, and the result that grows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import OpenedCell
from coupole.calibration.record import Limit
from coupole.errors import Interrupted
from coupole.motion.collisions import CellBodies
from coupole.plan.cell import Cell
from coupole.preflight.commissioned import Answer


class Person(Protocol):
    """Person at the cell."""

    def is_ready(self, announcement: str) -> bool:
        """Ask the person to confirm before something moves or is lit."""
        ...

    def confirms(self, question: str) -> bool:
        """Tell whether the person saw what is described."""
        ...

    def measures(self, quantity: str, question: str) -> float | None:
        """Ask for a length by ruler, mm; None if it was not measured. `quantity` is the question's name."""
        ...

    def tell(self, message: str) -> None:
        """Show a message that needs no answer."""
        ...

    def hold_enabling_switch(self, *, is_held: bool) -> None:
        """Asks for the enabling switch to be held, or released; returns at once."""
        ...

    def press_emergency_stop(self) -> None:
        """Asks for the emergency stop to be pressed; returns at once."""
        ...


Say = Callable[[str, int, int], None]
"""Called with a job's name, the number of finished parts, and the number of all parts."""


class StepFailedError(Exception):
    """A step cannot be brought to an end; the text says what was wrong and what to do."""


@dataclass
class Findings:
    """Findings of a step so far."""

    limits: list[Limit] = field(default_factory=list)
    answers: list[Answer] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    remedy: str = ""
    """Action for the case that a limit is exceeded, or that the person answers no."""

    def at_most(self, quantity: str, figure: float, limit: float, unit: str) -> bool:
        """Note a figure and its limit; returns whether it is met. A figure that is not finite does not meet the
        limit."""
        finite_figure = float(figure) if np.isfinite(figure) else 1e9
        self.limits.append(
            Limit(what=quantity, found=round(finite_figure, 6), limit=round(float(limit), 6), unit=unit)
        )
        return self.limits[-1].is_met

    @property
    def has_passed(self) -> bool:
        """True if all is well so far."""
        return all(entry.is_met for entry in self.limits) and all(entry.yes for entry in self.answers)


@dataclass
class Bench:
    """One session of commissioning."""

    cell: Cell
    """Cell with the rig at reduced speed."""
    opened: OpenedCell
    bodies: CellBodies
    """Bodies of an empty cell: no object lies on the support."""
    velocity_deg_s: NDArray[np.float64]
    """[6] greatest speeds of the axes in this session."""
    person: Person
    control: Control
    findings: Findings = field(default_factory=Findings)
    bars: Callable[[], AbstractContextManager[Say]] = lambda: nullcontext(lambda *_: None)
    """Shows the progress of a long job while the context lasts."""
    board: Path | None = None
    """The file that describes the board on the support; None: the one of docs/how-to/commission-a-cell.md."""

    def iterate(self, label: str, numbers: Iterable[int]) -> Iterator[int]:
        """Go through the numbers, with a progress bar. Raises Interrupted between two of them after the operator's
        stop."""
        all_numbers = list(numbers)
        with self.bars() as say:
            for k, number in enumerate(all_numbers):
                self.control.go_on()
                yield number
                say(label, k + 1, len(all_numbers))

    def ask_before(self, announcement: str) -> None:
        """Ask the person to agree. Raises Interrupted if the person does not."""
        self.control.go_on()
        is_ready = self.person.is_ready(announcement)
        self.control.go_on()
        if not is_ready:
            raise Interrupted("the commissioning was not continued; the steps that were done are kept")

    def ask_whether(self, question: str) -> bool:
        """Ask the person what was seen; the answer is noted. Raises Interrupted after the operator's stop, because
        a stop is not an answer."""
        self.control.go_on()
        yes = self.person.confirms(question)
        self.control.go_on()
        self.findings.answers.append(Answer(question=question, yes=yes))
        return yes

    def measured_mm(self, quantity: str, question: str) -> float:
        """Ask the person to measure a length, mm, and note it. Raises StepFailedError if it was not measured, and
        Interrupted after the operator's stop."""
        self.control.go_on()
        found_mm = self.person.measures(quantity, question)
        self.control.go_on()
        if found_mm is None:
            raise StepFailedError(f"not measured: {question}. Repeat the step with ruler and tape at hand")
        self.findings.remarks.append(f"measured: {question}: {found_mm:g} mm")
        return found_mm

    def pause(self, seconds: float) -> None:
        """Wait on the rig's clock. Raises Interrupted after the operator's stop."""
        self.control.go_on()
        self.opened.clock.sleep(seconds)
        self.control.go_on()

    def joints_deg(self) -> NDArray[np.float64]:
        """Return the axes [6] as measured now."""
        return np.array(self.opened.robot.measured().joints_deg)

    def go_to(self, joints_deg: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move straight to joint angles [6], wait until settled; returns the measured ones. Raises StepFailedError
        if something would be touched on the way."""
        self.control.go_on()
        if contact := self.bodies.contact_on_the_way(self.joints_deg(), joints_deg):
            raise StepFailedError(
                f"{contact}: jog the arm to where it has room on all sides, then repeat the step"
            )
        self.opened.robot.move_to(joints_deg)
        measured_deg = np.array(self.opened.robot.wait_settled().joints_deg)
        self.control.go_on()
        return measured_deg

    def clear_change(self, change_deg: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the change [6] of the axes or its opposite: the one that touches nothing and stays within the
        axes' limits.

        Raises StepFailedError if both fail.
        """
        here_deg = self.joints_deg()
        low, high = np.array(self.arm_limits_deg).T
        for sign in (1.0, -1.0):
            there_deg = here_deg + sign * change_deg
            if np.all((there_deg >= low) & (there_deg <= high)) and self.bodies.is_clear(here_deg, there_deg):
                return sign * change_deg
        raise StepFailedError(
            "the arm has no room for a motion of a few degrees either way: jog it to where it has room on all "
            "sides, "
            "then repeat the step"
        )

    @property
    def arm_limits_deg(self) -> tuple[tuple[float, float], ...]:
        from coupole.motion.itinerary import arm_of

        return arm_of(self.cell.rig).limits_deg
