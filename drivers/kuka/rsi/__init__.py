"""KUKA arms over RobotSensorInterface: the driver corrects the axes or the pose in every cycle."""

from drivers.kuka.rsi.driver import KukaRsi, Settings

__all__ = ["KukaRsi", "Settings"]
