"""KUKA arms by RobotSensorInterface: the driver corrects the path in every cycle."""

from drivers.kuka.rsi.driver import KukaRsi, Settings

__all__ = ["KukaRsi", "Settings"]
