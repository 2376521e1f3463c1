"""Universal Robots arms over RTDE.

The driver is imported when it is asked for: `worker`, the process that runs ur-rtde, has this package too, and
begins with little.
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
