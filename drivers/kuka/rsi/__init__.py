"""KUKA arms over RobotSensorInterface. The driver corrects the axes or the pose in every cycle.

The driver is imported only on use. The answering process, `loop`, also imports this package, and must start
quickly and with few modules.
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
