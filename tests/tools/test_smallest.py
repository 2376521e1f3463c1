"""Every bench and proof of `tools/`, each run to its end at its smallest size, which is one of seconds.

A tool that is in none of these tables makes a test red. What takes more than some 3 s of CPU is run at full scale.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest
from places import REPO, SHARED_DATA

sys.path.insert(0, str(REPO / "tools"))

from bench import BENCHES

TOOLS = REPO / "tools"
PIGMENTS = SHARED_DATA / "pigments"


@dataclass(frozen=True)
class Run:
    """One tool at its smallest size."""

    command: str
    """Name of the file and arguments; `{keep}` is a file that is not there yet."""
    prints: str
    """Pattern of its figures, or of one of them."""
    full: bool = False
    """It takes more than some 3 s of CPU."""
    needs: Path | None = None
    """Data beside the project, or another program's environment."""


BENCHED = {
    "check": True,
    "sequencing": True,
    "store": True,
    "live": True,
    "matching": False,
    "rsi": False,
    "collisions": True,
    "archive": False,
    "codecs": False,
    "render": True,
    "mesh": True,
    "calibration": True,
    "reflectance": True,
    "urushi": True,
    "workers": True,
    "console": True,
    "watching": True,
    "page": True,
}
"""Benches, and whether they are run at full scale only."""

RUNS = (
    Run("day.py --hours 0.02 --leds 12 --speed 20 --keep {keep}", r"0\.\d\d h of the rig's clock", full=True),
    Run("fail_every_call.py --cases 1 --jobs 1 --keep {keep}", r"1 cases, 0 wrong", full=True),
    Run(
        "freeze_at_random.py --freezes 1 --arm rsi --jobs 1 --keep {keep}",
        r"rsi .*(motion|burst) +\W +\d+ +\W +0 ",
        full=True,
    ),
    Run("full_proofs.py --list", r"python tools/prove_clusters\.py --triangles"),
    Run("mutants.py --check", r"\d+ mutants fit the code"),
    Run("prove_adaptive_lights.py --smallest", r"adaptive: \d\.\d\d of the spread LEDs' error", full=True),
    Run("prove_adaptive_views.py --smallest", r"worst: \d\.\d+ of the spread views' error", full=True),
    Run("prove_artefacts.py --smallest", r"wrong tile, 2%: found in 1 of 1", full=True),
    Run("prove_auto_exposure.py --smallest", r"duration: auto \d.* ratio \d", full=True),
    Run("prove_brackets.py --smallest", r"steps of 8: \d.* within 1\.96 u", full=True),
    Run("prove_calibrations.py --smallest", r"camera_mm.* median \d", full=True),
    Run("prove_chart_pictures.py --smallest", r"found from the patches: .* of 9 coefficients", full=True),
    Run("prove_clusters.py --smallest", r"1000 clusters for \d+ triangles: .*ratio \d", full=True),
    Run("prove_corners.py --smallest", r"\| sharp \| 0\.00\d\d ", full=True),
    Run("prove_exports.py --smallest", r"`bird` \| \d", full=True),
    Run(
        "prove_in_blender.py --smallest",
        r"\| gltf as imported \| \d\.\d\d \|",
        full=True,
        needs=REPO / ".tools/blender",
    ),
    Run("prove_finishes.py --smallest", r"peaks up to 60 degrees .*: off by up to \d", full=True),
    Run("prove_watching.py --smallest", r"\d of 8 faults found and named; \d false alarms in 2", full=True),
    Run(f"prove_identification.py {PIGMENTS} --smallest", r"\(its class|its class left out: \d", True, PIGMENTS),
    Run("prove_layers.py --smallest", r"photons, another ground: 95 % intervals hold \d", full=True),
    Run("prove_led_power.py --smallest", r"\| warming 0\.003 \| \d+\.\d%, \d\.\d\d, ", full=True),
    Run("prove_flat_field.py --smallest", r"\| slant 0\.01 \| \d+\.\d%, \d\.\d\d, "),
    Run("prove_led_positions.py --smallest", r"\| oval 0\.4 \| \d+\.\d%, \d\.\d\d, ", full=True),
    Run("prove_materials.py --smallest", r"diffuse, white \| (0\.99|1\.00)\d\d \|", full=True),
    Run("prove_paper_table.py --smallest", r"hold the truth: 68 %: \d", full=True),
    Run(f"prove_recipes.py {PIGMENTS / 'oilpaint/oilpaint.rs'} --smallest", r"within 2 %: \d", needs=PIGMENTS),
    Run("prove_reflectance.py --smallest", r"3 cells: ", full=True),
    Run("prove_registration.py --smallest", r"12 placed, 0 not", full=True),
    Run("prove_suggested_plans.py --smallest", r"relief +glossy.* = \d\.\d", full=True),
    Run("prove_texels.py --smallest", r"\| 1\.6 \| \d{4} \(\d{4}\) \| \d\.\d %, ", full=True),
    Run("replay_plans.py --smallest", r'"plans": 1, ', full=True),
    Run("soak.py --smallest --keep {keep}", r"mislabelled +0", full=True),
    Run("where_seconds_go.py tests/acquisition/test_attention.py", r"accounted for\n", full=True),
    Run("time_renderings.py --smallest", r"\| gilt-step-wedge-d65 \| 8 x 8 \| 11 \|", full=True),
)

