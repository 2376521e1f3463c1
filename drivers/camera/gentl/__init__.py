"""Cameras over a GenTL producer."""

from drivers.camera.gentl.driver import GenTLCamera
from drivers.camera.gentl.settings import Settings

__all__ = ["GenTLCamera", "Settings"]
