"""Model of run.json: the fields that the program needs to continue the run. The file may have more fields."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from coupole.errors import InputError, reason
from coupole.intake.plain_data import read_json
from coupole.plan.shot_id import ShotLabel
from coupole.storage.inner_path import InnerPath

SCHEMA_VERSION = 1
RUN_JSON = "run.json"


def _label(text: str) -> str:
    ShotLabel.parse(text)
    return text


def _time(text: str) -> str:
    if datetime.fromisoformat(text).tzinfo is None:
        raise ValueError("expected a time with its zone")
    return text


def _plain(text: str) -> str:
    if "/" in text or "\0" in text or text in {".", ".."}:
        raise ValueError("expected a name without `/`")
    return text


Label = Annotated[str, AfterValidator(_label)]
View = Annotated[str, Field(min_length=1), AfterValidator(_plain)]


class _Part(BaseModel):
    """Keys that are not named here are kept as they are."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="allow", strict=True)


class _Software(_Part):
    name: str
    version: str


class _Device(_Part):
    model: str
    serial: str


class _File(_Part):
    path: str
    sha256: str
    stored: InnerPath | None = None


class _Description(_Part):
    schema_version: Literal[1]
    software: _Software
    created: Annotated[str, AfterValidator(_time)]
    operator: str
    simulated: bool
    proof: str = ""
    object: str | None = None
    calibrations: str | dict[str, str] = "none"
    devices: dict[str, _Device] = Field(default_factory=dict)
    views: list[View]
    labels: list[Label] | dict[str, list[Label]]
    """One list for all views, or one for each."""
    chosen_in_the_run: bool = False
    """True: the frames are listed in the journal, not in `labels`."""
    most_views: int | None = None
    """Greatest number of views, if they are chosen in the run. Then `views` lists the candidates."""
    hidden_leds: dict[str, list[int]] = Field(default_factory=dict)
    plan: _File
    rig: _File
    files: list[_File] = Field(default_factory=list)

    @model_validator(mode="after")
    def _labels_for_each_view(self) -> _Description:
        if isinstance(self.labels, dict) and (missing := [v for v in self.views if v not in self.labels]):
            raise ValueError(f"`labels` lacks the view {missing[0]!r}")
        return self


def read_description(folder: Path) -> dict[str, Any]:
    """Return the content of a run's run.json. Raises InputError if the folder is not a run, or if run.json is
    wrong."""
    path = folder / RUN_JSON
    try:
        content = read_json(path, allow_nan=True)
    except FileNotFoundError as error:
        raise InputError(f"{folder}: not a run folder: it has no {RUN_JSON}") from error
    except OSError as error:
        raise InputError(f"{path}: not a run folder: {reason(error)}") from error
    version = content.get("schema_version") if isinstance(content, dict) else None
    if version != SCHEMA_VERSION:
        raise InputError(f"{path}: expected run.json of schema version {SCHEMA_VERSION}, found {version!r:.40}")
    try:
        _Description.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the whole"
        raise InputError(f"{path}: `{where}`: {first['msg']}. Was it changed?") from error
    return dict(content)
