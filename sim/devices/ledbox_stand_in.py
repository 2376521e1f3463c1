"""The interface of the LED box stand-ins to the world, and the choice of one by the rig."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Protocol, assert_never

from pydantic import Discriminator, Tag

from sim.devices import ledbox_firmware, text_box
from sim.devices.camera_stand_in import CameraStandIn
from sim.world import faults
from sim.world.lighting import Lighting
from sim.world.reactor import Reactor


def _kind(settings: Any) -> str:
    """Return the kind of stand-in that these settings are for; the SCPI box by default."""
    return str(settings.get("kind", "scpi") if isinstance(settings, dict) else settings.kind)


LedBoxSettings = Annotated[
    Annotated[ledbox_firmware.Settings, Tag("scpi")] | Annotated[text_box.Settings, Tag("text")],
    Discriminator(_kind),
]


class LedBoxStandIn(Protocol):
    """All methods are called on the reactor's thread. Each kind has further methods: see `impossible`."""

    port: str
    """The port that a client opens."""
    dead_leds: set[int]
    """LEDs that give no light from now on."""

    def temperature_of_led_c(self, led: int) -> float: ...

    def mute(self, seconds: float | None = None) -> None:
        """Neither receive nor answer, for ever or for `seconds`."""
        ...

    def unplug(self) -> None:
        """Unplug its cable to the host."""
        ...

    def close(self) -> None: ...


_EDGE_FAULTS = (faults.DropTrigger, faults.DoubleTrigger, faults.OverTemperature)


def impossible(fault: faults.Fault, settings: LedBoxSettings) -> str:
    """Return why this stand-in cannot simulate the fault; empty if it can."""
    match settings:
        case ledbox_firmware.Settings():
            boards = -(-settings.led_count // settings.leds_per_board)
            if isinstance(fault, faults.OverTemperature) and fault.board >= boards:
                return f"`{fault.kind}`: the LED box has boards 0 to {boards - 1}, not {fault.board}"
            if isinstance(fault, faults.EnablingSwitch) and settings.enabling_switch == "none":
                return (
                    f"`{fault.kind}`: the LED box has no input for an enabling switch; give it "
                    "`enabling_switch: released`"
                )
            if isinstance(fault, faults.StuckLed):
                return f"`{fault.kind}` cannot happen to an LED box of kind `scpi`: it switches all current off"
        case text_box.Settings():
            if isinstance(fault, (*_EDGE_FAULTS, faults.EnablingSwitch)):
                why = "it sends no edges, feels no heat and has no inputs"
                return f"`{fault.kind}` cannot happen to an LED box of kind `text`: {why}"
            if isinstance(fault, faults.When) and fault.at_edge is not None:
                return "`at_edge`: an LED box of kind `text` sends no edges. Use `at_s`"
        case _:
            assert_never(settings)
    return ""


def build(
    reactor: Reactor,
    settings: LedBoxSettings,
    *,
    camera: CameraStandIn,
    lighting: Lighting,
    on_light: Callable[[int, int, int], None],
    on_edge_counted: Callable[[int], None],
) -> LedBoxStandIn:
    """Return the stand-in, connected to the trigger cable and to the lighting. `on_edge_counted(number)` tells the
    number of each edge to faults that wait for an edge."""
    match settings:
        case ledbox_firmware.Settings():
            cables = ledbox_firmware.BoxCables(camera.edge, on_light, lighting.dark, lighting.panel, camera.ready)
            box = ledbox_firmware.LedBoxFirmware(reactor, settings, cables)
            box.on_edge_counted = on_edge_counted
            return box
        case text_box.Settings():
            return text_box.TextBox(reactor, settings, on_light=on_light, on_dark=lighting.darken_one)
        case _:
            assert_never(settings)
