"""A laboratory's own statements for the certificate of a cell (YAML)."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from coupole.plan import yamlfile
from coupole.plan.base_model import Model, Words

Range = tuple[float, float]


class Party(Model):
    """A laboratory or a customer."""

    name: Words
    address: Words


class Item(Model):
    """The cell that was calibrated."""

    name: Words
    identification: Words
    """Serial or inventory number."""
    condition: Words = "as found; no adjustment or repair"
    received: datetime.date | None = None
    """Date of receipt, if it matters for the results."""


class Person(Model):
    """Person who authorises the certificate."""

    name: Words
    function: Words


class Climate(Model):
    """Climate of the room. It is entered by hand, because no rig has a sensor for it."""

    temperature_c: Range
    """Lowest and highest temperature."""
    u_temperature_k: Annotated[float, Field(ge=0)]
    humidity_percent: Range | None = None
    u_humidity_percent: Annotated[float, Field(ge=0)] | None = None
    instrument: Words
    """Measuring instrument, with its certificate."""

    @model_validator(mode="after")
    def _rises(self) -> Climate:
        for values in (self.temperature_c, self.humidity_percent):
            if values is not None and values[0] > values[1]:
                raise ValueError(f"the lower value first, found {values[0]:g}, {values[1]:g}")
        return self


class Description(Model):
    """All statements of a laboratory."""

    schema_version: Literal[1] = 1
    number: Words
    """Unique identification of the certificate."""
    laboratory: Party
    place: Words
    """Place where the calibration was made."""
    customer: Party
    item: Item
    authorised_by: Person
    climate: Climate | None = None
    methods: tuple[Words, ...] = ()
    """Procedures of the laboratory in addition to Coupole's own."""
    deviations: tuple[Words, ...] = ()
    """Additions to, deviations or exclusions from the methods."""


def read_description(path: Path) -> Description:
    """Read a laboratory's statements. Raises InputError with all problems of the file."""
    return yamlfile.read_document(path).validate(Description)
