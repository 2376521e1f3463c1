"""Which frame is which step: proofs from the box's trigger times and the camera's timestamps.

The box logs when each step really sent its edge, on its own clock; the camera stamps each frame that reaches
the host, on another clock. A *hypothesis* is one alignment of the two clocks: frame `a` was fired by step `i`.
It then says of every other frame which step fired it, or that no step did (*surplus*). Alignments that differ
by whole periods look alike on the LED steps and differ on the coded dark marks (`coupole.plan.bursts`).

**Fault model.** Any number of frames may be missing (lost in transfer, trigger missed, at the start, at the
end, anywhere). At most `max_surplus` frames of a burst were fired by something other than a step (a bounce, an
interference); one that starts within twice the jitter of an edge whose own frame is missing is taken for it,
and shows its light. Timestamps deviate from their edges by at most `jitter_us`, clocks from each other by at
most `drift_ppm`, and steadily.

**Proof.** Under that model the true alignment leaves at most `max_surplus` frames unexplained. So it is among
the hypotheses that do, the *candidates*; and a label on which all candidates agree is true. Frames on which
they disagree, and steps that two frames claim, are ambiguous and get no label. All alignments are tried: the
true one fires at least one of the first `max_surplus + 1` frames, so one of these serves as anchor (of fewer
frames nothing is proven; while the burst runs, of fewer than `in_flight` more).

*Explained* means two things. Counted from the anchor, a frame lies within the jitter plus the drift of the time
between: wide, but the true alignment always passes. And the frames so labelled lie within the jitter of one
straight line, camera time over box time, save for as many as `max_surplus` still allows. Which ones to leave out
is tried exhaustively: three points that no line fits hold at least one surplus frame. Labels of frames that some
way of doing so leaves out are not given.

Everything here is a pure function of its arguments and is simply run again as a burst goes on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.devices import STEP_RECORD_DTYPE

UNLABELLED = -1
_SURPLUS, _PENDING, _UNDECIDABLE, _DOUBTFUL = -1, -2, -3, -4


@dataclass(frozen=True)
class FaultModel:
    """What may go wrong in a burst without a label ever being wrong (see the module's text)."""

    jitter_us: float = 100.0
    drift_ppm: float = 100.0
    max_surplus: int = 3
    in_flight: int = 2
    """Frames that may reach the host before their step is in the log; the log must have been read to its end
    after the last of the frames was taken."""


@dataclass(frozen=True)
class ClockFit:
    """Camera time = `offset_ns` + (1 + `drift_ppm` * 1e-6) * box time, over the proven frames."""

    offset_ns: float
    drift_ppm: float
    residual_rms_us: float
    residual_max_us: float


@dataclass(frozen=True)
class Match:
    """Verdict on a burst, or on what is known of it so far."""

    step_of_frame: NDArray[np.int64]
    """[frames] index into the log, or UNLABELLED."""
    surplus: NDArray[np.bool_]
    """[frames] fired by no step, all candidates agree."""
    missing: NDArray[np.bool_]
    """[steps] an edge was sent, and all candidates agree that no frame of it is here (while a burst runs, the
    frame may still be on its way)."""
    lost_in_transfer: NDArray[np.bool_]
    """[steps] missing, and the frame ids show that the camera did expose it."""
    ambiguous: bool
    """Frames or steps are left of which nothing can be said."""
    reason: str
    """Why nothing or not all could be proven; empty when all is well."""
    clocks: ClockFit | None


@numba.njit(cache=True, nogil=True)
def _align(  # type: ignore[no-untyped-def]
    frame_ns, step_ns, anchor_frame, anchor_step, jitter_ns, drift, max_surplus, in_flight, steps_out
):
    """Fill `steps_out` [frames] under one hypothesis; the number of surplus frames, too many of them if it fails.

    Frames that claim the same step are all but one surplus, whichever.
    """
    surplus = pending = 0
    n_frames, n_steps = len(frame_ns), len(step_ns)
    steps_out[anchor_frame] = anchor_step
    for way in (1, -1):
        last = step = anchor_step
        frame = anchor_frame + way
        while 0 <= frame < n_frames:
            elapsed = frame_ns[frame] - frame_ns[anchor_frame]
            predicted = step_ns[anchor_step] + elapsed
            window = 2 * jitter_ns + drift * abs(elapsed)
            while 0 <= step < n_steps and way * (predicted - step_ns[step]) > window:
                step += way
            if step >= n_steps and in_flight > 0:
                pending += 1
                steps_out[frame] = _PENDING
            elif step < 0 or step >= n_steps or abs(step_ns[step] - predicted) > window:
                surplus += 1
                steps_out[frame] = _SURPLUS
            else:
                beyond = step + way
                if 0 <= beyond < n_steps and abs(step_ns[beyond] - predicted) <= window:
                    steps_out[0] = _UNDECIDABLE
                    return 0
                surplus += step == last
                last = step
                steps_out[frame] = step
            if surplus + max(0, pending - in_flight) > max_surplus:  # surplus frames may be pending, too
                return max_surplus + 1
            frame += way
    return surplus


@numba.njit(cache=True, nogil=True)
def _misfit(box_ns, excess_ns, left_out, jitter_ns, triple):  # type: ignore[no-untyped-def]  # noqa: PLR0912
    """True if no line lies within `jitter_ns` of all points but those left out; `triple` then shows three points
    that prove it. The exchange algorithm for the best line in the maximum norm, stopped as soon as it is clear.
    """
    n = len(box_ns)
    kept = 0
    for k in range(n):
        if not left_out[k]:
            if kept < 3:
                triple[kept] = k
            triple[2] = k
            kept += 1
    if kept < 3:
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


@numba.njit(cache=True, nogil=True)
def _leave_out(frame_ns, step_ns, view, may_leave_out, jitter_ns):  # type: ignore[no-untyped-def]  # noqa: PLR0912
    """Mark in `view` the frames that have to, or may have to, be left out for the rest to fit one line; False if
    leaving out `may_leave_out` frames is not enough."""
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
            view[frames[k]] = _DOUBTFUL
    return fits


@numba.njit(cache=True, nogil=True)
def _agree(  # type: ignore[no-untyped-def]
    frame_ns, step_ns, jitter_ns, drift, max_surplus, in_flight, agreed, agrees
):
    """Try all hypotheses; `agreed` [frames] is the first candidate's view, `agrees` where all others share it.

    Returns the number of candidates (the same alignment may count more than once), or -1 if one of them could
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
            if view[0] == _UNDECIDABLE:
                return -1
            if not _leave_out(frame_ns, step_ns, view, max_surplus - surplus, jitter_ns):
                continue
            if candidates == 0:
                agreed[:] = view
                agrees[:] = True
            else:
                for frame in range(n_frames):
                    agrees[frame] &= view[frame] == agreed[frame]
            candidates += 1
    return candidates


def match(
    log: NDArray[np.void],
    frame_ids: NDArray[np.int64],
    timestamps_ns: NDArray[np.int64],
    *,
    id_modulus: tuple[int, int] = (0, 2**62),
    complete: bool,
    model: FaultModel | None = None,
) -> Match:
    """Prove which step fired which frame.

    Parameters
    ----------
    log : STEP_RECORD_DTYPE [steps], in the order of the burst; read to its end after the last frame was taken.
    frame_ids, timestamps_ns : [frames], in the order of arrival, on the camera's counter and clock.
    id_modulus : first and last frame id; after the last comes the first.
    complete : the burst is over and no frame is under way any more.

    Never labels wrongly within the fault model of the module's text; says `ambiguous` instead.
    """
    model = model or FaultModel()
    n_frames, n_steps = len(frame_ids), len(log)
    steps = np.full(n_frames, UNLABELLED, np.int64)
    nothing = np.zeros(n_frames, np.bool_), np.zeros(n_steps, np.bool_), np.zeros(n_steps, np.bool_)

    def unproven(reason: str) -> Match:
        return Match(steps, *nothing, ambiguous=n_frames > 0, reason=reason, clocks=None)

    edged = np.flatnonzero(log["edge_sent"])
    if n_frames == 0:
        missing = np.zeros(n_steps, np.bool_)
        missing[edged] = True
        return Match(steps, *nothing[:1], missing, nothing[2], ambiguous=False, reason="", clocks=None)
    if len(edged) == 0:
        return unproven("frames came before the box sent an edge")
    first_id, last_id = id_modulus
    id_steps = np.diff(frame_ids) % (last_id - first_id + 1)
    if np.any(id_steps == 0) or np.any(id_steps > (last_id - first_id) // 2):
        return unproven("the camera's frame ids do not increase")
    if np.any(np.diff(timestamps_ns) <= 0):
        return unproven("the camera's timestamps do not increase")

    in_flight = 0 if complete else model.in_flight
    if n_frames <= model.max_surplus + in_flight:
        return unproven("too few frames: all of them may be surplus, or of steps that are not in the log yet")

    step_ns = log["t_trigger_ns"][edged]
    agreed, agrees = steps.copy(), np.zeros(n_frames, np.bool_)
    candidates = _agree(
        timestamps_ns - timestamps_ns[0],
        step_ns - step_ns[0],
        model.jitter_us * 1e3,
        model.drift_ppm * 1e-6,
        model.max_surplus,
        in_flight,
        agreed,
        agrees,
    )
    if candidates == 0:
        return unproven(f"no alignment of box and camera leaves {model.max_surplus} frames or fewer unexplained")
    if candidates < 0:
        return unproven("a gap is so long that the clocks' drift hides which step comes next")

    claimed = np.bincount(agreed[agreed >= 0], minlength=len(step_ns))
    labelled = agrees & (agreed >= 0)
    labelled[labelled] = claimed[agreed[labelled]] == 1
    steps[labelled] = edged[agreed[labelled]]
    surplus = agrees & (agreed == _SURPLUS)
    undecided = ~labelled & ~surplus & ~(agrees & (agreed == _PENDING))
    missing = np.zeros(n_steps, np.bool_)
    if agrees.all() and not np.any(agreed == _DOUBTFUL):
        missing[edged[claimed == 0]] = True
    reasons = []
    if not agrees.all():
        reasons.append("more than one alignment of box and camera is possible")
    if np.any(agreed == _DOUBTFUL):
        reasons.append("some frames do not fit the clocks")
    if np.any(claimed > 1):
        reasons.append(f"steps {edged[claimed > 1].tolist()} have more than one frame each")
    return Match(
        steps,
        surplus,
        missing,
        _lost_in_transfer(steps, frame_ids, id_steps, missing),
        ambiguous=bool(undecided.any()),
        reason="; ".join(reasons),
        clocks=_fit_clocks(log["t_trigger_ns"], timestamps_ns, steps),
    )


def compile_now() -> None:
    """Compile the alignment kernels (seconds on a fresh machine), lest the first burst wait for it."""
    log = np.zeros(16, STEP_RECORD_DTYPE)
    log["edge_sent"] = True
    log["t_trigger_ns"] = 10_000_000 * np.arange(16)
    match(log, np.arange(16), 10_000_000 * np.arange(16), complete=True)
    assert _agree.signatures, "the kernels were not reached"


def _lost_in_transfer(
    steps: NDArray[np.int64],
    frame_ids: NDArray[np.int64],
    id_steps: NDArray[np.int64],
    missing: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """[steps] where a gap in the ids is as wide as the run of missing steps between two labelled frames."""
    lost = np.zeros_like(missing)
    counted = np.concatenate([[0], np.cumsum(id_steps)])
    labelled = np.flatnonzero(steps >= 0)
    gaps = np.flatnonzero(np.diff(steps[labelled]) > 1)
    for before, after in zip(labelled[gaps], labelled[gaps + 1], strict=True):
        inside = slice(steps[before] + 1, steps[after])
        ids_unseen = counted[after] - counted[before] - (after - before)
        if ids_unseen and ids_unseen == np.count_nonzero(missing[inside]):
            lost[inside] = missing[inside]
    return lost


def _fit_clocks(
    t_trigger_ns: NDArray[np.int64], timestamps_ns: NDArray[np.int64], steps: NDArray[np.int64]
) -> ClockFit | None:
    """Least-squares line through the labelled pairs; None for fewer than three."""
    labelled = np.flatnonzero(steps >= 0)
    if len(labelled) < 3:
        return None
    box_ns, camera_ns = t_trigger_ns[steps[labelled]], timestamps_ns[labelled]
    x = (box_ns - box_ns[0]).astype(np.float64)
    y = (camera_ns - camera_ns[0]).astype(np.float64) - x
    slope, intercept = np.polyfit(x / x[-1], y, 1)
    residual_us = (y - (intercept + slope * x / x[-1])) / 1e3
    drift = slope / x[-1]
    return ClockFit(
        offset_ns=float(camera_ns[0]) + float(intercept) - (1.0 + drift) * float(box_ns[0]),
        drift_ppm=float(drift * 1e6),
        residual_rms_us=float(np.sqrt(np.mean(residual_us**2))),
        residual_max_us=float(np.abs(residual_us).max()),
    )
