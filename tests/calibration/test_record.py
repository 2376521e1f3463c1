"""Records: what is written is read back, and what was changed or does not fit is refused."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coupole.calibration.in_force import InForce, Situation, read_in_force, refusals
from coupole.calibration.record import (
    Input,
    Limit,
    Parameter,
    Record,
    Validity,
    intrinsics_of,
    read_record,
    seal_record,
    write_record,
)
from coupole.errors import InputError

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
HERE = Situation(
    now=NOW + timedelta(days=10),
    is_simulated=False,
    size_px=(4096, 3072),
    focal_length_mm=35.0,
    focus_distance_mm=335.0,
    f_number=8.0,
    camera="CB120CG-CM 1234",
    temperature_c=22.0,
)


def record(kind: str = "camera", **changes: Any) -> Record:
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "k1")
    values = (7100.0, 7101.0, 2047.5, 1535.5, 0.03)
    u = np.array([0.7, 0.7, 0.4, 0.4, 1e-4])
    parameters = tuple(
        Parameter(name=n, value=v, u=float(s), degrees_of_freedom=4000.0, dominated_by="corners")
        for n, v, s in zip(names, values, u, strict=True)
    )
    content = {
        "kind": kind,
        "name": f"{kind}-1",
        "created": NOW,
        "software": "coupole 0.1.0",
        "simulated": False,
        "validity": Validity(
            expires=NOW + timedelta(days=180),
            camera="CB120CG-CM 1234",
            size_px=(4096, 3072),
            focal_length_mm=35.0,
            focus_distance_mm=335.0,
            f_number=8.0,
            temperature_c=(18.0, 26.0),
        ),
        "transforms": {},
        "parameters": parameters,
        "fixed": {"k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0},
        "covariance": tuple(tuple(map(float, row)) for row in np.diag(u**2)),
        "noise": (),
        "images": (),
        "limits": (Limit(what="noise of corners", found=0.1, limit=0.3, unit="px"),),
        "remarks": ("a remark: with a colon, \u00fcmlauts and 'quotes'",),
        "inputs": (Input(name="run/run.json", sha256="0" * 64),),
    }
    return seal_record(**(content | changes))


def named(*records: Record) -> list[InForce]:
    return [InForce(Path(f"{item.name}.yaml"), item) for item in records]


def test_a_record_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    made = record()
    write_record(tmp_path / "camera.yaml", made)
    assert read_record(tmp_path / "camera.yaml") == made


def test_the_lens_of_a_record_comes_with_its_free_parameters() -> None:
    lens, free = intrinsics_of(record())
    assert (lens.fx, lens.k1, lens.k3) == (7100.0, 0.03, 0.0)
    assert free == ("fx", "fy", "cx", "cy", "k1")


def test_a_record_that_was_edited_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    write_record(path, record())
    path.write_text(path.read_text().replace("7100.0", "7100.5"))
    with pytest.raises(InputError, match=r"camera\.yaml:\d+:\d+: sha256: the record was edited"):
        read_record(path)


def test_a_misspelt_key_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    write_record(path, record())
    path.write_text(path.read_text().replace("simulated:", "simulatd:"))
    with pytest.raises(InputError, match=r"camera\.yaml:7:1: simulatd: .*simulated"):
        read_record(path)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (np.eye(4), "expected 5 rows of 5 numbers"),
        (np.eye(5), "not the square of the parameters"),
        (np.diag([0.49, 0.49, 0.16, 0.16, 1e-8]) + np.eye(5, k=1) * 1e-3, "symmetric"),
        (np.diag([0.49, 0.49, 0.16, 0.16, 1e-8]) + 2 * (np.eye(5, k=2) + np.eye(5, k=-2)) * 0.4, "negative"),
    ],
)
def test_a_covariance_that_is_none_is_refused(tmp_path: Path, covariance: np.ndarray, message: str) -> None:
    path = tmp_path / "camera.yaml"
    write_record(path, record(covariance=tuple(tuple(map(float, row)) for row in covariance)))
    with pytest.raises(InputError, match=message):
        read_record(path)


def test_records_that_hold_here_are_in_force() -> None:
    assert refusals(named(record(), record("hand-eye")), HERE) == []


def test_a_kind_that_is_missing_or_named_twice_is_refused() -> None:
    assert refusals(named(record()), HERE) == ["calibrations: no record of the kind `hand-eye` is named"]
    twice = refusals(named(record(), record(), record("hand-eye")), HERE)
    assert twice == ["calibrations: 2 records of the kind `camera` are named"]


@pytest.mark.parametrize(
    ("here", "reason"),
    [
        ({"now": NOW + timedelta(days=181)}, "expired on 2026-08-28"),
        ({"now": NOW - timedelta(days=1)}, "in the future"),
        ({"focus_distance_mm": 420.0}, "is valid for a focus of 335 mm"),
        ({"f_number": 11.0}, "is valid for aperture 8; the rig has 11"),
        ({"focal_length_mm": 50.0}, "is valid for focal length 35 mm"),
        ({"size_px": (2048, 1536)}, "is valid for frames of 4096 x 3072"),
        ({"camera": "CB120CG-CM 99"}, "is valid for the camera CB120CG-CM 1234"),
        ({"temperature_c": 31.0}, "is valid from 18 to 26 C"),
        ({"is_simulated": True}, "made in a real cell"),
    ],
)
def test_a_record_that_does_not_hold_here_is_refused_with_the_reason(here: dict[str, Any], reason: str) -> None:
    found = refusals(named(record()), replace(HERE, **here), needed_kinds=("camera",))
    assert len(found) == 1
    assert reason in found[0]


def test_a_simulated_record_is_refused_in_a_real_cell() -> None:
    assert "simulated camera" in refusals(named(record(simulated=True)), HERE, needed_kinds=("camera",))[0]


def test_a_record_that_was_not_accepted_is_refused_with_the_limit() -> None:
    missed = record(limits=(Limit(what="noise of corners", found=0.5, limit=0.3, unit="px"),))
    assert "noise of corners is 0.5 px" in refusals(named(missed), HERE, needed_kinds=("camera",))[0]


def test_problems_of_all_records_come_at_once(tmp_path: Path) -> None:
    write_record(tmp_path / "good.yaml", record())
    (tmp_path / "bad.yaml").write_text("kind: camera\n")
    with pytest.raises(InputError) as raised:
        read_in_force([tmp_path / "good.yaml", tmp_path / "bad.yaml", tmp_path / "none.yaml"])
    assert "bad.yaml" in str(raised.value)
    assert "none.yaml: no such file" in str(raised.value)
