"""The page about drivers of others has its example whole, and the example runs."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
from places import REPO

import coupole
from coupole.errors import InputError

PAGE, EXAMPLE = REPO / "docs/how-to/test-your-driver.md", REPO / "docs/how-to/your_driver"
RIG = """
ledbox:
  driver: lumen_box:LumenBox
  settings: {host: 192.168.7.16, tcp_port: 4000}
"""


def test_the_page_has_the_files_of_the_example() -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    for name in ("conftest.py", "lumen_box.py", "test_lumen_box.py"):
        assert (EXAMPLE / name).read_text() in blocks, name
    assert RIG.strip() in PAGE.read_text()


def test_the_example_passes_as_whoever_copies_it_runs_it() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-W", "error", "-c", "/dev/null", "--rootdir", EXAMPLE]
    alone = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    ended = subprocess.run(
        [*command, "-p", "no:cacheprovider", EXAMPLE / "test_lumen_box.py"],
        env=alone,
        cwd=REPO,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout
    assert re.search(r"^35 passed", ended.stdout, re.MULTILINE), ended.stdout
    assert "runs 35 tests" in PAGE.read_text()


def test_a_rig_names_the_example_and_its_settings_are_checked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    shipped = coupole.Rig.read("la-coupole")
    assert shipped.world is None or shipped.world.serves == "dry_run"
    settings = {"host": "192.168.7.16", "tcp_port": 4000}
    plan = coupole.Plan.read("demo-short")

    def problems(settings: dict[str, object], driver: str = "lumen_box:LumenBox") -> str:
        ledbox = shipped.ledbox.model_copy(update={"driver": driver, "settings": settings})
        path = shipped.model_copy(update={"ledbox": ledbox}).write(tmp_path / "rig.yaml", overwrite=True)  # type: ignore[operator]
        try:
            plan.model_copy(update={"rig": path}).check()
        except InputError as error:
            return str(error)
        return ""

    assert "lumen_box" not in problems(settings)
    assert "tcp_port" not in problems(settings)
    assert "tcp_port" in problems({**settings, "tcp_port": 0})
    assert "cannot find `lumen_bocks:LumenBox`" in problems(settings, "lumen_bocks:LumenBox")
