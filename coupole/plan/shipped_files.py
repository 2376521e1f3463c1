"""Files that come with Coupole: rigs, plans, domes, arms, objects and records of the simulated cells.

They are in `configs` of a checkout, and in `coupole/configs` of an installed package (pyproject.toml puts them
there). Only this module knows which of the two folders is used. The name of a shipped rig or plan may replace its
path: `sim` is `configs/rigs/sim.yaml`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

Kind = Literal["rigs", "plans", "robots"]
SIMULATED_CELL = Path("sim")
"""Name of the rig that is used if none is named."""
_PACKAGE = Path(__file__).resolve().parents[1]
_INSTALLED = _PACKAGE / "configs"


def shipped_folder() -> Path:
    """Folder of all shipped files."""
    return _INSTALLED if _INSTALLED.is_dir() else _PACKAGE.parent / "configs"


def shipped_names(kind: Kind) -> list[str]:
    """Names of the shipped files of a kind, sorted."""
    return sorted(path.stem for path in (shipped_folder() / kind).glob("*.yaml"))


def file_of(path: Path, kind: Kind) -> Path:
    """Return the path itself. If it is a single word and no such file exists, return the shipped file of that
    name, if there is one."""
    if path.name != str(path) or path.is_file() or path.name not in shipped_names(kind):
        return path
    return shipped_folder() / kind / f"{path.name}.yaml"


def place_to_write(folder: Path) -> Path:
    """Return the folder itself. For a folder in an installed package, where nobody writes, return the folder of
    the same name in the working folder."""
    if not _INSTALLED.is_dir() or not folder.is_relative_to(_PACKAGE):
        return folder
    return Path.cwd() / folder.relative_to(_PACKAGE)
