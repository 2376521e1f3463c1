"""Opening and closing the cell's devices: the top part of the screens that use them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from coupole.console.screens.parts import Choice, button, panel, with_name
from coupole.console.screens.visit import Visit, in_thread

_LOOK_EVERY_S = 0.2
_NOTHING = ""


class BenchBar:
    """Shows whether the devices are open, and opens and closes them."""

    def __init__(self, visit: Visit, show: Callable[[dict[str, Any] | None], object]) -> None:
        """`show` is called with the bench's state when it changes; None means that the devices are closed."""
        self._visit, self._bench, self._show = visit, visit.service.bench, show
        self._shown: object = ()
        with panel(), ui.row().classes("bar"):
            self._words = with_name(ui.label(), "bench").props("role=status")
            ui.space()
            self._plan = Choice("On the support lies the object of", {_NOTHING: "nothing"}, name="object-plan")
            self._open = button("Open the devices", self._open_devices, icon="power", name="open", kind="main")
            self._close = button("Close the devices", self._close_devices, icon="power_off", name="close")
        self._tell()
        ui.timer(0.0, self._offer_plans, once=True)
        ui.timer(_LOOK_EVERY_S, self._tell)

    async def _offer_plans(self) -> None:
        names = await in_thread(self._visit.service.plan_files.names)
        options = {name: name for name in names} | {_NOTHING: "no plan: the support is empty"}
        self._plan.set_options(options, names[0] if names else _NOTHING)

    async def _open_devices(self) -> None:
        account, plan = self._visit.account, self._plan.value
        name = account.name if account else ""
        await self._visit.act(f"open the devices, {plan or 'empty'}", lambda: self._bench.open(name, plan))

    async def _close_devices(self) -> None:
        trouble = await self._visit.act("close the devices", self._bench.close)
        if trouble:
            self._visit.say("; ".join(trouble), bad=True)

    def _tell(self) -> None:
        if self._visit.is_watched:
            self._bench.looked_at()
        bench, now = self._bench, self._visit.now
        phase, may = bench.phase, self._visit.may_act
        busy = bool(now.run) or now.state in ("starting", "concluding")
        state = phase, may, busy, bench.closed_because, bench.plan, bench.state
        if state == self._shown:
            return
        self._shown = state
        self._words.text = self._phase_words(phase, busy=busy)
        is_closed = phase == "closed"
        self._open.set_visibility(is_closed)
        self._plan.set_visibility(is_closed)
        self._close.set_visibility(not is_closed)
        self._open.set_enabled(may and not busy)
        self._close.set_enabled(may and phase in ("open", "opening"))
        self._show(bench.state if phase == "open" else None)

    def _phase_words(self, phase: str, *, busy: bool) -> str:
        bench = self._bench
        match phase:
            case "opening":
                return "The devices are being opened."
            case "closing":
                return "The cell is made safe, and the devices are closed."
            case "open" if not bench.is_own:
                return "The devices are open, by another program than this console."
            case "open":
                lies = f"the object of {bench.plan} lies on the support" if bench.plan else "the support is empty"
                return f"The devices are open; {lies}."
        if busy:
            return "A run is using the devices."
        why = f" ({bench.closed_because})" if bench.closed_because else ""
        return f"The devices are closed{why}."
