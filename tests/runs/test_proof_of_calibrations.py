"""Random simulated cells, rendered, calibrated and held against the truth; the tool does it a hundredfold."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest

COMMAND = (sys.executable, str(cells.REPO / "tools/prove_calibrations.py"), "--json")


@pytest.fixture(scope="module")
def proof(tmp_path_factory: pytest.TempPathFactory, scale: Callable[[int, int], int]) -> list[dict[str, Any]]:
    """Lines of the tool: small frames, few pictures and boards of LEDs."""
    kept = tmp_path_factory.mktemp("proof") / "cells.jsonl"
    settings = {
        "cells": scale(1, 100),
        "width": scale(512, 1024),
        "images": scale(8, 16),
        "samples": scale(2, 3),
        "led-boards": scale(6, 24),
    }
    options = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    ended = subprocess.run([*COMMAND, *options, "--keep", str(kept)], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return [json.loads(line) for line in ended.stdout.splitlines()]


@pytest.mark.full
@pytest.mark.timeout(9000)  # 100 cells with --full
def test_stated_intervals_hold_the_truth(proof: list[dict[str, Any]], scale: Callable[[int, int], int]) -> None:
    """A hundred cells tell whether 95 % hold; one tells an interval that is wrong altogether."""
    judged = [line for line in proof if "covered" in line]
    assert {line["name"].split(".")[0] for line in judged} == {
        "camera",
        "flange_from_camera",
        "base_from_board",
        "leds",
        "base_from_mesh",
    }
    values = sum(line["values"] for line in judged)
    covered = sum(line["covered"] * line["values"] for line in judged) / values
    mean_square = sum(line["rms_over_u"] ** 2 * line["values"] for line in judged) / values
    assert scale(80, 90) <= 100 * covered <= scale(100, 99)
    assert scale(70, 80) < 100 * mean_square**0.5 < scale(150, 125)
    for line in judged:
        assert line["rms_over_u"] < scale(4, 2), line


@pytest.mark.full
@pytest.mark.timeout(18000)  # 40 cells with --full
def test_a_bent_board_is_in_the_intervals(scale: Callable[[int, int], int]) -> None:
    """Two cells of small frames tell an interval that is wrong altogether; forty whether 95 % hold."""
    settings = {
        "cells": scale(2, 40),
        "width": scale(448, 640),
        "images": scale(12, 24),
        "samples": scale(2, 6),
    }
    options = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    command = [*COMMAND, "--stranger", "bend", *options]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    lines = [json.loads(line) for line in ended.stdout.splitlines()]
    assert not any("refused" in line for line in lines)
    assert {line["name"].split(".")[0] for line in lines} == {"camera", "hand-eye", "flange_from_camera"}
    for line in lines:
        assert line["rms_over_u"] < scale(4, 2), line


@pytest.mark.full
def test_camera_leds_and_mesh_are_near_the_truth(proof: list[dict[str, Any]]) -> None:
    """An eighth of the real camera's resolution allows for twice the distances that the real one must meet."""
    far = {line["name"]: line["median"] for line in proof if "median" in line}
    assert far["camera_mm"] < 0.1
    assert far["led_mm"] < 0.24
    assert far["led_normal_deg"] < 0.2
    assert far["mesh_mm"] < 0.12


def judge(folder: Path, errors: list[float], *options: str) -> subprocess.CompletedProcess[str]:
    """The tool on cells that were done before: one parameter with u 0.1."""
    settings = {"width": 1024, "images": 20, "samples": 8, "led_boards": None, "absolute": False, "stranger": None}
    kept = folder / "cells.jsonl"
    with kept.open("w") as file:
        for seed, error in enumerate(errors, start=1):
            judged = [{"name": "camera.fx_px", "error": error, "u": 0.1, "half_width": 0.196}]
            cell = {"seed": seed, "settings": settings, "judged": judged, "accuracy": {"camera_mm": 0.03}}
            file.write(json.dumps(cell) + "\n")
    command = [*COMMAND, "--cells", str(len(errors)), "--keep", str(kept), *options]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_cells_that_were_kept_are_not_done_again(tmp_path: Path) -> None:
    ended = judge(tmp_path, [0.1])
    assert ended.returncode == 0
    first, second = map(json.loads, ended.stdout.splitlines())
    assert (first["name"], first["covered"], first["rms_over_u"]) == ("camera.fx_px", 1.0, 1.0)
    assert second == {"name": "camera_mm", "median": 0.03, "percent_95": 0.03}


@pytest.mark.full
def test_intervals_that_are_not_true_are_a_failure(tmp_path: Path) -> None:
    normal = np.random.default_rng(1).normal(0.0, 0.1, 100)
    assert judge(tmp_path, normal.tolist()).returncode == 0
    for factor, why in ((2.5, "of the intervals hold the truth"), (0.5, "rms(error/u) is 0.4")):
        ended = judge(tmp_path, (factor * normal).tolist())
        assert ended.returncode == 1
        assert why in ended.stderr


@pytest.mark.full
def test_cells_of_other_settings_are_not_taken_for_these(tmp_path: Path) -> None:
    ended = judge(tmp_path, [0.1], "--absolute")
    assert ended.returncode == 1
    assert "name another file" in ended.stderr
