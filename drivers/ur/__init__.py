"""Universal Robots arms over RTDE."""

from drivers.ur.driver import Settings, UrRobot

__all__ = ["Settings", "UrRobot"]
