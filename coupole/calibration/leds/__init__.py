"""Places and normals of the LEDs.

::

    led_plan.py     the plan: views that see all LEDs, and the lights of each view
    spots.py        a lit LED in a frame; sources.py, views.py: in all frames of a run
    matching.py     assigns spots to LEDs; names dead, swapped and mis-wired ones
    boards.py       LEDs on rigid boards; equations.py, normal_equations.py, adjustment.py: one adjustment with the
                    robot's noise; suspects.py: causes that it may lack; left_out.py: views left out in turn
    workflow.py     from runs to record and table; remarks.py: what the operator should do; acceptance.py,
                    drawing.py: acceptance limits and picture
"""
