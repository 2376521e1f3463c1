"""Permission for a request, by the person's role and by the person in control."""

from __future__ import annotations

from coupole.console.people.accounts import Account, Role
from coupole.console.service_parts import Service


class NotAllowed(Exception):
    """Refusal of an action, with the HTTP status and the words for the sender."""

    def __init__(self, status: int, words: str) -> None:
        super().__init__(words)
        self.status = status


def allow(service: Service, account: Account, role: Role, action: str, *, acts: bool = False) -> None:
    """Raise NotAllowed if the person's role, or another person's control, forbids an action."""
    if account.role < role:
        raise NotAllowed(403, f"{action}: only for {role.word}s; {account.name} is {account.role.word}")
    of_command_line = account is service.command_line.account
    if acts and not service.control.act(account, keep=not of_command_line):
        takes = f"`coupole queue {service.cell.document.path} --take-control`"
        how = f"{takes} takes it" if of_command_line else "ask for it first"
        raise NotAllowed(409, f"{action}: {service.control.now.name} is in control; {how}")
