"""The LED control box that speaks SCPI."""

from drivers.ledbox.driver import LedBox
from drivers.ledbox.settings import Settings

__all__ = ["LedBox", "Settings"]
