"""Making a cell safe: everything is tried, nothing waits for another, no signal cuts it short."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from coupole.acquisition import opened_cell, safeguard
from coupole.acquisition.noted_devices import NotedDevice
from coupole.acquisition.opened_cell import OpenedCell
from coupole.errors import DeviceLost, DeviceRefused

LOST = DeviceLost("device", expected="an answer", happened="there was none", remedy="None.")


def nothing() -> None:
    """What a device does that has nothing to do."""


def cell_of(
    lights_off: Callable[[], None] = nothing,
    stop: Callable[[], None] = nothing,
    disarm: Callable[[], None] = nothing,
) -> OpenedCell:
    """A cell whose three devices do just this."""
    devices: dict[str, Any] = {
        "ledbox": SimpleNamespace(lights_off=lights_off),
        "robot": SimpleNamespace(stop=stop),
        "camera": SimpleNamespace(disarm=disarm),
    }
    unused: Any = None
    return OpenedCell(
        clock=unused, sensor=unused, is_simulated=True, world_endpoints=None, identities={}, **devices
    )


def raising(error: BaseException, called: list[str], what: str) -> Callable[[], None]:
    def act() -> None:
        called.append(what)
        raise error

    return act


@pytest.mark.parametrize("error", [LOST, ValueError("a defect"), SystemExit(3), KeyboardInterrupt()], ids=repr)
def test_each_device_is_made_safe_though_the_others_raise_and_all_is_told(error: BaseException) -> None:
    called: list[str] = []
    cell = cell_of(*(raising(error, called, what) for what in ("lights off", "arm stopped", "camera disarmed")))
    cell.make_safe()
    assert sorted(called) == ["arm stopped", "camera disarmed", "lights off"]
    assert called[-1] == "camera disarmed"
    assert [trouble.partition("(")[2].partition(")")[0] for trouble in cell.trouble] == [
        "lights off",
        "arm stopped",
        "camera disarmed",
    ]
    assert not cell.arm_confirmed


def test_lights_and_arm_wait_neither_for_each_other() -> None:
    """Each of them ends only when the other has begun."""
    begun = {"lights": threading.Event(), "arm": threading.Event()}
    met: list[bool] = []

    def act(mine: str, other: str) -> Callable[[], None]:
        def run() -> None:
            begun[mine].set()
            met.append(begun[other].wait(10.0))

        return run

    cell = cell_of(act("lights", "arm"), act("arm", "lights"))
    cell.make_safe()
    assert met == [True, True]
    assert cell.trouble == []
    assert cell.arm_confirmed


def test_what_hangs_is_given_up_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safeguard, "_SAFE_WITHIN_S", 0.05)
    for_ever, disarmed = threading.Event(), threading.Event()
    cell = cell_of(stop=lambda: for_ever.wait() and None, disarm=disarmed.set)
    cell.make_safe()
    for_ever.set()
    assert disarmed.is_set()
    assert cell.trouble == ["not sure that it is safe (arm stopped): no answer within 0.05 s"]
    assert not cell.arm_confirmed


def test_whatever_ends_the_use_of_a_cell_it_is_made_safe_before_its_devices_are_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[str] = []
    device = SimpleNamespace(
        identify=lambda: None,
        lights_off=lambda: done.append("lights off"),
        stop=lambda: done.append("arm stopped"),
        disarm=lambda: done.append("camera disarmed"),
        close=lambda: done.append("closed"),
    )
    monkeypatch.setattr(opened_cell, "in_world", lambda rig, dry_run: False)
    monkeypatch.setattr(opened_cell, "in_use", lambda cell: contextlib.nullcontext())
    monkeypatch.setattr(opened_cell, "remember_controller", lambda cell, identity: None)
    monkeypatch.setattr(opened_cell, "_open_device", lambda *arguments, **named: device)
    cell: Any = SimpleNamespace(rig=SimpleNamespace(sensor=None))
    with pytest.raises(LookupError), opened_cell.open_cell(cell):
        raise LookupError
    assert sorted(done[:2]) == ["arm stopped", "lights off"]
    assert done[2:] == ["camera disarmed", "closed", "closed", "closed"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_does_not_cut_it_short(number: signal.Signals) -> None:
    class CutShortError(Exception):
        """What the handler outside raises."""

    def handler(*_: Any) -> None:
        raise CutShortError

    disarmed = threading.Event()
    before = signal.signal(number, handler)
    try:
        cell_of(lights_off=lambda: os.kill(os.getpid(), number), disarm=disarmed.set).make_safe()
        assert disarmed.is_set()
        assert signal.getsignal(number) is handler
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize(
    ("kind", "name", "arguments"),
    [
        ("ledbox", "start", ()),
        ("ledbox", "flash", (7, 100.0)),
        ("ledbox", "panel", (1, True)),
        ("robot", "move_to", ([0.0] * 6,)),
    ],
)
def test_nothing_is_lit_or_moved_once_the_cell_was_made_safe(
    kind: str, name: str, arguments: tuple[Any, ...]
) -> None:
    """By a thread that was left behind in a call, and whose call returned after all."""
    called: list[str] = []
    made_safe, no_rig = threading.Event(), cast("Any", None)
    device = NotedDevice(SimpleNamespace(**{name: lambda *_: called.append(name)}), kind, no_rig, made_safe)
    getattr(device, name)(*arguments)
    assert called == [name]
    made_safe.set()
    with pytest.raises(DeviceRefused, match="no light and no motion after the cell was made safe"):
        getattr(device, name)(*arguments)
    assert called == [name]


def test_lamps_are_switched_off_and_the_arm_is_stopped_once_the_cell_was_made_safe() -> None:
    called: list[str] = []
    made_safe, no_rig = threading.Event(), cast("Any", None)
    made_safe.set()
    box = SimpleNamespace(lights_off=lambda: called.append("off"), panel=lambda *_: called.append("panel off"))
    arm = SimpleNamespace(stop=lambda: called.append("arm stopped"))
    NotedDevice(box, "ledbox", no_rig, made_safe).lights_off()
    NotedDevice(box, "ledbox", no_rig, made_safe).panel(1, False)
    NotedDevice(arm, "robot", no_rig, made_safe).stop()
    assert called == ["off", "panel off", "arm stopped"]


def test_a_cell_that_is_safe_is_not_commanded_again() -> None:
    called: list[str] = []
    cell = cell_of(lights_off=lambda: called.append("off"))
    cell.make_safe()
    cell.make_safe()
    assert called == ["off"]
