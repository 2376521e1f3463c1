"""Plans and rigs in Python: read, built, checked, written.

The classes are the models of the YAML files; every key is an argument. Paths are absolute: a relative path is
relative to its file, or to the working folder if the model is built in Python. The name of a shipped rig, such as
`sim`, stays a name.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, field_validator
from ruamel.yaml import YAML

from coupole.errors import InputError
from coupole.intake.user_home import with_home
from coupole.plan import plan as plan_models
from coupole.plan import rig as rig_models
from coupole.plan import yamlfile
from coupole.plan.shipped_files import Kind, file_of, shipped_names
from coupole.storage.durable import write_synced

if TYPE_CHECKING:
    from coupole.preflight.preflight import Report

M = TypeVar("M", bound=BaseModel)


class Plan(plan_models.Plan):
    """One acquisition: the keys of a plan file; docs/reference/plan.md describes them with their units."""

    @field_validator("*", mode="after")
    @classmethod
    def _absolute(cls, value: Any) -> Any:
        return _with_paths(value, lambda path: path if _is_shipped_rig(path) else _from_here(path))

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Plan:
        """The plan of a YAML file, or the shipped one of this name. Raises InputError with all mistakes, each with
        file:line:column; the error's `problems` lists them."""
        document, plan = _read_model(Path(path), "plans", plan_models.Plan)
        return cls(**_fields(plan, lambda path_: path_ if _is_shipped_rig(path_) else document.resolve(path_)))

    def check(self, *, paths: bool = True, disk_speed: bool = True) -> Report:
        """Check the plan without a device, like preflight.

        Returns `refusals` and `warnings` (sentences), `views`, `shots`, `frames`, `bytes`, `duration_s` and
        `dose_lux_h`. The plan can be run if there are no refusals. Without `paths`, collisions are not checked;
        without `disk_speed`, the disk's speed is not measured.

        Raises InputError if the rig or another file that the plan names is wrong.
        """
        from coupole.preflight.checking import preflight_of
        from coupole.preflight.job import read_job, without_hidden

        job = read_job(Path(f"{self.name}.yaml"), text=self.text)
        job = without_hidden(job) if paths else job
        return preflight_of(job, job.cell.storage_folder, paths=paths, measure=disk_speed)[1]

    @property
    def text(self) -> str:
        """Return the plan as YAML, without keys that have their default values."""
        return _text(self)

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the plan as YAML and return `path`; `Plan.read` of this file gives an equal plan. Raises
        InputError if the file exists (unless `overwrite`); OSError."""
        return _write(self, Path(path), overwrite=overwrite)


class Rig(rig_models.Rig):
    """One cell: the keys of a rig file; docs/reference/rig.md describes them with their units."""

    @field_validator("*", mode="after")
    @classmethod
    def _absolute(cls, value: Any) -> Any:
        return _with_paths(value, _from_here)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Rig:
        """The rig of a YAML file, or the shipped one of this name (`sim`). Raises InputError with all mistakes,
        each with file:line:column."""
        document, rig = _read_model(Path(path), "rigs", rig_models.Rig)
        return cls(**_fields(rig, document.resolve))

    @property
    def text(self) -> str:
        """Return the rig as YAML, without keys that have their default values."""
        return _text(self)

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the rig as YAML and return `path`; `Rig.read` of this file gives an equal rig. Raises InputError
        if the file exists (unless `overwrite`); OSError."""
        return _write(self, Path(path), overwrite=overwrite)


def _read_model(path: Path, kind: Kind, model: type[M]) -> tuple[yamlfile.Document, M]:
    document = yamlfile.read_document(file_of(path, kind))
    return document, document.validate(model)


def _fields(model: BaseModel, resolve: Callable[[Path], Path]) -> dict[str, Any]:
    return {name: _with_paths(getattr(model, name), resolve) for name in type(model).model_fields}


def _with_paths(value: Any, resolve: Callable[[Path], Path]) -> Any:
    """Return the value with each of its paths resolved."""
    if isinstance(value, Path):
        return resolve(value)
    if isinstance(value, BaseModel):
        return value.model_copy(update=_fields(value, resolve))
    return tuple(_with_paths(part, resolve) for part in value) if isinstance(value, tuple) else value


def _from_here(path: Path) -> Path:
    return (Path.cwd() / with_home(path)).resolve()


def _is_shipped_rig(path: Path) -> bool:
    return path.name == str(path) and not path.is_file() and path.name in shipped_names("rigs")


def _text(model: BaseModel) -> str:
    """Return the YAML of a model; the version of its format comes first."""
    yaml: Any = YAML(typ="safe", pure=True)
    stream = io.StringIO()
    yaml.default_flow_style, yaml.width, yaml.sort_base_mapping_type_on_output = None, 4096, False
    yaml.dump(model.model_dump(mode="json", exclude_defaults=True), stream)
    return stream.getvalue()


def _write(model: Plan | Rig, path: Path, *, overwrite: bool) -> Path:
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists already; choose another name, or give overwrite=True")
    write_synced(path, model.text)
    return path
