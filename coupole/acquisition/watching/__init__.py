"""Watching a run by its frames as they come: what changes that should not, found within the view, and named.

The thread that stores a frame reduces it to a grid of means (`frame_look`). When a burst has ended its looks are
judged (`burst_judge`): dark frames against the first ones (`dark_frames`), sentinels against those of the view's
begin (`sentinels`), each light against its neighbours (`neighbour_lights`). `watched_run` joins this to a run.
"""
