"""What is sent to whoever is asked for help has no secret in it, and no frame."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest
from cells import CellFolder

from coupole.console.people.accounts import Accounts, Role
from coupole.console.upkeep.support_bundle import LEFT_OUT, SupportBundles, without_secrets
from coupole.errors import InputError
from coupole.plan.cell import read_cell

SECRETS = (
    "correct horse battery",
    "argon2id",
    "kept-from-mail",
    "hook-abcdef0123",
    "s3cr3t-in-a-url",
    "bearer-0123456789",
    "horsefly",
    "wagonload",
)


def test_no_secret_and_no_frame_is_in_a_bundle(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.rig.write_text(
        cell.rig.read_text().replace(
            "\n", "\n# camera at http://root:s3cr3t-in-a-url@camera/\n# password: horsefly wagonload\n", 1
        )
    )
    console = tmp_path / "storage/state/console"
    run = tmp_path / "storage/20260101T000000Z-small"
    for folder in (console / "commands", console / "output", run / "views"):
        folder.mkdir(parents=True)
    Accounts(console / "accounts.json").add("Ada", "correct horse battery", Role.ENGINEER)
    (console / "notifications.yaml").write_text("email: {password: kept-from-mail}\nwebhooks: [hook-abcdef0123]\n")
    line = {
        "t": "2026-01-01T00:00:00Z",
        "name": "Ada",
        "asked": "POST /api/v1/token",
        "token": "bearer-0123456789",
    }
    (console / "audit.jsonl").write_text(json.dumps(line) + "\n")
    (console / "commands/1.log").write_text("Authorization: Bearer bearer-0123456789\nall is well\n")
    (run / "run.json").write_text('{"schema_version": 1}')
    (run / "journal.jsonl").write_text('{"event": "journal"}\n')
    (run / "views/top.h5").write_bytes(b"frames")
    bundles = SupportBundles(read_cell(cell.rig), tmp_path, console)
    path = bundles.path(bundles.make())
    with zipfile.ZipFile(path) as bundle:
        texts = {name: bundle.read(name).decode() for name in bundle.namelist()}
    for name, text in texts.items():
        assert [secret for secret in SECRETS if secret in text] == [], name
    assert json.loads(texts["console/audit.jsonl"]) == {**line, "token": LEFT_OUT}, "the rest of a line stays"
    assert "all is well" in texts["console/commands/1.log"]
    assert texts[f"runs/{run.name}/journal.jsonl"] == '{"event": "journal"}\n'
    assert json.loads(texts["versions.json"])["coupole"]
    assert {"rig/rig.yaml", "rig/coupole.csv", "plans/plan.yaml", "README.txt", "disk.json"} <= set(texts)
    assert not [name for name in texts if name.endswith(".h5") or "accounts" in name or "notifications" in name]


@pytest.mark.parametrize(
    "text", ["exposure_us: 8000\n", '{"shot": "top/led0417/e0", "xxh3": "00ff"}', "a token of trust"]
)
def test_what_is_no_secret_stays(text: str) -> None:
    assert without_secrets(text) == text


@pytest.mark.parametrize("name", ["../accounts.json", "accounts.json", "coupole-support-../x.zip", ""])
def test_nothing_else_is_served_as_a_bundle(tmp_path: Path, name: str) -> None:
    bundles = SupportBundles(read_cell(CellFolder(tmp_path).rig), tmp_path, tmp_path)
    (tmp_path / "accounts.json").write_text("{}")
    with pytest.raises(InputError):
        bundles.path(name)


@pytest.mark.parametrize(
    "text",
    [
        "password: LE,AK\nafter: 1\n",
        "token: LE'AK\nafter: 1\n",
        "  password: |\n    LE\n\n    AK\nafter: 1\n",
        "tokens: [LE, AK]\nafter: 1\n",
        "tokens:\n- LE\n- AK\nafter: 1\n",
        "mail:\n  - pwd: >\n      LE\n    after: 1\n",
        "private_key: LE\n  AK\nafter: 1\n",
        "# password: LE\n#   AK\nafter: 1\n",
        "mail: {user: me, password: LE,\n  token: AK}\nafter: 1\n",
        'password: "LE\n  AK"\nafter: 1\n',
        "to https://chat.example.org/hooks/LEAK\nafter: 1\n",
        "-----BEGIN PRIVATE KEY-----\nLE\nAK\n-----END PRIVATE KEY-----\nafter: 1\n",
        '{"mail": {"tokens": ["LE", "AK"]}, "after: 1": "password: LEAK"}\n',
    ],
)
def test_the_whole_of_a_secret_is_left_out(text: str) -> None:
    found = without_secrets(text)
    assert ("LE" in found, "AK" in found) == (False, False), found
    assert "after: 1" in found
    assert LEFT_OUT in found
