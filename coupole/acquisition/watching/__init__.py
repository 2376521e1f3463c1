"""Watching a run by its frames as they come. An unwanted change is found and named within the view.

The thread that stores a frame reduces it to a grid of means (`frame_look`). When a burst has ended, its looks are
judged (`burst_judge`). Dark frames are compared with the first dark frames (`dark_frames`), sentinels with the
first sentinels of the view (`sentinels`), and each light with its neighbours (`neighbour_lights`). `watched_run`
connects this to a run.
"""
