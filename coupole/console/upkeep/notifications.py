"""Messages to people who are not at the console: by e-mail, webhook or desktop; and the file that names the
receivers.

The file is `notifications.yaml` in the console's state folder. Only its owner may read it, because it may contain
a password::

    schema_version: 1
    events: [plan-ended, fault, hold, arm-fault, disk-low]      # without it: all
    disk_low_gb: 50
    email: {server: smtp.example.org, user: dome, password: ..., sender: dome@example.org, to: [ada@example.org]}
    webhooks: [{url: "https://example.org/hook", headers: {Authorization: "Bearer ..."}}]
    desktop: true
"""

from __future__ import annotations

import json
import shutil
import smtplib
import ssl
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from email.message import EmailMessage
from email.utils import formatdate, make_msgid
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, get_args
from urllib.error import URLError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from pydantic import Field, model_validator

from coupole.errors import InputError
from coupole.plan.base_model import Model
from coupole.plan.cell import Cell
from coupole.plan.yamlfile import read_document
from coupole.storage.line_file import utc_now

Kind = Literal["plan-ended", "fault", "hold", "arm-fault", "disk-low"]
NAME = "notifications.yaml"
_PATIENCE_S = 20.0
_HERE = ("localhost", "127.0.0.1", "::1")
_PORTS = {"starttls": 587, "tls": 465, "none": 25}
Word = Annotated[str, Field(min_length=1, max_length=500, pattern=r"^[^\r\n]+$")]


class Email(Model):
    """A mail server, and the receivers of mail."""

    server: Word
    """Name of the server."""
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Port of the server; by default 587, 465 or 25, depending on `security`."""
    security: Literal["starttls", "tls", "none"] = "starttls"
    """Protection of the connection; the server's certificate is checked."""
    user: str = ""
    """Name of the account at the server; empty if the server needs none."""
    password: str = ""
    """Password of that account."""
    sender: Word
    """Address of the sender."""
    to: Annotated[tuple[Word, ...], Field(min_length=1)]
    """Addresses of the receivers."""

    @model_validator(mode="after")
    def _no_open_password(self) -> Email:
        if self.password and self.security == "none" and self.server not in _HERE:
            raise ValueError(
                "expected `security: starttls` or `tls`: the password would be sent without encryption"
            )
        return self


class Webhook(Model):
    """An address that receives each message as JSON, by POST: `cell`, `event`, `subject`, `text`, `t`."""

    url: Annotated[str, Field(pattern=r"^https?://[^\s/]+")]
    """The address."""
    headers: dict[str, Word] = Field(default_factory=dict)
    """Headers sent with it, such as an authorization."""


class Settings(Model):
    """Receivers and kinds of messages."""

    schema_version: Literal[1]
    """Version of this format."""
    events: tuple[Kind, ...] = get_args(Kind)
    """Kinds of events that people are notified of."""
    disk_low_gb: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 20.0
    """Free space on the disk of the runs, in GB, below which people are notified."""
    email: Email | None = None
    """Messages by e-mail."""
    webhooks: tuple[Webhook, ...] = ()
    """Messages by HTTP."""
    desktop: bool = False
    """Messages by the desktop's notifications (`notify-send`) of this machine's user."""


@dataclass(frozen=True)
class Message:
    """Something that happened at a cell."""

    cell: str
    event: Kind | Literal["test"]
    subject: str
    text: str
    t: str

    @staticmethod
    def now(cell: str, event: Kind | Literal["test"], subject: str, text: str) -> Message:
        return Message(cell, event, f"{cell}: {subject}", text, utc_now())


def console_folder(cell: Cell) -> Path:
    """Return the folder where a cell's console stores its state."""
    return cell.state_folder / "console"


def read_settings(folder: Path) -> Settings | None:
    """Read the settings of `folder`; None if there is no file. Raises InputError if the file is wrong, or if
    others may read it."""
    path = folder / NAME
    if not path.is_file():
        return None
    if path.stat().st_mode & 0o077:
        raise InputError(f"{path}: expected a file that only its owner may read: chmod 600 {path}")
    return read_document(path).validate(Settings)


def ways(settings: Settings) -> Mapping[str, Callable[[Message], None]]:
    """Return functions that send a message, by name. Each raises OSError or ValueError, with the other side's
    words, if the message was not sent."""
    senders: dict[str, Callable[[Message], None]] = {}
    if settings.email is not None:
        senders[f"e-mail by {settings.email.server}"] = partial(_mail, settings.email)
    for number, hook in enumerate(settings.webhooks, 1):
        senders[f"webhook {number} at {urlsplit(hook.url).hostname}"] = partial(_post, hook)
    if settings.desktop:
        senders["desktop"] = _show
    return senders


def _mail(to: Email, message: Message) -> None:
    mail = EmailMessage()
    mail["Subject"] = " ".join(message.subject.split())
    mail["From"], mail["To"] = to.sender, ", ".join(to.to)
    mail["Date"], mail["Message-ID"] = formatdate(), make_msgid(domain=to.sender.rpartition("@")[2])
    mail.set_content(f"{message.text}\n\n{message.t}, {message.event}\n")
    port, context = to.port or _PORTS[to.security], ssl.create_default_context()
    with (
        smtplib.SMTP_SSL(to.server, port, timeout=_PATIENCE_S, context=context)
        if to.security == "tls"
        else smtplib.SMTP(to.server, port, timeout=_PATIENCE_S)
    ) as server:
        if to.security == "starttls":
            server.starttls(context=context)
        if to.user:
            server.login(to.user, to.password)
        if refused_addresses := server.send_message(mail):
            raise OSError(f"not accepted for {', '.join(refused_addresses)}")


class _NoRedirect(HTTPRedirectHandler):
    """A redirected POST would become a GET, and send the headers to another place."""

    def redirect_request(self, *_: object) -> None:
        return None


def _post(hook: Webhook, message: Message) -> None:
    request = Request(
        hook.url,
        json.dumps(vars(message)).encode(),
        {**hook.headers, "Content-Type": "application/json", "User-Agent": "coupole"},
    )
    try:
        with build_opener(_NoRedirect).open(request, timeout=_PATIENCE_S):
            pass
    except URLError as error:
        raise OSError(str(error)) from error


def _show(message: Message) -> None:
    program = shutil.which("notify-send")
    if program is None:
        raise OSError("this machine has no notify-send")
    urgency = "normal" if message.event in ("plan-ended", "test") else "critical"
    try:
        subprocess.run(
            [program, f"--urgency={urgency}", "--app-name=Coupole", "--", message.subject, message.text],
            check=True, capture_output=True, timeout=_PATIENCE_S,
        )  # fmt: skip
    except subprocess.SubprocessError as error:
        raise OSError(f"notify-send: {error}") from error
