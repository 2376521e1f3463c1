# %% [markdown]
# # A pigment from a spectrum
#
# This notebook asks which class of pigments a reflectance spectrum shows. The answer may also be
# that the library has no such class.
#
# Coupole comes with no library of spectra, because the rights to those that exist lie with their
# collections. So the library here is *drawn*: four curves through a few points, and six batches of
# each with other concentrations. It shows the procedure. For your objects, measure your own library
# ([how-to](../how-to/identify-a-pigment.md)).

# %%
import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import coupole

# %%
NM = np.arange(380, 781, 10)
POINTS = {
    "blue": ([380, 460, 520, 600, 780], [0.15, 0.40, 0.15, 0.06, 0.10]),
    "green": ([380, 450, 525, 600, 780], [0.06, 0.12, 0.35, 0.12, 0.08]),
    "red": ([380, 570, 590, 620, 780], [0.04, 0.05, 0.15, 0.65, 0.80]),
    "yellow": ([380, 460, 520, 560, 780], [0.05, 0.06, 0.35, 0.60, 0.70]),
}

# %% [markdown]
# ## Batches
#
# An opaque layer of a pigment with absorption K and scattering S reflects R = 1 + K/S -
# sqrt((K/S)^2 + 2 K/S) (Kubelka and Munk). A batch has more or less of the pigment: its K/S is
# scaled.


# %%
def batch(name: str, strength: float, *, seed: int = 0) -> np.ndarray:
    """[41] reflectance of an opaque layer, with the noise of an instrument."""
    curve = np.interp(NM, *POINTS[name])
    k_over_s = strength * (1 - curve) ** 2 / (2 * curve)
    reflectance = 1 + k_over_s - np.sqrt(k_over_s**2 + 2 * k_over_s)
    return reflectance + np.random.default_rng(seed).normal(0, 0.001, NM.shape)


def write(path: str, spectra: dict[str, np.ndarray]) -> None:
    """A table with one spectrum in each row, wavelengths in the first line."""
    with Path(path).open("w", newline="") as file:
        csv.writer(file).writerows(
            [["name", *NM], *([name, *values.round(5)] for name, values in spectra.items())]
        )


# %%
strengths = np.linspace(0.6, 1.6, 6)
library = {f"{name} {n}": batch(name, s, seed=n) for name in POINTS for n, s in enumerate(strengths)}
write("library.csv", library)
with Path("classes.csv").open("w", newline="") as file:
    csv.writer(file).writerows([["name", "class"], *([name, name.split()[0]] for name in library)])
for name, values in library.items():
    plt.plot(NM, values, color=f"tab:{'olive' if 'yellow' in name else name.split()[0]}", alpha=0.6)
plt.xlabel("wavelength, nm")
plt.ylabel("reflectance")
plt.show()

# %% [markdown]
# ## Spots to identify
#
# There are two spots: another batch of the red paint, and a violet paint that the library lacks.

# %%
violet = np.interp(NM, [380, 430, 540, 640, 780], [0.35, 0.40, 0.08, 0.30, 0.60])
spots = {"a red spot": batch("red", 1.2, seed=7), "a violet spot": violet}
write("spots.csv", spots)
findings = coupole.identify("spots.csv", library="library.csv", classes="classes.csv")
for finding in findings:
    print(f"{finding.name}: {finding.verdict} ({finding.class_name}); {finding.reason}")

# %% [markdown]
# ## Probabilities, and how often the library misleads
#
# Each finding has the probability of each class, and the probability that the library has none for
# the spot. `rates` count what happened when each spectrum of the library was left out and then identified.

# %%
for finding in findings:
    best = {one.class_name: f"{one.probability:.0%}" for one in finding.candidates[:3]}
    print(finding.name, best, f"not in the library: {finding.not_in_library:.0%}")
rates = findings[0].rates
for name, rate in {"first class right": rates.right, "match, but wrong": rates.false_matches}.items():
    low, high = rate.interval
    print(f"{name}: {rate.count} of {rate.of}, 95 % interval {low:.2f} to {high:.2f}")

# %% [markdown]
# ## Next
#
# [Identify a pigment](../how-to/identify-a-pigment.md) explains the verdicts, and how reliable they
# were with spectra of real paints.
