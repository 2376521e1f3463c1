# %% [markdown]
# # Reflectance and its uncertainty
#
# This notebook finds the materials of the relief from the frames of [the first
# acquisition](first_acquisition.py), and says how well they are known. Run that notebook first, in
# the same folder.
#
# The fit uses the run and the calibration records that its plan names, and nothing else. A result
# that is there already is not made again.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import coupole

folder = max(Path("runs").glob("*-demo-short"))
result = coupole.fit_reflectance(folder, "reflectance")
print("fits of the materials:", *result.fits)

# %% [markdown]
# ## Materials of the mesh
#
# Each triangle of the mesh has a diffuse reflectance `kd` in three channels, a specular factor `ks`
# and a roughness `alpha`. A white diffuser has kd = 1/pi, so pi kd is the share of light that is
# reflected.

# %%
materials = result.materials()
print(len(result.faces), "triangles,", int(result.is_seen.sum()), "are seen")
print("pi kd, median of red, green, blue:", (np.pi * np.nanmedian(materials.kd, axis=0)).round(3))
print("roughness, median:", np.nanmedian(materials.alpha).round(3))

# %% [markdown]
# ## How well they are known
#
# The covariance of a triangle has five rows: two tilts of the normal (rad), and the logarithms of
# kd, ks and alpha. The square root of the diagonal is a standard uncertainty: the true value is
# within it in 68 % of the cases. Errors that all triangles share, such as an error of the reference
# lamp's strength, are not included.
#
# This relief is matt, and 54 lights are few. So its normals and its colour are known, but hardly
# its highlights: an uncertainty of more than 100 % for `ks` and `alpha` says that
# they are not known.

# %%
u = np.sqrt(np.diagonal(result.covariances(), axis1=1, axis2=2))
known = np.isfinite(u).all(axis=1)
print(f"normals: {np.degrees(np.median(u[known, :2])):.2f} degrees")
for name, column in {"kd": 2, "ks": 3, "alpha": 4}.items():
    print(f"{name}: {np.median(u[known, column]):.1%}")

# %% [markdown]
# ## Check it with light that the fit has not seen
#
# Some LEDs were left out of the fit. `held_out_inside` is the share of their pixels that lie inside
# the stated 95 % intervals, for each fit; `mae` is the mean error in shares of the camera's range.

# %%
for name, share in result.about["held_out_inside"].items():
    error = result.about["mae"][name]
    print(f"{name}: {share:.1%} inside the 95 % intervals, mean error {error:.2%} of the range")

# %% [markdown]
# ## A light that was not there
#
# `relight` makes the picture under any light, and `relight_uncertainty` its standard uncertainty.

# %%
lamp = coupole.lights.PointLight(at_mm=(100.0, -200.0, 300.0))
picture = result.relight([lamp], view="top", fit="ggx_normal")
u_picture = result.relight_uncertainty([lamp], view="top", fit="ggx_normal")
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
left.imshow(np.clip(picture / np.nanpercentile(picture, 99), 0, 1) ** (1 / 2.2))
left.set_title("under a lamp that was not there")
shown = right.imshow(u_picture.mean(axis=2) / np.maximum(picture.mean(axis=2), 1e-3), vmin=0, vmax=0.2)
right.set_title("relative standard uncertainty")
figure.colorbar(shown)
plt.show()

# %% [markdown]
# ## Next
#
# [Reflectance of a run](../how-to/reflectance-of-a-run.md) says what each fit is for. `coupole show
# reflectance --out page.html` makes a page to turn and relight the relief in a browser.
