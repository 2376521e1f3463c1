# %% [markdown]
# # First acquisition in Python
#
# This notebook acquires one view of a relief on the simulated cell, from Python. It needs no
# instrument and takes about a minute. The other notebooks use its run.
#
# A *plan* says what to photograph: the views of the camera, the lights, and the exposure.
# `demo-short` is a plan that comes with Coupole: one view, every 20th of the 1080 LEDs.

# %%
import matplotlib.pyplot as plt
import numpy as np

import coupole

plan = coupole.Plan.read("demo-short")
print(plan.name, plan.views, plan.lights, plan.exposure, sep="\n")

# %% [markdown]
# ## Check before anything moves
#
# The preflight knows the cell's geometry. It looks for collisions on the arm's path, and adds up
# the time, the bytes, and the light that the object receives. A plan with refusals is not run.

# %%
report = plan.check()
print("refusals:", report.refusals)
print(f"{report.shots} shots and {report.frames - report.shots} dark frames, {report.bytes / 1e6:.0f} MB")
print(f"{report.duration_s:.0f} s, {report.dose_lux_h:.2f} lux h at the brightest point")

# %% [markdown]
# ## Acquire
#
# `coupole.acquire` is an iterator of the run's events. Each frame is *proven*: the LED box's log
# and the camera's timestamps agree on which light was on. At the end of the context, also after an
# exception, the lights are off and the arm stands still.

# %%
proven = 0
with coupole.acquire(plan, output="runs") as events:
    for event in events:
        if isinstance(event, coupole.events.FrameProven):
            proven += 1
print(proven, "frames are proven;", events.figures["proven"], "of", events.figures["shots"], "shots")

# %% [markdown]
# ## Look at a frame
#
# The run is a folder in open formats. `coupole.open_run` reads its frames as arrays, here the raw
# picture with its Bayer pattern under one LED.

# %%
assert events.run is not None
with coupole.open_run(events.run) as run:
    top = run["top"]
    label = top.shots[len(top.shots) // 2]
    frame = top[label]
    print(label, frame.exposure_us, "us, LED at", frame.led_position_mm, "mm")
    plt.imshow(np.asarray(frame), cmap="gray", vmin=top.black_dn)
plt.title(f"{frame.shot}: {frame.proof}", wrap=True)
plt.show()

# %% [markdown]
# ## Next
#
# [Frames to numbers](frames_to_numbers.py) subtracts the dark frames. [The same acquisition by
# commands](../tutorial/first-acquisition.md) explains pauses, resuming and the report.
