"""Parts of all screens: the header with the cell's state, its dose, pause and stop, and the navigation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from nicegui import ui

from coupole.console.routes.messages import StateNow
from coupole.console.screens.parts import button
from coupole.console.screens.visit import Visit
from coupole.viewing.terminal import duration_text

NO_EMERGENCY_STOP = "Stop here is not an emergency stop: the emergency stop is the red button at the cell."
WORDS = {
    "idle": "idle",
    "starting": "starting",
    "running": "running",
    "pausing": "pausing: this burst ends first",
    "paused": "paused: lights off, arm still",
    "stopping": "stopping",
    "concluding": "concluding: the report is being made",
    "silent": "the run does not answer",
    "halted": "waits for a person",
}
AT_WORK = ("starting", "running", "pausing", "paused", "stopping", "concluding", "silent")
_LIVE = ("running", "pausing", "paused")


@dataclass(frozen=True)
class Place:
    """An entry of the navigation."""

    path: str
    title: str
    icon: str


@contextmanager
def screen_frame(visit: Visit, here: Place, places: Sequence[Place]) -> Iterator[None]:
    """Build a screen's content inside the frame."""
    ui.html('<a class="skip" href="#screen">Skip to the screen</a>', sanitize=False)
    drawer = _navigation(here, places)
    with ui.header(elevated=False).classes("head"):
        with ui.row().classes("head-row"):
            button("", drawer.toggle, icon="menu", name="menu", kind="flat").props('aria-label="screens"')
            ui.label("Coupole").classes("brand")
            _what_it_is(visit)
            _state(visit)
            ui.space()
            _buttons(visit)
            _person(visit)
        with ui.row().classes("head-row thin"):
            _devices(visit)
            _dose(visit)
        _alarms(visit)
    with ui.element("main").props("id=screen tabindex=-1").classes("screen"):
        ui.html(f"<h1>{here.title}</h1>", sanitize=False)
        yield
    visit.watch()


def _navigation(here: Place, places: Sequence[Place]) -> ui.left_drawer:
    with ui.left_drawer(bordered=True).props("breakpoint=900 width=190").classes("drawer") as drawer:  # noqa: SIM117
        with ui.element("nav").props('aria-label="screens"'):
            for place in places:
                link = ui.link(target=place.path).classes("place")
                if place == here:
                    link.classes("here").props('aria-current="page"')
                with link:
                    ui.icon(place.icon).props("aria-hidden=true")
                    ui.label(place.title)
    return drawer


def _what_it_is(visit: Visit) -> None:
    now = visit.now
    ui.label(now.rig).classes("rig")
    ui.label("simulated" if now.simulated else "REAL").classes(
        "chip " + ("simulated" if now.simulated else "real")
    )


def _state(visit: Visit) -> None:
    chip = ui.label().classes("chip state").props("role=status data-name=state")

    def show(now: StateNow) -> None:
        words = f"lent to {now.lent_to}" if now.lent_to and now.state == "idle" else WORDS[now.state]
        if now.state in _LIVE:
            words += f": {now.view or '-'}, {now.proven} of {now.frames}"
            words += f", {duration_text(now.left_s)} left" if now.left_s is not None else ""
        chip.text = words
        chip.props(f"data-state={now.state}")

    visit.follow(show)


def _buttons(visit: Visit) -> None:
    async def pause() -> None:
        now = visit.now
        if now.run:
            run, command = now.run, "go-on" if now.state in ("paused", "pausing") else "pause"
            await visit.act(
                f"{command} {run}",
                lambda: visit.service.acquisitions.tell(run, command),  # type: ignore[arg-type]
                acts=command == "go-on",
            )

    async def stop() -> None:
        now = visit.now
        entry = next((entry for entry in now.queue if entry.state == "running"), None)
        if now.run:
            run = now.run
            answer = await visit.act(
                f"stop {run}", lambda: visit.service.acquisitions.tell(run, "stop"), acts=False
            )
            if answer is not None:
                trouble = answer.get("trouble") or []
                words = "; ".join(trouble) or "stopped: lights off, arm commanded to stop, camera disarmed"
                visit.say(words, bad=bool(trouble))
        elif entry is not None:
            await visit.act(f"stop {entry.id}", lambda: visit.service.acquisitions.stop(entry), acts=False)
        elif visit.service.bench.phase != "closed":
            await stop_bench(visit)
        elif now.lent_to:
            lending = visit.service.acquisitions.lending
            await visit.act(f"stop what the cell is lent for: {now.lent_to}", lending.interrupt, acts=False)

    pausing = button("Pause", pause, icon="pause", name="pause")
    stopping = button("Stop", stop, icon="stop", name="stop", kind="stop")
    stopping.tooltip(NO_EMERGENCY_STOP)

    def show(now: StateNow) -> None:
        is_paused = now.state in ("paused", "pausing")
        pausing.set_text("Go on" if is_paused else "Pause")
        pausing.props(f"icon={'play_arrow' if is_paused else 'pause'}")
        pausing.set_enabled(visit.may_act and now.run is not None and now.state in _LIVE)
        stopping.set_enabled(visit.may_act and can_be_stopped(now))

    visit.follow(show)


