"""Still cameras whose RAW files appear in a folder."""

from drivers.camera.raw.driver import RawFiles, Settings

__all__ = ["RawFiles", "Settings"]
