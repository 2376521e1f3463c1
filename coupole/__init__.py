"""Acquisition controller of La Coupole: plans in, proven frames out.

`import coupole` is fast, because each public name is imported when it is first used (PEP 562). The types are in
`__init__.pyi`; docs/how-to/from-python.md shows how to use them.
"""

import importlib
import os
import stat
import tempfile
from pathlib import Path
from typing import Any

# Matrices here are small and many: OpenBLAS's threads cost more than they bring (six times on a busy machine of
# two cores, adjusting a mesh's pose), and simulator and stream want the cores. Set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _is_writable(folder: Path) -> bool:
    """Tell whether a folder can be written, or made."""
    there = next((path for path in (folder, *folder.parents) if path.exists()), Path("/"))
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _keep_kernels_somewhere() -> None:
    """Give numba a folder for its compiled code, which is usually beside the package or in the user's cache. If
    neither can be written (another user's installation, no home), it is a folder of this user among the temporary
    files. A folder there that belongs to another user is not used, because code is loaded from it. Call this
    before numba is imported.
    """
    places = (Path(__file__).parent, Path("~/.cache").expanduser())
    if "NUMBA_CACHE_DIR" in os.environ or any(map(_is_writable, places)):
        return
    place = Path(tempfile.gettempdir()) / f"coupole-kernels-{os.getuid()}"
    try:
        place.mkdir(mode=0o700, exist_ok=True)
        state = place.lstat()
        is_own = stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o077
    except OSError:
        is_own = False
    os.environ["NUMBA_CACHE_DIR"] = str(place) if is_own else tempfile.mkdtemp(prefix="coupole-kernels-")


_keep_kernels_somewhere()

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
