"""Ximea cameras over the maker's library."""

from drivers.camera.xiapi.driver import XiCamera
from drivers.camera.xiapi.settings import Settings

__all__ = ["Settings", "XiCamera"]