def can_be_stopped(now: StateNow) -> bool:
    """True if a run or a task is active, if devices are open, or if the cell is lent for work that may move and
    light."""
    runs = any(entry.state == "running" for entry in now.queue)
    return runs or now.state in AT_WORK or bool(now.devices) or bool(now.lent_to)


def light_words(now: StateNow) -> str:
    """Return the header's text about light. The text says that no light is given, but only if nothing can give
    light.
    """
    if now.run:
        budget = f" of {now.dose_budget:g}" if now.dose_budget else ""
        return f"light on {now.object or 'the object'}: {now.dose_before + now.dose:.3f} lux h{budget}"
    if now.devices or now.lent_to:
        return (
            "light may be given: the devices are open" if now.devices else "light may be given: the cell is lent"
        )
    return "no light is given" if now.state in ("idle", "halted", "concluding") else "light may be given"


async def stop_bench(visit: Visit) -> None:
    """Stop the work of the open devices."""
    troubles = await visit.act("stop the devices", visit.service.bench.stop, acts=False)
    if troubles is not None:
        visit.say("; ".join(troubles) or "stopped: lights off, arm commanded to stop", bad=bool(troubles))


def _person(visit: Visit) -> None:
    account = visit.account
    if account is None:
        return
    with (
        button(account.name, lambda: None, icon="person", name="person", kind="flat"),
        ui.menu().props("auto-close"),
        ui.column().classes("menu"),
    ):
        ui.label(f"{account.name}, {account.role.word}")
        control_label = ui.label()
        ui.label(NO_EMERGENCY_STOP).classes("small")
        control = visit.service.control

        async def take() -> None:
            await visit.act("take control", lambda: control.take(account), acts=False)

        async def give() -> None:
            to = visit.now.asked_by
            await visit.act("give control", lambda: control.give(account, to), acts=False)

        taking = button("Take control", take, name="take", kind="flat")
        giving = button("Give control up", give, name="give", kind="flat")
        button("Sign out", lambda: _sign_out(visit), name="sign-out", kind="flat")

        def show(now: StateNow) -> None:
            has_control = now.in_control == account.name
            control_label.text = (
                "you are in control" if has_control else f"in control: {now.in_control or 'nobody'}"
            ) + (f"; asked by {now.asked_by}" if now.asked_by else "")
            taking.set_visibility(not has_control and visit.may_act)
            taking.set_text("Ask for control" if now.in_control and not visit.is_engineer else "Take control")
            giving.set_visibility(has_control)
            giving.set_text(f"Give control to {now.asked_by}" if now.asked_by else "Give control up")

        visit.follow(show)


def _sign_out(visit: Visit) -> None:
    visit.sign_out()
    ui.navigate.to("/")


def _devices(visit: Visit) -> None:
    with ui.row().classes("devices").props('role=list aria-label="devices"'):
        lights = {
            kind: ui.label(words).classes("device").props("role=listitem")
            for kind, words in (("ledbox", "LED box"), ("camera", "camera"), ("robot", "arm"))
        }

    def show(now: StateNow) -> None:
        for kind, light in lights.items():
            fault = kind == "robot" and bool(now.arm_fault)
            state = "fault" if fault else "open" if kind in now.devices else "closed"
            light.props(f'data-state={state} aria-label="{light.text}: {state}"')

    visit.follow(show)


def _dose(visit: Visit) -> None:
    with ui.row().classes("dose"):
        bar = (
            ui.linear_progress(0.0, show_value=False).props('aria-label="dose of the object"').classes("dose-bar")
        )
        words = ui.label().props("data-name=dose")

    def show(now: StateNow) -> None:
        total = now.dose_before + now.dose
        words.text = light_words(now)
        bar.set_value(min(1.0, total / now.dose_budget) if now.run and now.dose_budget else 0.0)
        bar.set_visibility(bool(now.run and now.dose_budget))

    visit.follow(show)


def _alarms(visit: Visit) -> None:
    alarm = ui.label().classes("alarm").props("role=alert data-name=alarm")

    def show(now: StateNow) -> None:
        arm = f"fault of the arm: {now.arm_fault}" if now.arm_fault else ""
        alarm.text = " · ".join(words for words in (arm, now.halted, now.trouble) if words)
        alarm.set_visibility(bool(alarm.text))

    visit.follow(show)
