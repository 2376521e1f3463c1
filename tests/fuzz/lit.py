"""Targets: lights that a user names in files."""

from __future__ import annotations

from pathlib import Path

from fuzz.target import Target

LIGHTS = """\
lights:
  - {kind: direction, towards: [0, 0, 1], strength: [1, 2, 3]}
  - {kind: led, number: 7}
  - {kind: point, at_mm: [0, 0, 300]}
  - {kind: area, at_mm: [0, 0, 300], normal: [0, 0, -1], width_mm: 100, height_mm: 20}
  - {kind: environment, file: sky.exr, turn_deg: 90, strength: 0.5}
"""


def sky_exr() -> list[bytes]:
    import tempfile

    import numpy as np
    import OpenEXR

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sky.exr"
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGB": np.ones((4, 8, 3), np.float32)}).write(str(path))
        return [path.read_bytes()]


def sky_hdr() -> list[bytes]:
    import cv2
    import numpy as np

    return [cv2.imencode(".hdr", np.ones((4, 8, 3), np.float32))[1].tobytes()]


def read_lights(path: Path) -> None:
    from coupole.reflectance.new_light.light_kinds import read_lights

    read_lights(path)


def read_sky(path: Path) -> None:
    import numpy as np

    from coupole.reflectance.new_light.environment import OF_RUNS, read_environment

    read_environment(path, OF_RUNS, np.ones(3))


LIT = (
    Target("lights", "plans/lights.yaml", lambda: [LIGHTS.encode()], read_lights),
    Target("environment-exr", "plans/sky.exr", sky_exr, read_sky),
    Target("environment-hdr", "plans/sky.hdr", sky_hdr, read_sky),
)
