"""Messages that are sent to the console, and its answers, version 1."""

from __future__ import annotations

import unicodedata
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from coupole.console.plans.plan_queue import Entry


def _without_control_characters(text: str) -> str:
    """Refuse what would move a terminal's cursor or colour its text where it is printed."""
    if any(unicodedata.category(character) == "Cc" and character != "\n" for character in text):
        raise ValueError("expected text without control characters")
    return text


def _one_line(text: str) -> str:
    if "\n" in text:
        raise ValueError("expected one line")
    return text


Text = Annotated[str, Field(max_length=2000), AfterValidator(_without_control_characters)]
Line = Annotated[Text, AfterValidator(_one_line)]


MOST_LUX_H = 1e9
"""A hundred thousand years in a museum at 50 lux are half of it; more is a slip of the finger."""


class Asked(BaseModel):
    """Unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class SignIn(Asked):
    """A name and a password, or the token of the first start."""

    name: Text = ""
    """Name of an account."""
    password: Text = ""
    """Password of the account."""
    token: Text = ""
    """Printed at a start without an engineer's account; an engineer's, once, on the same machine."""
    script: bool = False
    """The session is returned in `session`, to be sent as a bearer, in place of a cookie."""


class NewEntry(Asked):
    """A plan, a run to be resumed, or a hold."""

    plan: Text = ""
    """File of the plan, relative to the folder of plans."""
    resume: Text = ""
    """Folder of the run to be resumed, relative to the cell's storage folder."""
    hold: Line = ""
    """Task to be done before the queue goes on."""
    before: Text = ""
    """Id of the waiting entry before which it comes; empty: at the end."""
    now: bool = False
    """Begin at once, with preflight only then; refused if something runs, waits or has the cell."""
    output: Text = ""
    """Folder for the run, if not the rig's; for the command line."""
    with_mesh: bool = False
    """Copy the mesh into the run even if it is large; for the command line."""
    reflectance: bool = False
    """Process the views beside the acquisition, and end with the result; a resumed run that was begun so does it
    anyway."""
    result: Text = ""
    """Folder of that result, if not the run's with `-reflectance` behind; for the command line."""


class Move(Asked):
    """A place in the queue."""

    before: Text = ""
    """Id of the waiting entry before which it comes; empty: at the end."""


class Lease(Asked):
    """Request for the loan of the cell."""

    what: Annotated[str, Field(min_length=1, max_length=200)]
    """Purpose of the loan, in words."""


class Light(Asked):
    """Light that an object was given elsewhere."""

    dose_lux_h: Annotated[float, Field(ge=0, le=MOST_LUX_H, allow_inf_nan=False, strict=True)]
    """Light dose in lux hours."""
    note: Annotated[str, Field(min_length=1, max_length=2000)]
    """Description of that light."""


class Budget(Asked):
    """Light that an object may receive in its life."""

    dose_lux_h: Annotated[float, Field(ge=0, le=MOST_LUX_H, allow_inf_nan=False, strict=True)]
    """Light dose in lux hours."""
    name: Annotated[str, Field(max_length=200)] = ""
    """Name of the person whose word it is; empty: whoever asks."""
    reason: Annotated[str, Field(max_length=2000)] = ""
    """Reason for this budget."""


class Warn(Asked):
    """Limit above which an object's ledger warns."""

    above_lux_h: Annotated[float, Field(ge=0, le=MOST_LUX_H, allow_inf_nan=False, strict=True)] | None
    """Total light above which the ledger warns, in lux hours; null: it never warns."""


class EntryNow(Entry):
    """An entry of the queue at this moment."""

    expected_begin: str | None = None
    """UTC; null if it has ended, if a person decides (a hold before it, a queue that is halted), or if it is not
    known."""
    expected_end: str | None = None
    """Likewise."""


class Output(BaseModel):
    """Output of an entry's process."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    entry: Entry
    """Entry of the queue, as it is."""
    said: str
    """The last 64 KiB of what it printed."""
    figures: dict[str, Any]
    """Figures, as of `coupole acquire --json`; empty until the process has ended."""


class NewAccount(Asked):
    """New account of a person."""

    name: Text
    """Name with which the person signs in."""
    password: Text
    """Password with at least ten characters."""
    role: Literal["observer", "operator", "engineer"]
    """Role: what the person may do."""


class Hand(Asked):
    """Control, given to who asked for it."""

    to: Text = ""
    """Who; empty: nobody."""


class StateNow(BaseModel):
    """The cell at this moment."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    state: Literal[
        "idle", "starting", "running", "pausing", "paused", "stopping", "concluding", "halted", "silent"
    ]
    """`halted`: the queue waits for a person; `starting`: a plan is checked, and devices are opened; `concluding`:
    devices are closed, the report is made; `silent`: the run's process does not answer, all else is what it told
    last."""
    t: str
    """Time when this was so, UTC."""
    rig: str
    """Name of the rig."""
    simulated: bool
    """No real light, no real arm."""
    run: str | None
    """Name of the run that is being acquired."""
    view: str | None
    """View that is being acquired."""
    proven: int
    """Frames of the run that are proven."""
    frames: int
    """Frames of the run."""
    dose: float
    """Light of the run on the object, in lux hours."""
    object: str
    """Id of the object of the run; empty if none is named."""
    dose_before: float
    """Light on the object before the run, in lux hours."""
    dose_budget: float | None
    """Light that the object may receive in its life, by its ledger and the run's plan."""
    left_s: float | None
    """Expected time until the run is complete."""
    halted: str
    """Reason why the queue waits for a person; empty if it does not."""
    arm_fault: str
    """The fault of the arm that stands until a person confirms; empty if there is none."""
    devices: dict[str, Any]
    """Identities of the devices that a run, or the bench, has open."""
    lent_to: str
    """Name of the borrower of the cell, and the purpose; empty if it is not lent. Nothing begins meanwhile."""
    queue: list[EntryNow]
    """All entries that run or wait, after the 20 that ended last, in their order."""
    checking: str
    """Preflight that is being made: of what, for whom, since when and how far it is; empty if none is. Other
    entries wait for it.
    """
    in_control: str
    """Name of the person who may act; empty: any operator."""
    asked_by: str
    """Name of the person who asks for control."""
    trouble: str
    """Trouble of the service itself, such as that it cannot write its log; empty if there is none."""
