"""Radiometry of sensor, lens and LEDs.

::

    frames.py       the frames of runs, as these calibrations read them; pairs.py: pairs of equal exposure
    dark.py photon_transfer.py linearity.py flat_field*.py  offset, gain and linearity of the sensor; fall-off
                    flat_suspects.py: causes that a flat field's model may lack
    led_power*.py   power of each LED, by a white tile: tile_views.py, spectralon.py, irradiance.py
                    power_between.py: its observations; power_suspects.py, tile_lobe.py, tile_parts.py: causes
                    that its model may lack; power_figures.py, power_left_out.py: their effect, views left out
    drift*.py       change of the power until a run, by a tile that is in the run's views
    glare*.py       veiling glare, by black traps beside white; veil.py: its form, glare_correction.py: taken off
    frames records.py      from frames to records; acceptance.py, drawing.py: acceptance limits and pictures
"""
