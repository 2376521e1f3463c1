"""Account of the sender of a request, for routes."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, Request

from coupole.console.people.accounts import Account
from coupole.console.people.guard import account_here, is_of_this_machine
from coupole.console.people.sessions import Session


def _account(request: Request) -> Account:
    """Return the account of the request's session."""
    session: Session = request.state.session
    return account_here(session.account, of_this_machine=is_of_this_machine(request))


Who = Annotated[Account, Depends(_account)]
REFUSALS: dict[int | str, dict[str, Any]] = {
    403: {"description": "This role may not do it, or the token is not fresh."},
    409: {"description": "Somebody else is in control, or the cell cannot do this now."},
}
