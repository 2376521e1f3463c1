"""The interface of the robot stand-ins to the world, and the choice of one by the rig."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Protocol, assert_never

from pydantic import Discriminator, Tag

from coupole.geometry import Transform
from sim.devices import kuka_controller, kuka_eki_controller, ur_controller
from sim.strangers.arm_stranger import ArmStranger
from sim.world import faults
from sim.world.reactor import Reactor


def _kind(settings: Any) -> str:
    """Return the kind of stand-in that these settings are for; RSI by default."""
    return str(settings.get("kind", "rsi") if isinstance(settings, dict) else settings.kind)


RobotSettings = Annotated[
    Annotated[kuka_controller.Settings, Tag("rsi")]
    | Annotated[kuka_eki_controller.Settings, Tag("eki")]
    | Annotated[ur_controller.Settings, Tag("ur")],
    Discriminator(_kind),
]


class RobotStandIn(Protocol):
    """All methods are called on the reactor's thread. The RSI stand-in also has `late`: see `impossible`."""

    @property
    def joints_deg(self) -> tuple[float, ...]:
        """The present axes, as measured and reported by the controller."""
        ...

    @property
    def moving(self) -> bool: ...

    def true_base_from_flange(self) -> Transform:
        """True pose of the flange."""
        ...

    def estop(self) -> None: ...

    def reset(self) -> None:
        """Acknowledge all faults."""
        ...

    def lose_link(self, seconds: float) -> None: ...

    def nudge(self, joints_deg: Sequence[float], seconds: float | None = None) -> None:
        """Displace the arm by six angles, permanently, or until it springs back after `seconds`."""
        ...

    def close(self) -> None: ...


def impossible(fault: faults.Fault, settings: RobotSettings) -> str:
    """Return why this stand-in cannot simulate the fault; empty if it can."""
    if isinstance(fault, faults.LateRsi) and settings.kind != "rsi":
        return f"`late_rsi` cannot happen to a robot of kind `{settings.kind}`: it has no RSI answers"
    return ""


def build(
    reactor: Reactor, settings: RobotSettings, tell: Callable[[str], None], stranger: ArmStranger
) -> tuple[RobotStandIn, dict[str, Any]]:
    """Return the stand-in, and the driver settings with which a client reaches it. `tell` gets a line for every
    refused correction. `stranger` are errors of a KUKA's axes."""
    match settings:
        case kuka_controller.Settings():
            alike = {name: getattr(settings, name) for name in kuka_controller.ALIKE}
            kuka = kuka_controller.KukaController(reactor, settings, tell, stranger)
            paced_by_clock = settings.lock_step or reactor.clock.speed != 1.0
            declared_cycle = {"declared_cycle_ms": settings.cycle_ms} if paced_by_clock else {}
            # The host that a rehearsed rig names as its controller does not exist here.
            here = {"controller": "127.0.0.1", "any_controller_by": ""}
            endpoint = {"listen": kuka.sends_to, "sends_to": kuka.sends_to, **alike, **declared_cycle, **here}
            return kuka, endpoint
        case kuka_eki_controller.Settings():
            eki = kuka_eki_controller.KukaEkiController(reactor, settings, stranger)
            eki_settings = {"controller_is": settings.controller_is, "status_ms": settings.status_ms}
            return eki, {"address": eki.address, **eki_settings, "controller": "", "any_controller_by": ""}
        case ur_controller.Settings():
            ur = ur_controller.UrController(reactor, settings)
            return ur, {"host": ur.address}
        case _:
            assert_never(settings)
