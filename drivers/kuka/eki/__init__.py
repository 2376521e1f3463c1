"""KUKA arms over EthernetKRL: the driver sends targets, the controller plans and runs the motion."""

from drivers.kuka.eki.driver import KukaEki
from drivers.kuka.eki.settings import Settings

__all__ = ["KukaEki", "Settings"]
