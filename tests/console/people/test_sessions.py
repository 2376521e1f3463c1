"""A session is somebody's only as long as the account with which it began."""

from __future__ import annotations

from pathlib import Path

import pytest

from coupole.console.people.accounts import FIRST_ENGINEER, Account, Accounts, Role
from coupole.console.people.sessions import Sessions
from coupole.errors import InputError

PASSWORD = "a long password"


def test_who_signs_in_while_the_account_is_removed_is_not_let_in_nor_later_as_its_namesake(
    tmp_path: Path,
) -> None:
    accounts = Accounts(tmp_path / "accounts.json")
    sessions = Sessions(holds=accounts.holds)
    accounts.add("Tom", PASSWORD, Role.OPERATOR)
    known = _signed_in(accounts, "Tom")
    earlier = sessions.begin(known, script=False)
    assert sessions.of(earlier, script=False) is not None
    accounts.remove("Tom")
    late = sessions.begin(known, script=False)
    assert sessions.of(late, script=False, counts_as_use=False) is None
    accounts.add("Tom", PASSWORD, Role.OPERATOR)
    assert sessions.of(earlier, script=False) is None, "another Tom"
    now = sessions.begin(_signed_in(accounts, "Tom"), script=False)
    accounts.change_role("Tom", Role.OBSERVER)
    assert sessions.of(now, script=False) is None
    assert _signed_in(Accounts(tmp_path / "accounts.json"), "Tom").role is Role.OBSERVER


def test_the_first_engineer_is_one_until_another_has_an_account(tmp_path: Path) -> None:
    accounts = Accounts(tmp_path / "accounts.json")
    sessions = Sessions(holds=accounts.holds)
    first = accounts.sign_in_first(accounts.first_token)
    assert first == FIRST_ENGINEER
    secret = sessions.begin(first, script=True)
    with pytest.raises(InputError, match="the token"):
        accounts.add(first.name, PASSWORD, Role.ENGINEER)
    accounts.add("Ada", PASSWORD, Role.OPERATOR)
    assert sessions.of(secret, script=True) is not None
    accounts.add("Ida", PASSWORD, Role.ENGINEER)
    assert sessions.of(secret, script=True) is None


def _signed_in(accounts: Accounts, name: str) -> Account:
    found = accounts.sign_in(name, PASSWORD, here=True)
    assert found is not None
    return found
