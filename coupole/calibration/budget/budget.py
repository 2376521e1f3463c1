"""The uncertainty budget of one reflectance: all inputs with their sources, propagated by two methods, and ranked.

The result comes from Monte Carlo (JCGM 101). The reason is that in a mesh of 200 um edges with vertices known to
30 um, the normal is uncertain by degrees, and 1 / cos is then far from linear. GUM's linear formula is the
cross-check. A test of section 8 of JCGM 101 shows whether it is sufficient. The importance of a source is given in
three ways. These are its share of the linear variance, the width of the interval without the source (the paper's
way), and the width of the interval from the source alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from coupole.calibration.budget.measurement import (
    LED_PLACE,
    LED_TURN,
    MESH_STEP,
    SEEN_OFF,
    VERTICES,
    reflectance_of,
)
from coupole.calibration.budget.propagation import (
    COVERAGES,
    Inputs,
    Linear,
    Model,
    Propagated,
    Quantity,
    Validation,
    ends,
    linear,
    monte_carlo,
    trials_of,
    validate,
)
from coupole.calibration.light.irradiance import Emission
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

STATED = {
    "vertices": "Lucat et al. 2025",
    "pixel value": "assumed",
    "LED position": "Lucat et al. 2025",
    "LED normal": "Lucat et al. 2025",
    "mesh to robot": "Lucat et al. 2025",
    "camera": "Lucat et al. 2025",
    "lens": "assumed",
    "flat field": "assumed",
    "response": "assumed",
    "glare": "assumed, not taken off",
    "LED power, own": "assumed",
    "LED power, common": "assumed",
    "drift": "assumed",
}
"""All sources of uncertainty, each with the origin of its size if there is no record."""


@dataclass(frozen=True)
class Known:
    """Standard uncertainties of all inputs, and the source of each. The defaults are the figures of Lucat et al.
    2025, or ours if it has none."""

    vertex_mm: float = 0.030
    """Bound of the error of each coordinate of each vertex. A manufacturer's accuracy is a bound, so its
    distribution is rectangular (GUM 4.3.7). If it were a standard uncertainty, normals would be uncertain by 12
    degrees."""
    edge_mm: float = 0.2
    led_mm: float = 0.7
    """Uncertainty of an LED's centre, all directions together."""
    led_deg: float = 0.21
    mesh_mm: float = 0.1
    """Uncertainty of the mesh's position relative to the robot, all directions together."""
    mesh_deg: float = 0.02
    robot_mm: float = 0.03
    """Uncertainty of the robot's common error. It shifts LEDs and mesh equally, so it correlates them."""
    camera_mm: float = 0.3
    """Uncertainty of the camera's ray where it meets the object: across the ray, both directions together."""
    lens_px: float = 0.3
    """Uncertainty of the image of a direction from the lens's calibration, both coordinates together."""
    pixel_mm: float = 0.047
    """Side of a pixel on the object."""
    contrast_per_mm: float = 0.02
    """Relative change of albedo along the surface."""
    flat_field: float = 0.003
    response: float = 0.002
    glare: float = 0.005
    """Uncertainty of the veil over the sample, as a share of a white target's signal. With a record it is the
    uncertainty of the remaining veil. Without a record it is the uncertainty of the whole veil that a good lens
    makes from a scene half as bright as white."""
    power_own: float = 0.003
    power_common: float = 0.01
    drift: float = 0.002
    read_noise_dn: float = 4.0
    gain_dn_per_e: float = 0.31
    full_scale_dn: float = 4031.0
    pixels: int = 5
    """Pixels of one channel that a triangle covers; their mean is used."""
    sources: tuple[tuple[str, str], ...] = ()
    """Each source of uncertainty, and the record of its figure."""

    def source(self, group: str) -> str:
        return dict(self.sources).get(group, STATED[group])

    def figure(self, group: str) -> str:
        """Return the figures that are used for a source, as text."""
        return {
            "vertices": f"{self.vertex_mm:.3g} mm, edges {self.edge_mm:.3g}",
            "pixel value": f"{self.read_noise_dn:.2g} DN, {self.pixels} pixels",
            "LED position": f"{self.led_mm:.2g} mm",
            "LED normal": f"{self.led_deg:.2g} deg",
            "mesh to robot": f"{self.mesh_mm:.2g} mm, {self.mesh_deg:.2g} deg",
            "camera": f"{self.camera_mm:.2g} mm",
            "lens": f"{self.lens_px:.2g} px",
            "flat field": f"{self.flat_field:.2%}",
            "response": f"{self.response:.2%}",
            "glare": f"{self.glare:.2%} of white",
            "LED power, own": f"{self.power_own:.2%}",
            "LED power, common": f"{self.power_common:.2%}",
            "drift": f"{self.drift:.2%}",
        }[group]


