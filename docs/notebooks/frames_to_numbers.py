# %% [markdown]
# # Frames to numbers
#
# This notebook turns the frames of [the first acquisition](first_acquisition.py) into numbers that
# mean light: dark frames subtracted, saturation counted, noise known. Run that notebook first, in
# the same folder.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import coupole

run = coupole.open_run(max(Path("runs").glob("*-demo-short")))
top = run["top"]
print(len(top.shots), "frames under light,", len(top.darks), "dark frames, pattern", top.pattern)
print(f"a pixel has values from {top.black_dn} (no light) to {top.white_dn} (full)")

# %% [markdown]
# ## Dark frames
#
# The mean of the dark frames is what the camera gives without light. Their differences are its
# noise.

# %%
darks = np.array([top[label].pixels for label in top.darks], dtype=float)
dark = darks.mean(axis=0)
read_noise_dn = np.std(darks[0] - darks[1]) / np.sqrt(2)
print(f"dark level {dark.mean():.1f} DN, noise of one dark frame {read_noise_dn:.2f} DN")

# %% [markdown]
# ## Signal of each frame
#
# Each frame minus the dark level is proportional to the light, as long as no pixel is full. Frames
# are read one at a time, and each is compared with its checksum.

# %%
signal_dn = np.array([(top[label].pixels - dark).mean() for label in top.shots])
full = np.array([(top[label].pixels >= top.white_dn).mean() for label in top.shots])
brightest = top.shots[int(signal_dn.argmax())]
print(f"mean signals are {signal_dn.min():.0f} to {signal_dn.max():.0f} DN; {brightest} gives the most")
print(f"at most {full.max():.2%} of a frame's pixels are full")

# %% [markdown]
# ## Where the light comes from
#
# `led_position_mm` is in the base frame of the robot. Seen from above, each LED is a point; its
# colour is the mean signal of its frame.

# %%
places_mm = np.array([top[label].led_position_mm for label in top.shots])
plt.scatter(places_mm[:, 0], places_mm[:, 1], c=signal_dn, cmap="viridis")
plt.colorbar(label="mean signal, DN")
plt.xlabel("x, mm")
plt.ylabel("y, mm")
plt.axis("equal")
plt.show()

# %% [markdown]
# ## The whole view as a dataset
#
# With `pip install 'coupole[xarray]'` a view is one dataset with coordinates and units. No frame is
# read before something is computed.

# %%
dataset = run.dataset("top")
lit = dataset.pixels.where(~dataset.is_dark, drop=True)
mean_picture = (lit.mean(dim="shot") - dark).compute()
print(dict(dataset.sizes), "LEDs in", dataset.led_position_mm.attrs["units"])
plt.imshow(mean_picture, cmap="gray")
plt.title("mean of all frames, dark level subtracted")
plt.show()

# %% [markdown]
# ## Next
#
# A signal still depends on the lamp, the lens and the distance. [Reflectance and its
# uncertainty](reflectance.py) removes these with the records of the
# [calibrations](../how-to/calibrate.md).
