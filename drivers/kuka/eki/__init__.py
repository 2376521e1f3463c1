"""KUKA arms by EthernetKRL: the driver names targets, the controller moves."""

from drivers.kuka.eki.driver import KukaEki, Settings

__all__ = ["KukaEki", "Settings"]
