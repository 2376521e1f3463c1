# %% [markdown]
# # Your own LED box
#
# A dome whose LEDs are switched by a microcontroller with lines of text (`LED 5 ON`) needs no
# driver in Python: the rig lists its commands. This notebook describes such a dome, lights one LED,
# and acquires with it, all on a simulated microcontroller. [A dome you built
# yourself](../how-to/home-built-dome.md) has the wiring and the sketch for an Arduino.

# %%
import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import coupole

rig = coupole.Rig.read("sim-text-dome")
for name, value in rig.ledbox.settings.items():
    print(f"{name}: {value}")

# %% [markdown]
# ## A dome of your own
#
# The table of LEDs has a row for each: its place in the base frame of the robot, the direction in
# which it shines, and its flux. Here four rings of 16 LEDs stand round the middle of the support.

# %%
middle = np.array(rig.support.base_from_support.translation_mm)
elevations, azimuths = np.meshgrid(np.radians([15, 35, 55, 75]), np.arange(16) * np.pi / 8, indexing="ij")
across = np.cos(elevations) * np.array([np.cos(azimuths), np.sin(azimuths)])
normals = -np.array([*across, -np.sin(elevations)]).reshape(3, 64).T  # the arm hangs: z of its base is downwards
places_mm = middle - 1500.0 * normals

# %%
with Path("my-dome.csv").open("w", newline="") as file:
    table = csv.writer(file)
    table.writerow(["id", "board", "x_mm", "y_mm", "z_mm", "nx", "ny", "nz", "flux_lm"])
    for number, (place, normal) in enumerate(zip(places_mm, normals, strict=True)):
        table.writerow([number, number % 8, *place.round(3), *normal.round(6), 800])

# %% [markdown]
# ## Its words
#
# The settings of the box are its commands. `{led}` is the number of the LED, `{on_ms}` the time
# after which the box switches it off by itself. A template that could not work is refused with its
# line, before a device is opened.

# %%
mine = rig.model_dump() | {"name": "my-dome"}
mine["dome"] = mine["dome"] | {"leds": Path("my-dome.csv").absolute()}
my_rig = coupole.Rig.model_validate(mine).write("my-dome.yaml", overwrite=True)
wrong = Path("wrong.yaml")
wrong.write_text(my_rig.read_text().replace("LED {led} ON", "LED {lamp} ON"))
try:
    with coupole.open_cell(wrong):
        pass
except coupole.errors.InputError as error:
    print(error)

# %% [markdown]
# ## Light one LED
#
# `open_cell` opens the devices and makes them safe at the end. `flash` lights an LED for a time
# that the box keeps by itself.

# %%
with coupole.open_cell(my_rig) as cell:
    print(cell.identities["ledbox"])
    cell.ledbox.flash(5, 20_000)
    print("lit:", cell.ledbox.lit())
    print("the box says:", cell.ledbox.end_flash())

# %% [markdown]
# ## Acquire with it
#
# Without a cable from box to camera the host triggers each frame. A frame is proven if it is the
# only one that was taken while its light was confirmed to be on.

# %%
shipped = coupole.Plan.read("text-dome").model_dump()
plan = coupole.Plan.model_validate(shipped | {"name": "my-dome", "rig": my_rig.absolute()})
with coupole.acquire(plan, output="runs") as events:
    frames = sum(isinstance(event, coupole.events.FrameProven) for event in events)
assert events.run is not None
run = coupole.open_run(events.run)
print(frames, "frames;", run.proof)

# %%
view = run[run.views[0]]
figure, axes = plt.subplots(2, 4, figsize=(10, 4))
for axis, label in zip(axes.flat, view.shots[::8], strict=False):
    axis.imshow(view[label].pixels, cmap="gray")
    axis.set_title(label)
    axis.set_axis_off()
plt.show()

# %% [markdown]
# ## Next
#
# For a box with another protocol, write a driver: [a new kind of LED
# box](../contributing.md#a-new-kind-of-led-box) names each file. The
# [contracts](../reference/python.md) that it keeps are those of the conformance tests.
