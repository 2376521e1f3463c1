"""Acquisition controller of La Coupole: plans in, proven frames out.

`import coupole` is fast, because each public name is imported when it is first used (PEP 562). The types are in
`__init__.pyi`; docs/how-to/from-python.md shows how to use them.
"""

import importlib
import os
from typing import Any

# Matrices here are small and many: OpenBLAS's threads cost more than they bring (six times on a busy machine of
# two cores, adjusting a mesh's pose), and simulator and stream want the cores. Set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.2.0"

_NAMES = {
    "open_run": "scripting.opened_run",
    "Run": "scripting.opened_run",
    "RunView": "scripting.opened_run",
    "Frame": "scripting.proven_frame",
    "open_result": "scripting.opened_result",
    "Result": "scripting.opened_result",
    "PicturesResult": "scripting.opened_result",
    "Materials": "scripting.opened_result",
    "FreeCamera": "reflectance.new_light.pictured_surface",
    "Plan": "scripting.plans",
    "Rig": "scripting.plans",
    "Report": "preflight.preflight",
    "acquire": "scripting.acquisition",
    "Acquisition": "scripting.acquisition",
    "open_cell": "scripting.cell_devices",
    "fit_reflectance": "scripting.analyses",
    "calibrate_camera": "scripting.analyses",
    "calibrate_colour": "scripting.colour_profiles",
    "CalibrationRecord": "scripting.analyses",
    "identify": "scripting.analyses",
    "PigmentFinding": "heritage.analysis.identification",
    "register": "scripting.analyses",
    "Registration": "scan.registration.registering",
    "compare": "scripting.analyses",
    "Comparison": "heritage.comparison.state_comparison",
}
"""Modules of this package by the public names that they define."""
_MODULES = {
    "errors": "errors",
    "events": "storage.journal_events",
    "lights": "reflectance.new_light.light_kinds",
    "testing": "testing",
}
"""Public modules by their names."""


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"coupole.{_MODULES[name]}")
    if name not in _NAMES:
        raise AttributeError(f"module 'coupole' has no attribute {name!r}")
    return getattr(importlib.import_module(f"coupole.{_NAMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_NAMES, *_MODULES})
