"""KUKA arms over RobotSensorInterface: the driver corrects the axes or the pose in every cycle.

The driver is imported when it is asked for: `loop`, the process that answers, has this package too, and must begin
soon and with little.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivers.kuka.rsi.driver import KukaRsi, Settings

__all__ = ["KukaRsi", "Settings"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from drivers.kuka.rsi import driver

    return getattr(driver, name)
