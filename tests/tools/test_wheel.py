"""The wheel in an environment without a checkout: it has its simulated cell, and the demo runs from anywhere."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from places import REPO

from coupole.commands.extras import EXTRA_OF
from coupole.kernels.kept_code import kept_in

DEPENDENCIES = next(path for path in map(Path, sys.path) if path.name == "site-packages")
MOST_BYTES, MOST_INSTALLED_BYTES = 15_000_000, 700_000_000
LACKING = sorted(library for library in EXTRA_OF if EXTRA_OF[library] not in ("testing", "xarray"))
WITHOUT_EXTRAS = f"""
import importlib.abc, sys

class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {LACKING}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
"""
"""As if of the extras `testing` and `xarray` alone were installed, though the dependencies lie beside."""


@dataclass(frozen=True)
class Installed:
    """A virtual environment with the wheel, and a working folder with a space and an umlaut."""

    wheel: Path
    environment: Path
    folder: Path

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        home = self.folder / "home"
        home.mkdir(exist_ok=True)
        surroundings = {"HOME": str(home), "PATH": "/usr/bin:/bin", "LANG": "C.UTF-8"}
        surroundings["NUMBA_CACHE_DIR"] = str(kept_in())  # the installed modules are the checkout's byte for byte
        surroundings["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # those beside the shared dependencies
        command = [self.environment / "bin" / words[0], *words[1:]]
        return subprocess.run(
            command, cwd=self.folder, env=surroundings, capture_output=True, text=True, check=False
        )


def uv() -> str:
    """The uv that set up this checkout."""
    own = REPO / ".tools/uv-venv/bin/uv"
    return (
        str(own) if own.exists() else shutil.which("uv") or pytest.skip("there is no uv to build the wheel with")
    )


@pytest.fixture(
    scope="module",
    params=["dependencies shared", pytest.param("dependencies installed", marks=pytest.mark.full)],
)
def installed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    folder = tmp_path_factory.mktemp("ein Prüfstand")
    environment = folder / "venv"

    def call(*words: str | Path) -> None:
        subprocess.run([uv(), *map(str, words)], cwd=REPO, check=True, capture_output=True)

    call("build", "--wheel", "--out-dir", folder / "dist", REPO)
    call("venv", "--python", sys.executable, environment)
    (wheel,) = (folder / "dist").glob("*.whl")
    shared = request.param == "dependencies shared"
    call(
        "pip",
        "install",
        "--python",
        environment,
        *(["--no-deps", wheel] if shared else [f"{wheel}[testing,xarray]"]),
    )
    (site_packages,) = environment.glob("lib/python*/site-packages")
    if shared:
        (site_packages / "dependencies.pth").write_text(f"{DEPENDENCIES}\n")
        (site_packages / "sitecustomize.py").write_text(WITHOUT_EXTRAS)
    (folder / "Kuppel ä").mkdir()
    return Installed(wheel, environment, folder / "Kuppel ä")


def test_the_demo_ends_with_a_page(installed: Installed) -> None:
    """Whatever lies here under its plan's name: that could be the plan of a real cell, and nobody is asked."""
    (installed.folder / "demo-short").write_text("name: another plan")
    ended = installed.run("coupole", "demo", "coupole-demo", "--short", "--json")
    (installed.folder / "demo-short").unlink()
    assert ended.returncode == 0, ended.stderr
    document = json.loads(ended.stdout)
    page, run = Path(document["page"]), Path(document["run"])
    assert page == installed.folder / "coupole-demo/page.html"
    assert "<canvas" in page.read_text(encoding="utf-8")
    assert run.parent == installed.folder / "coupole-demo/runs"
    assert str(REPO) not in (run / "run.json").read_text()


def test_a_demo_that_was_made_is_not_made_again_and_no_other_folder_is_touched(installed: Installed) -> None:
    first = installed.run("coupole", "demo", "coupole-demo", "--short", "--json")
    assert first.returncode == 0, first.stderr
    assert len(list((installed.folder / "coupole-demo/runs").iterdir())) == 1
    whole = installed.run("coupole", "demo", "coupole-demo", "--json")
    assert (whole.returncode, "holds another run" in json.loads(whole.stdout)["error"]) == (2, True)
    other = installed.folder / "Briefe"
    other.mkdir()
    (other / "brief.txt").write_text("von Hand")
    refused = installed.run("coupole", "demo", "Briefe", "--json")
    assert refused.returncode == 2
    assert "is not empty (brief.txt)" in json.loads(refused.stdout)["error"]


def test_the_examples_of_the_python_page_run(installed: Installed) -> None:
    shutil.copy(REPO / "docs/how-to/from_python.py", installed.folder)
    made = installed.run("coupole", "demo", "coupole-demo", "--short", "--json")
    assert made.returncode == 0, made.stderr
    ended = installed.run("python", "-W", "error", "from_python.py")
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines()[-2].endswith("6 of 6")


@pytest.mark.full
def test_mypy_is_content_with_a_users_file(installed: Installed) -> None:
    script = installed.folder / "from_python.py"
    shutil.copy(REPO / "docs/how-to/from_python.py", script)
    python = str(installed.environment / "bin/python")
    ended = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--python-executable", python, script],
        cwd=installed.folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout


def test_the_driver_of_another_passes_the_class_of_the_wheel(installed: Installed) -> None:
    example = REPO / "docs/how-to/your_driver"
    shutil.copytree(example, installed.folder / "mein Treiber", ignore=shutil.ignore_patterns("__pycache__"))
    few_tests = ["-k", "flash and not mute"]
    ended = installed.run("python", "-m", "pytest", "-q", "-W", "error", *few_tests, "mein Treiber")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert " passed" in ended.stdout


def test_a_new_plan_names_the_shipped_cell_and_can_be_run(installed: Installed) -> None:
    assert installed.run("coupole", "plan", "new", "meiner").returncode == 0
    assert "rig: sim\n" in (installed.folder / "meiner.yaml").read_text()
    ended = installed.run("coupole", "check", "meiner.yaml", "--no-paths", "--json")
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["ok"]


def test_runs_of_a_shipped_cell_go_to_the_working_folder(installed: Installed) -> None:
    program = "import pathlib, coupole.plan.cell as c; print(c.read_cell(pathlib.Path('sim')).storage_folder)"
    ended = installed.run("python", "-c", program)
    assert Path(ended.stdout.strip()) == installed.folder / "runs", ended.stderr


def test_the_wheel_is_small(installed: Installed) -> None:
    assert installed.wheel.stat().st_size < MOST_BYTES


def test_what_a_command_lacks_is_named_with_its_extra(installed: Installed) -> None:
    ended = installed.run("coupole", "view", "demo-short", "--out", "plan.png", "--json")
    assert ended.returncode == 2, ended.stdout
    assert "pip install 'coupole[pictures]'" in json.loads(ended.stdout)["error"]
    assert "pip install 'coupole[pictures]'" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.full
def test_the_base_is_light(tmp_path: Path) -> None:
    environment = tmp_path / "venv"
    for words in (
        ("build", "--wheel", "--out-dir", str(tmp_path), str(REPO)),
        ("venv", "--python", sys.executable, str(environment)),
    ):
        subprocess.run([uv(), *words], cwd=REPO, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    subprocess.run([uv(), "pip", "install", "--python", environment, wheel], check=True, capture_output=True)
    size_bytes = sum(path.stat().st_size for path in environment.rglob("*") if path.is_file())
    assert size_bytes < MOST_INSTALLED_BYTES