@dataclass(frozen=True)
class Geometry:
    """Geometry at which a sample is taken: base frame, mm."""

    incidence_deg: float
    """Angle between the surface's normal and the direction to the LED."""
    emission_deg: float = 10.0
    """Angle between the LED's normal and the direction to the sample."""
    distance_mm: float = 1000.0
    exposure_share: float = 0.6
    """Share of full scale that a white target facing the LED would reach."""
    reflectance: float = 0.5
    """Albedo of the sample."""


@dataclass(frozen=True)
class Share:
    """Contribution of one source."""

    source: str
    figure: str
    """Figures that are used for the source, as text."""
    said_by: str
    linear: float
    """Share of the linear variance."""
    width_decrease: float
    """Relative decrease of the width of the 68 % interval if the source is left out."""
    alone: float
    """Half the width of the 68 % interval of this source alone, relative to the value."""


@dataclass(frozen=True)
class Budget:
    """Uncertainty budget of one sample."""

    geometry: Geometry
    inputs: Inputs
    nominal: float
    """f at the inputs' values, 1/sr."""
    numeric: Propagated
    linear: Linear
    validations: tuple[Validation, ...]
    """Tests of the linear formula for one and two significant digits of u, for each coverage."""
    shares: tuple[Share, ...]

    def relative(self, coverage: float, kind: str = "symmetric") -> tuple[float, float]:
        """Return the ends of an interval relative to the value, such as (-0.11, +0.14)."""
        interval = self.numeric.interval(coverage, kind)
        return interval.low / self.nominal - 1.0, interval.high / self.nominal - 1.0


def sample_inputs(
    uncertainties: Known, geometry: Geometry, *, emission: Emission = "lambertian"
) -> tuple[Inputs, Floats]:
    """Return the quantities of one sample and the LED's normal [3]. Raises InputError for a light below the
    horizon."""
    if not 0.0 <= geometry.incidence_deg < 88.0:
        raise InputError(f"budget: expected an incidence from 0 to 88 deg, found {geometry.incidence_deg:g}")
    a, b = np.radians(geometry.incidence_deg), np.radians(geometry.emission_deg)
    led = geometry.distance_mm * np.array([np.sin(a), 0.0, np.cos(a)])
    towards = -led / geometry.distance_mm
    aside = np.array([0.0, 1.0, 0.0])
    led_normal = np.cos(b) * towards + np.sin(b) * aside
    # An equilateral triangle about the origin whose normal is z.
    around = np.radians([90.0, 210.0, 330.0])
    vertices = (
        uncertainties.edge_mm / np.sqrt(3.0) * np.stack([np.cos(around), np.sin(around), 0.0 * around], axis=1)
    )
    cosine = np.cos(a) * np.cos(b) ** (2 if emission == "paper" else 1)
    white = uncertainties.full_scale_dn * geometry.exposure_share * cosine
    signal = white * geometry.reflectance
    noise = np.sqrt(
        (uncertainties.read_noise_dn**2 + 1.0 / 12.0 + uncertainties.gain_dn_per_e * signal) / uncertainties.pixels
    )
    led_axis, mesh_axis = uncertainties.led_mm / np.sqrt(3.0), uncertainties.mesh_mm / np.sqrt(3.0)
    robot, lens_mm = (
        uncertainties.robot_mm / np.sqrt(3.0),
        uncertainties.lens_px / np.sqrt(2.0) * uncertainties.pixel_mm,
    )

    def quantity_of(name: str, value: float, u: float, group: str) -> Quantity:
        return Quantity(name, value, u, source=uncertainties.source(group), group=group)

    def vertex(name: str, value: float) -> Quantity:
        u, said_by = uncertainties.vertex_mm / np.sqrt(3.0), uncertainties.source("vertices")
        return Quantity(name, value, u, "rectangular", source=said_by, group="vertices")

    quantities = [
        *(vertex(n, float(v)) for n, v in zip(VERTICES, vertices.ravel(), strict=True)),
        *(quantity_of(n, float(v), led_axis, "LED position") for n, v in zip(LED_PLACE, led, strict=True)),
        *(quantity_of(n, 0.0, uncertainties.led_deg / np.sqrt(2.0), "LED normal") for n in LED_TURN),
        *(quantity_of(n, 0.0, mesh_axis, "mesh to robot") for n in MESH_STEP[:3]),
        *(quantity_of(n, 0.0, uncertainties.mesh_deg / np.sqrt(3.0), "mesh to robot") for n in MESH_STEP[3:]),
        quantity_of(SEEN_OFF[0], 0.0, lens_mm, "lens"),
        quantity_of(SEEN_OFF[1], 0.0, uncertainties.camera_mm / np.sqrt(2.0), "camera"),
        Quantity("contrast_per_mm", uncertainties.contrast_per_mm, 0.0, source="stated", group="camera"),
        quantity_of("signal_dn", signal, noise, "pixel value"),
        Quantity("exposure_s", 0.01, 0.0, source="camera's clock", group="pixel value"),
        Quantity("flat", 1.0, 0.0, source="at the field's middle", group="flat field"),
        quantity_of("flat_field", 1.0, uncertainties.flat_field, "flat field"),
        quantity_of("response", 1.0, uncertainties.response, "response"),
        quantity_of("veil_dn", 0.0, uncertainties.glare * white, "glare"),
        Quantity("power_dn_m2_sr_per_s", 1e4, 0.0, source="scale", group="LED power, common"),
        quantity_of("power.own", 1.0, uncertainties.power_own, "LED power, own"),
        quantity_of("power.common", 1.0, uncertainties.power_common, "LED power, common"),
        quantity_of("drift", 1.0, uncertainties.drift, "drift"),
    ]
    share = robot**2 / max(led_axis * mesh_axis, 1e-30)
    correlations = tuple((LED_PLACE[i], MESH_STEP[i], float(min(share, 0.99))) for i in range(3) if share > 0)
    return Inputs(tuple(quantities), correlations), led_normal