TESTED_ELSEWHERE = {
    "bench.py": "tests/tools/test_smallest.py",
    "bench_console.py": "tests/tools/test_smallest.py",
    "check_sizes.py": "tests/tools/test_check_sizes.py",
    "check_words.py": "tests/tools/test_check_words.py",
    "draw_sentences.py": "tests/tools/test_draw_sentences.py",
    "in_blender.py": "tests/tools/test_smallest.py",
    "list_public_names.py": "tests/scripting/test_public_names.py",
    "make_architecture.py": "tests/docs/test_architecture.py",
    "make_dome.py": "tests/tools/test_make_assets.py",
    "make_kuka_files.py": "tests/tools/test_kuka_files.py",
    "make_plaque_scan.py": "tests/tools/test_make_plaque_scan.py",
    "make_relief.py": "tests/tools/test_make_assets.py",
    "make_site.py": "tests/docs/test_site.py",
}
"""Tools that another test runs, and that test; `bench_console.py` and `in_blender.py` are processes of another."""

MAKE_PICTURES = {
    "make_bust.py",
    "make_gallery.py",
    "make_pictures.py",
    "make_renderings.py",
    "make_statue_case.py",
}
"""They write what the docs show, in minutes, and measure nothing."""


def cases() -> list[object]:
    """Parameters of the runs."""
    return [
        pytest.param(run, id=run.command.partition(" ")[0], marks=[pytest.mark.full] if run.full else [])
        for run in RUNS
    ]


def ended(arguments: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], cwd=REPO, capture_output=True, text=True, timeout=280, check=False
    )


@pytest.mark.parametrize("run", cases())
def test_a_tool_ends_well_at_its_smallest_size_and_prints_its_figure(run: Run, tmp_path: Path) -> None:
    if run.needs is not None and not run.needs.is_dir():
        pytest.skip(f"{run.needs} is not there")
    name, *arguments = run.command.format(keep=tmp_path / "kept.jsonl").split()
    done = ended([str(TOOLS / name), *arguments])
    assert done.returncode == 0, done.stderr[-3000:]
    assert re.search(run.prints, done.stdout), done.stdout[-3000:]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.full] if full else []) for name, full in BENCHED.items()]
)
def test_a_bench_ends_well_at_its_smallest_size_and_prints_figures_with_peers(name: str) -> None:
    done = ended([str(TOOLS / "bench.py"), name, "--smallest"])
    if name == "codecs" and not (find_spec("imagecodecs") and find_spec("exifread")):
        assert done.returncode == 1
        assert "not installed; run it by `uv run --group bench`" in done.stderr
        return
    assert done.returncode == 0, done.stderr[-3000:]
    figures = [json.loads(line) for line in done.stdout.splitlines()]
    assert figures
    for figure in figures:
        assert figure["name"]
        assert figure["unit"]
        assert figure["peer"]
        assert math.isfinite(figure["value"])
        assert figure["value"] >= 0.0
        assert figure["ratio"] > 0.0


def test_every_bench_and_every_tool_that_can_be_run_is_in_one_of_these_tables() -> None:
    assert set(BENCHED) == set(BENCHES)
    runnable = [path.name for path in TOOLS.glob("*.py") if "\nif __name__ ==" in path.read_text()]
    listed = [*(run.command.partition(" ")[0] for run in RUNS), *TESTED_ELSEWHERE, *MAKE_PICTURES]
    assert sorted(runnable) == sorted(listed)


@pytest.mark.parametrize(("tool", "test"), TESTED_ELSEWHERE.items())
def test_what_is_said_to_be_tested_elsewhere_is(tool: str, test: str) -> None:
    assert Path(tool).stem in (REPO / test).read_text()


def test_every_module_that_cannot_be_run_is_used_by_another() -> None:
    texts = {path.stem: path.read_text() for path in TOOLS.glob("*.py")}
    texts["pyproject"] = (REPO / "pyproject.toml").read_text()  # names the contract of `import_contracts`
    for name in [name for name, text in texts.items() if name != "pyproject" and "\nif __name__ ==" not in text]:
        used = re.compile(rf"(?:from|import) {name}\b|\"allow_list: {name}\.|\"tools/{name}\.py\"")
        assert any(used.search(text) for other, text in texts.items() if other != name), f"{name}: nobody uses it"


def test_all_python_in_tools_is_in_files_that_types_are_checked_in() -> None:
    """`mypy` looks into files that end in `.py`."""
    for path in (path for path in TOOLS.iterdir() if path.is_file() and path.suffix != ".py"):
        assert "python" not in path.read_bytes().split(b"\n", 1)[0].decode(), (
            f"{path.name}: call it {path.name}.py"
        )
