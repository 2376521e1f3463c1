"""Places and normals of the LEDs.

::

    led_plan.py     the plan: views that see all LEDs, and the lights of each view
    spots.py        a lit LED in a frame; sources.py, views.py: in all frames of a run
    matching.py     assigns spots to LEDs; names dead, swapped and mis-wired ones
    boards.py       LEDs on rigid boards; equations.py, adjustment.py: one adjustment with the robot's noise
    workflow.py     from runs to record and table; acceptance.py, drawing.py: acceptance limits and picture
"""
