"""GigE Vision and USB3 Vision cameras over libaravis."""

from drivers.camera.aravis.driver import AravisCamera
from drivers.camera.aravis.settings import Settings

__all__ = ["AravisCamera", "Settings"]
