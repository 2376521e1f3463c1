"""The LED control box that speaks SCPI."""

from drivers.ledbox.driver import LedBox, Settings

__all__ = ["LedBox", "Settings"]
