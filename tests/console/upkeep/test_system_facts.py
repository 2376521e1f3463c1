"""What the console tells of the rig and of its own files."""

from __future__ import annotations

from pathlib import Path

import pytest
from places import REPO

from coupole.console.people.accounts import Accounts, Role
from coupole.console.upkeep.system_facts import log_lines, notifications, to_measure
from coupole.errors import InputError


def test_what_the_real_rig_says_must_be_measured_is_found_by_its_key() -> None:
    found = to_measure(REPO / "configs/rigs/la-coupole.yaml")
    assert [one.key for one in found] == ["flange_from_camera", "dome", "support", "board"]
    lines = (REPO / "configs/rigs/la-coupole.yaml").read_text().splitlines()
    assert all(lines[one.line - 1].strip() == f"# Measure: {one.why}" for one in found)


def test_the_log_comes_newest_first_and_without_torn_lines(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    path.write_text('{"t": "1"}\n{"t": "2"}\nnull\n{"t": "3')
    assert [line["t"] for line in log_lines(path)] == ["2", "1"]
    assert log_lines(tmp_path / "none") == []


def test_notifications_are_told_without_what_lets_somebody_in(tmp_path: Path) -> None:
    assert notifications(tmp_path) == {}
    (tmp_path / "notifications.yaml").write_text(
        "schema_version: 1\nevents: [fault]\n"
        "email: {server: s, user: u, password: hidden-1, sender: a@b, to: [ada@example.org]}\n"
        "webhooks: [{url: 'https://hooks.example.org/hidden-2', headers: {Authorization: hidden-3}}]\n"
    )
    told = notifications(tmp_path)
    assert told["by e-mail to"] == "ada@example.org"
    assert told["to addresses at"] == "hooks.example.org"
    assert "hidden" not in str(told)
    (tmp_path / "notifications.yaml").write_text("email: [unclosed")
    assert "cannot be read" in notifications(tmp_path)["trouble"]


def test_a_role_changes_but_one_engineer_stays(tmp_path: Path) -> None:
    accounts = Accounts(tmp_path / "accounts.json")
    accounts.add("Grace", "a long password", Role.ENGINEER)
    accounts.add("Ada", "a long password", Role.OPERATOR)
    with pytest.raises(InputError, match="last engineer"):
        accounts.change_role("Grace", Role.OPERATOR)
    with pytest.raises(InputError, match="no account"):
        accounts.change_role("Nobody", Role.OPERATOR)
    accounts.change_role("Ada", Role.ENGINEER)
    accounts.change_role("Grace", Role.OBSERVER)
    kept = Accounts(tmp_path / "accounts.json")
    assert {one.name: one.role for one in kept.all_accounts()} == {"Ada": Role.ENGINEER, "Grace": Role.OBSERVER}
    assert kept.sign_in("Ada", "a long password", here=True) is not None
