"""The interface of the camera stand-ins to the world, and the choice of one by the rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Protocol, assert_never

from pydantic import Discriminator, Tag

from sim.devices import camera_server, gige_camera
from sim.devices.camera_body import Surroundings
from sim.world import faults
from sim.world.reactor import Reactor


def _kind(settings: Any) -> str:
    """Return the kind of stand-in that these settings are for; shared memory by default."""
    return str(settings.get("kind", "memory") if isinstance(settings, dict) else settings.kind)


CameraSettings = Annotated[
    Annotated[camera_server.Settings, Tag("memory")] | Annotated[gige_camera.Settings, Tag("gige")],
    Discriminator(_kind),
]


class CameraStandIn(Protocol):
    """All methods are called on the reactor's thread. The GigE Vision stand-in also has `lose_control`: see
    `impossible`."""

    lose_frames: set[int]
    """Numbers of frames (counted from power-on) whose transfer is lost."""

    @property
    def is_armed(self) -> bool: ...

    def edge(self, t_ns: int) -> None:
        """A rising edge on the trigger line at world time `t_ns`."""
        ...

    def ready(self) -> bool:
        """The exposure-ready line."""
        ...

    def unplug(self) -> None:
        """Unplug the cable."""
        ...

    def close(self) -> None: ...


def impossible(fault: faults.Fault, settings: CameraSettings) -> str:
    """Return why this stand-in cannot simulate the fault; empty if it can."""
    if isinstance(fault, faults.CameraControlLoss) and settings.kind != "gige":
        return f"`camera_control_loss` cannot happen to a camera of kind `{settings.kind}`: it has no such channel"
    return ""


def build(
    reactor: Reactor,
    settings: CameraSettings,
    folder: Path,
    *,
    frame_format: dict[str, Any],
    surroundings: Surroundings,
) -> tuple[CameraStandIn, dict[str, Any]]:
    """Return the stand-in, and the driver settings with which a client reaches it.

    `frame_format` has the fields of `coupole.devices.FrameFormat`.
    """
    arguments: dict[str, Any] = {"frame_format": frame_format, "surroundings": surroundings}
    match settings:
        case camera_server.Settings():
            path = folder / "camera"
            return camera_server.CameraServer(reactor, settings, path=path, **arguments), {"address": str(path)}
        case gige_camera.Settings():
            return gige_camera.GigeCamera(reactor, settings, **arguments), {"address": settings.address}
        case _:
            assert_never(settings)
