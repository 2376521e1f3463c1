"""Panel after a fault of the arm, which a named person at the cell must confirm."""

from __future__ import annotations

from nicegui import ui

from coupole.console.screens.parts import button, panel, with_name
from coupole.console.screens.visit import Visit
from coupole.errors import InputError
from coupole.storage.arm_faults import faults_of


class FaultOfArm:
    """Panel that is shown until the arm's fault is confirmed."""

    def __init__(self, visit: Visit) -> None:
        self._visit = visit
        self._panel = panel("The arm has a fault")
        with self._panel:
            self._words = ui.label().classes("bad")
            ui.label("Find its cause and check that the cell is clear; then confirm, with your name.").classes(
                "hint"
            )
            self._cause = with_name(ui.input("What the cause was").classes("field"), "cause")
            self._confirm = button(
                "I was at the cell: the arm may move", self._confirm_fault, name="confirm", kind="main"
            )

    def show(self, fault: str) -> None:
        """`fault` is empty if there is none."""
        self._panel.set_visibility(bool(fault))
        self._words.text = fault
        self._confirm.set_enabled(self._visit.may_act)

    async def _confirm_fault(self) -> None:
        account, cause = self._visit.account, str(self._cause.value or "").strip()
        faults = faults_of(self._visit.service.cell)

        shown_message = self._words.text

        def confirm() -> bool:
            if not cause or account is None:
                raise InputError("expected the cause")
            if (standing := faults.standing()) and standing[-1].message != shown_message:
                raise InputError(f"there is another fault now: {standing[-1].message}")
            faults.confirm(account.name, cause)
            return True

        if await self._visit.act(
            f"confirm the arm: {cause}", confirm, done_text="confirmed: the arm may move again"
        ):
            self._cause.set_value("")
