"""Universal Robots arms over RTDE.

The driver is imported only on use. The process that runs ur-rtde, `worker`, also imports this package, and starts
with few modules.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivers.ur.driver import Settings, UrRobot

__all__ = ["Settings", "UrRobot"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from drivers.ur import driver

    return getattr(driver, name)
