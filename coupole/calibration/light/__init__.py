"""Sensor, lens and LEDs as radiometers.

::

    frames.py       the frames of runs, as these calibrations read them
    dark.py response.py flat_field*.py  the sensor's offset, gain and linearity; the lens's fall-off
    led_power*.py   power of each LED on a white tile: spectralon.py, irradiance.py
    drift*.py       how that changed until a run, on a tile that stands in it
    records.py      frames to records; limits.py, drawing.py: what is accepted and shown
"""
