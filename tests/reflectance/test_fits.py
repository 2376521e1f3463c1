"""The registry of fits: what is in it is made, completed and shown; what is not is refused, never guessed."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest import mock

import cells
import h5py
import numpy as np
import pytest
from places import REPO
from relight_cases import waves
from residual_cases import write_backscatter

from coupole.commands import completion
from coupole.pages.page_rendering import render
from coupole.reflectance import run_fits
from coupole.reflectance.fits import (
    FITS,
    GGX,
    MATERIALS,
    OF_TEXELS,
    RELIT,
    SLICES,
    MaterialFit,
    ViewFit,
    fitted_together,
)
from coupole.reflectance.ggx import UNKNOWNS
from coupole.reflectance.result_pages import ablation_page
from coupole.reflectance.run_fits import predict_samples
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.run_result_files import begin_slices
from coupole.reflectance.slice_basis import BASES, HARMONICS, fewer
from coupole.reflectance.slice_fit import fit_slices, slice_values
from coupole.reflectance.triangle_fit import FEWEST, model_values

LOW = ViewFit("low", "harmonics of few degrees", "#000000", "low")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return write_backscatter(tmp_path_factory.mktemp("fits") / "result", waves(6))


def test_a_fit_stands_under_its_own_name_and_no_colour_twice() -> None:
    assert [name for name, fit in FITS.items() if fit.name != name] == []
    assert len({fit.colour for fit in FITS.values()}) == len(FITS)
    assert [fit.name for fit in SLICES.values() if fit.over and fit.over not in MATERIALS.values()] == []


def test_each_fit_of_views_is_made_once_with_those_of_its_functions() -> None:
    groups = fitted_together()
    assert sorted(fit.name for group in groups for fit in group) == sorted(SLICES)
    assert [len({fit.basis.harmonic for fit in group}) for group in groups] == [1] * len(groups)


def test_a_new_fit_is_made_and_foretells_by_its_place_in_the_registry_alone(result: RunResult) -> None:
    (view,) = result.views
    samples, rows = result.view_samples(view, slice(None)), slice(None)
    used = np.ones(len(view.leds), np.bool_)
    with (
        mock.patch.dict(BASES, low=fewer(HARMONICS, 16)),
        mock.patch.dict(SLICES, {LOW.name: LOW}),
        mock.patch.dict(FITS, {LOW.name: LOW}),
    ):
        (found,) = fit_slices(samples, used, (LOW.basis, None))
        assert LOW in [fit for group in fitted_together() for fit in group]
        path = result.slices_path(LOW.name, view)
        path.parent.mkdir()
        with h5py.File(path, "w") as file:
            begin_slices(file, LOW, view, result.channels)[...] = found
        made = predict_samples(result, LOW.name, view, rows, samples)
        mae = {key: [[1.0, dict.fromkeys(FITS, 0.01)]] for key in ("LEDs", "coefficients")}
        page = render(ablation_page._page("x", {"triangles": 1, "mae": mae}))
        np.testing.assert_array_equal(made, slice_values(samples, found, LOW.basis))
    assert LOW.title in page


def test_a_material_of_another_form_is_asked_for_its_own_values(result: RunResult) -> None:
    class Twice(MaterialFit):
        def values(self, samples, materials):  # type: ignore[no-untyped-def]
            return 2.0 * model_values(samples, materials)

    (view,) = result.views
    samples = result.view_samples(view, slice(None))
    plain = predict_samples(result, "ggx_normal", view, slice(None), samples)
    with mock.patch.dict(FITS, {"ggx_normal": Twice("ggx_normal", "", "", fits_normals=True)}):
        twice = predict_samples(result, "ggx_normal", view, slice(None), samples)
    np.testing.assert_array_equal(twice, 2.0 * plain)


def test_a_material_of_another_form_states_its_own_uncertainty(result: RunResult) -> None:
    """GGX's covariances of a fit without a lobe would be numbers of 600 %."""
    stated = mock.sentinel.uncertainty

    class Lambert(MaterialFit):
        def uncertainty(self, *known):  # type: ignore[no-untyped-def]
            return stated

    block = slice(0, 4)
    job = run_fits._Job(result.folder, "a test", left_out=[], memory_bytes=1 << 20, noise_um=30.0)
    materials = run_fits._materials_block(job, GGX, 1, block)
    lambert = Lambert("lambert", "", "", fits_normals=False)
    assert run_fits._uncertain_block(job, lambert, 1, (block, materials)) == (materials, stated)


@pytest.mark.parametrize("name", MATERIALS)
def test_a_material_fit_says_what_it_does_not_know(result: RunResult, name: str) -> None:
    """Triangles without samples, and with too few of them: a result of runs has both."""
    fit, samples = MATERIALS[name], result.samples(slice(0, 12))
    values = samples.values.copy()
    values[0] = np.nan
    values[1, FEWEST - 1 :] = np.nan
    samples, used = replace(samples, values=values), np.ones(values.shape[1], np.bool_)
    materials = fit.fit(samples, used, 30.0, 1)
    uncertainty = fit.uncertainty(samples, used, materials, 30.0, samples.centres_mm.mean(axis=0), 1)
    known = np.isfinite(materials.alpha)
    assert not known[:2].any()
    assert known[2:].all()
    assert (materials.alpha[2:] > 0.0).all()
    assert uncertainty.covariance.shape == (12, UNKNOWNS, UNKNOWNS)
    for array in (
        materials.kd,
        materials.ks,
        uncertainty.covariance,
        uncertainty.u_kd,
        fit.values(samples, materials),
    ):
        assert np.isnan(array[:2]).all()
        assert np.isfinite(array[2:]).all()


def test_a_name_that_no_fit_has_is_no_ggx_fit(result: RunResult) -> None:
    (view,) = result.views
    with pytest.raises(KeyError, match="ggx_new"):
        predict_samples(result, "ggx_new", view, slice(None), result.view_samples(view, slice(None)))


def test_help_and_shell_know_all_fits(tmp_path: Path) -> None:
    told = cells.here("reflectance", "relight", "--help").out
    assert [name for name in RELIT if name not in told] == []
    assert [name for name, _ in completion.fits("")] == list(RELIT)
    assert completion.fits("ggx_r") == [("ggx_rbf", FITS["ggx_rbf"].title)]
    assert [name for name, _ in completion.materials("")] == [*MATERIALS, *OF_TEXELS]
    for command in ("export", "show"):
        told = cells.here(command, "--help").out
        assert [name for name in (*MATERIALS, *OF_TEXELS) if name not in told] == []
    assert GGX.name in MATERIALS


def test_the_table_of_fits_has_a_row_for_each_and_no_other() -> None:
    page = (REPO / "docs/reference/result-folder.md").read_text(encoding="utf-8")
    table = page.partition("### Fits of runs\n")[2].partition("\n#")[0]
    assert re.findall(r"^\| `(\w+)` ", table, re.MULTILINE) == list(FITS)


def test_the_command_line_knows_the_fits_without_their_kernels() -> None:
    """Help of one command is no reason to wait for numba."""
    imports = "coupole.commands.relight, coupole.commands.export_options, coupole.commands.show"
    lists = "print({'numpy', 'numba', 'h5py'} & set(sys.modules))"
    ended = subprocess.run(
        [sys.executable, "-c", f"import sys, {imports}; {lists}"], capture_output=True, text=True, check=False
    )
    assert ended.stdout == "set()\n", ended.stderr
