"""Alignments of the camera's clock with the light box's clock: the step on which each frame falls, by each
alignment.

The compiled kernels of `coupole.acquisition.frame_matching`, whose docstring has the fault model, the terms and
the proof. Times are int64 nanoseconds. Frames are counted from the first frame, steps from the first step that
sent an edge. `view` and `steps_out` are int64 [frames]: the row of a step, or one of the codes below.
"""

from __future__ import annotations

import numpy as np

from coupole.kernels import kernel

SURPLUS = -1
"""No step fired the frame."""
PENDING = -2
"""The frame's step may not be in the log yet."""
UNDECIDABLE = -3
"""Two steps lie within the tolerance of one frame."""
DOUBTFUL = -4
"""The frames fit one line only without one of them, which is, or may be, this frame."""


@kernel
def _align(  # type: ignore[no-untyped-def]
    frame_ns, step_ns, anchor_frame, anchor_step, jitter_ns, drift, max_surplus, in_flight, steps_out
):
    """Fill `steps_out` [frames] under one hypothesis; returns the number of surplus frames.

    It stops and returns `max_surplus + 1` as soon as there are too many. If several frames fall on one step, all
    but one are counted as surplus. It does not matter here which of these frames is not counted.
    """
    surplus = pending = 0
    n_frames, n_steps = len(frame_ns), len(step_ns)
    steps_out[anchor_frame] = anchor_step
    for way in (1, -1):
        last = step = anchor_step
        frame = anchor_frame + way
        while 0 <= frame < n_frames:
            elapsed_ns = frame_ns[frame] - frame_ns[anchor_frame]
            predicted_ns = step_ns[anchor_step] + elapsed_ns
            window = 2 * jitter_ns + drift * abs(elapsed_ns)
            while 0 <= step < n_steps and way * (predicted_ns - step_ns[step]) > window:
                step += way
            if step >= n_steps and in_flight > 0:
                pending += 1
                steps_out[frame] = PENDING
            elif step < 0 or step >= n_steps or abs(step_ns[step] - predicted_ns) > window:
                surplus += 1
                steps_out[frame] = SURPLUS
            else:
                beyond = step + way
                if 0 <= beyond < n_steps and abs(step_ns[beyond] - predicted_ns) <= window:
                    steps_out[0] = UNDECIDABLE
                    return 0
                surplus += step == last
                last = step
                steps_out[frame] = step
            if surplus + max(0, pending - in_flight) > max_surplus:  # surplus frames may be pending, too
                return max_surplus + 1
            frame += way
    return surplus


@kernel
def _misfit(box_ns, excess_ns, left_out, jitter_ns, triple):  # type: ignore[no-untyped-def]  # noqa: PLR0912
    """True if no line passes within `jitter_ns` of all points that are not left out; `triple` [3] then holds three
    points that prove it. It is the exchange algorithm for the best line in the maximum norm, stopped at the first
    proof.
    """
    n = len(box_ns)
    count = 0
    for k in range(n):
        if not left_out[k]:
            if count < 3:
                triple[count] = k
            triple[2] = k
            count += 1
    if count < 3:
        return False
    for _ in range(n):
        i, j, k = triple
        slope = (excess_ns[k] - excess_ns[i]) / (box_ns[k] - box_ns[i])
        height = (excess_ns[j] - excess_ns[i] - slope * (box_ns[j] - box_ns[i])) / 2
        if abs(height) > jitter_ns:
            return True
        worst, worst_residual = -1, jitter_ns
        for m in range(n):
            if not left_out[m]:
                residual = excess_ns[m] - excess_ns[i] - slope * (box_ns[m] - box_ns[i]) - height
                if abs(residual) > abs(worst_residual):
                    worst, worst_residual = m, residual
        if worst < 0:
            return False
        like_the_middle = (worst_residual > 0) == (height > 0)
        if worst < i:
            if like_the_middle:
                triple[1], triple[2] = i, j
            triple[0] = worst
        elif worst < j:
            triple[1 if like_the_middle else 0] = worst
        elif worst < k:
            triple[1 if like_the_middle else 2] = worst
        else:
            if like_the_middle:
                triple[0], triple[1] = j, k
            triple[2] = worst
    return False


@kernel
def _leave_out(frame_ns, step_ns, view, may_leave_out, jitter_ns):  # type: ignore[no-untyped-def]  # noqa: PLR0912
    """Mark in `view` the frames as DOUBTFUL that some solution leaves out. A solution leaves out at most
    `may_leave_out` frames so that the others fit one line. Returns False if there is no solution."""
    n_frames = len(view)
    frames = np.empty(n_frames, np.int64)
    n = 0
    for frame in range(n_frames):
        alone = view[frame] >= 0
        if frame > 0 and view[frame - 1] == view[frame]:
            alone = False
        if frame + 1 < n_frames and view[frame + 1] == view[frame]:
            alone = False
        if alone:
            frames[n] = frame
            n += 1
    box_ns, excess_ns = np.empty(n), np.empty(n)
    for k in range(n):
        box_ns[k] = step_ns[view[frames[k]]] - step_ns[view[frames[0]]]
        excess_ns[k] = frame_ns[frames[k]] - frame_ns[frames[0]] - box_ns[k]
    left_out, ever_left_out = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    triple = np.empty(3, np.int64)
    tries = np.empty((may_leave_out + 1, 3), np.int64)  # at each depth, three points of which one must go
    next_try = np.zeros(may_leave_out + 1, np.int64)
    depth, fits = 0, False
    enter = True
    while depth >= 0:
        if enter:
            if not _misfit(box_ns, excess_ns, left_out, jitter_ns, triple):
                fits = True
                ever_left_out |= left_out
                depth, enter = depth - 1, False
                continue
            if depth == may_leave_out:
                depth, enter = depth - 1, False
                continue
            tries[depth] = triple
            next_try[depth] = 0
        if next_try[depth] > 0:
            left_out[tries[depth, next_try[depth] - 1]] = False
        if next_try[depth] == 3:
            depth, enter = depth - 1, False
            continue
        left_out[tries[depth, next_try[depth]]] = True
        next_try[depth] += 1
        depth, enter = depth + 1, True
    for k in range(n):
        if ever_left_out[k]:
            view[frames[k]] = DOUBTFUL
    return fits


@kernel
def agree_on_steps(  # type: ignore[no-untyped-def]
    frame_ns, step_ns, jitter_ns, drift, max_surplus, in_flight, first_view, agrees
):
    """Try all hypotheses. `first_view` [frames] becomes the first candidate's view; `agrees` becomes True where
    all other candidates share it.

    Returns the number of candidates (the same alignment may count more than once), or -1 if one hypothesis could
    not be decided.
    """
    n_frames, n_steps = len(frame_ns), len(step_ns)
    candidates = 0
    view = np.empty(n_frames, np.int64)
    for anchor_frame in range(min(max_surplus + 1, n_frames)):
        for anchor_step in range(n_steps):
            surplus = _align(
                frame_ns, step_ns, anchor_frame, anchor_step, jitter_ns, drift, max_surplus, in_flight, view
            )
            if surplus > max_surplus:
                continue
            if view[0] == UNDECIDABLE:
                return -1
            if not _leave_out(frame_ns, step_ns, view, max_surplus - surplus, jitter_ns):
                continue
            if candidates == 0:
                first_view[:] = view
                agrees[:] = True
            else:
                for frame in range(n_frames):
                    agrees[frame] &= view[frame] == first_view[frame]
            candidates += 1
    return candidates
