"""Profiles from drawn pictures of charts, beside the truth that they were drawn from."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from drawn_charts import (
    COLUMNS,
    GREYS,
    ROWS,
    Array,
    DrawnChart,
    colour,
    d50_lab,
    d50_xyz,
    greys,
    random_reflectances,
    write_picture,
)

from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.colour.chart import read_chart
from coupole.calibration.colour.colour_profile import covariance_of
from coupole.calibration.colour.colour_workflow import make_profiles
from coupole.calibration.colour.picture_workflow import see_in_pictures
from coupole.exchange.chart_photographs import read_chart_photograph

_NEW_COLOURS = 60


@dataclass(frozen=True)
class Judged:
    """One profile beside its truth."""

    errors: Array
    """[9] of the matrix's coefficients, over their standard uncertainty."""
    factor: float
    """Coverage factor of 95 % that the record's page uses."""
    within_bound: float
    """Share of colours that the chart does not have, but like its own, whose CIEDE2000 is within the bound."""
    bound_de00: float


def judge(drawn: DrawnChart, *, with_white: bool) -> Judged:
    """The profile of one picture of the chart, with a picture of a white card or without it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        picture = read_chart_photograph(write_picture(folder / "chart.tif", drawn.picture()))
        white = None
        if with_white:
            white = read_chart_photograph(write_picture(folder / "white.tif", drawn.picture(white=True)))
        known_chart = read_chart(drawn.write_chart(folder))
    found = see_in_pictures([picture], known_chart, None, white, _silent)
    forms, signals = make_profiles(found.sighting, found.known_chart, _silent)
    matrix = forms.profiles["matrix"]
    u = np.sqrt(np.diag(sum(covariance_of(signals, matrix)))).reshape(3, 3)
    errors = (matrix.coefficients - drawn.true_matrix()) / u
    random = np.random.default_rng((drawn.seed, 11))
    grey_count = round(_NEW_COLOURS * len(GREYS) / (ROWS * COLUMNS))
    values = np.exp(random.uniform(np.log(GREYS[-1]), np.log(GREYS[0]), grey_count))
    spectra = np.concatenate([random_reflectances(random, _NEW_COLOURS - grey_count), greys(random, values)])
    lab = d50_lab(forms.chosen_profile.xyz_of_balanced(drawn.signals(spectra) / drawn.true_white()))
    de = colour.delta_E(d50_lab(d50_xyz(spectra)), lab, method="CIE 2000")
    bound, _ = forms.left_out_errors.bound(0.95)
    factor = coverage_factor(3 * len(signals.signal) - 6)
    return Judged(errors.ravel(), factor, float(np.mean(de <= bound)), bound)


def _silent(done: int, total: int) -> None:
    """Tell nobody of progress."""