def budget_of(
    uncertainties: Known,
    geometry: Geometry,
    *,
    emission: Emission = "lambertian",
    coverages: Sequence[float] = COVERAGES,
    digits: int = 2,
    most_trials: int = 500_000,
    seed: int = 1,
) -> Budget:
    """Propagate one sample's uncertainty with all sources, without each source, and with each source alone."""
    inputs, led_normal = sample_inputs(uncertainties, geometry, emission=emission)
    model = partial(_model, led_normal=led_normal, emission=emission)
    numeric = monte_carlo(model, inputs, coverages=coverages, digits=digits, most_trials=most_trials, seed=seed)
    linearly = linear(model, inputs, coverages)
    return Budget(
        geometry,
        inputs,
        linearly.result.estimate,
        numeric,
        linearly,
        (*validate(linearly.result, numeric, digits=1), *validate(linearly.result, numeric, digits=2)),
        shares_of(model, inputs, linearly, uncertainties, seed=seed),
    )


def shares_of(
    model: Model, inputs: Inputs, linearly: Linear, uncertainties: Known, *, seed: int = 1, trials: int = 20_000
) -> tuple[Share, ...]:
    """Return the contribution of each group of inputs, the largest first. All propagations use the same random
    numbers, so that their differences have little noise."""
    groups = list(dict.fromkeys(q.source_group for q in inputs.quantities if q.u > 0.0))

    def half_width(fixed_groups: frozenset[str]) -> float:
        low, high = ends(trials_of(model, inputs, trials, seed, fixed_groups), 0.68)
        return 0.5 * (high - low)

    whole = half_width(frozenset())
    nominal = abs(linearly.result.estimate)
    shares = []
    for group in groups:
        members = [i for i, q in enumerate(inputs.quantities) if q.source_group == group]
        without = half_width(frozenset({group}))
        alone = half_width(frozenset(groups) - {group})
        share = float(linearly.shares[members].sum())
        shares.append(
            Share(
                group,
                uncertainties.figure(group),
                uncertainties.source(group),
                share,
                1.0 - without / whole,
                alone / nominal,
            )
        )
    return tuple(sorted(shares, key=lambda share: -share.alone))


@dataclass(frozen=True)
class Spread:
    """The distribution of relative 68 % intervals over many samples: the paper's table."""

    best: tuple[float, float]
    half: tuple[float, float]
    """Median of each end over all samples."""
    most: tuple[float, float]
    """Ends that 95 % of the samples do not exceed."""
    ends: Floats
    """[samples, 2] low and high ends, relative to the value."""


def spread_over(
    uncertainties: Known,
    geometries: Sequence[Geometry],
    *,
    coverage: float = 0.68,
    trials: int = 10_000,
    seed: int = 1,
) -> Spread:
    """Return relative intervals of many samples (Lucat et al. 2025, section 6.1)."""
    relative = []
    for number, geometry in enumerate(geometries):
        inputs, led_normal = sample_inputs(uncertainties, geometry)
        model = partial(_model, led_normal=led_normal, emission="lambertian")
        nominal = float(model({name: np.array([value]) for name, value in inputs.values().items()})[0])
        low, high = ends(trials_of(model, inputs, trials, seed + number), coverage)
        relative.append((low / nominal - 1.0, high / nominal - 1.0))
    table = np.array(relative)
    order = np.argsort(table[:, 1] - table[:, 0])
    return Spread(
        (float(table[order[0], 0]), float(table[order[0], 1])),
        (float(np.quantile(table[:, 0], 0.5)), float(np.quantile(table[:, 1], 0.5))),
        (float(np.quantile(table[:, 0], 0.05)), float(np.quantile(table[:, 1], 0.95))),
        table,
    )


def _model(q: Mapping[str, Floats], *, led_normal: Floats, emission: Emission) -> Floats:
    return reflectance_of(q, led_normal, emission=emission)
