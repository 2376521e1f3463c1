"""Matching of frames to the steps that fired them: proofs from the box's trigger times and the camera's
timestamps.

The box logs when each step sent its edge, on its own clock; the camera stamps each frame that reaches the host, on
another clock. A *hypothesis* is one alignment of the two clocks: frame `a` was fired by step `i`. It assigns a
step to every other frame, or no step (*surplus*). Alignments that differ by whole periods fit the LED steps
equally well; the coded dark marks (`coupole.plan.marks`) distinguish them.

**Fault model.** Any number of frames may be missing (lost in transfer, trigger missed, at the start, at the end,
anywhere). At most `max_surplus` frames of a burst were fired by something other than a step (a bounce, an
interference). If a surplus frame starts within twice the jitter of an edge, and the edge's own frame is missing,
the surplus frame gets that step's label. It was exposed under that step's light. Timestamps deviate from their
edges by at most `jitter_us`; the clocks drift apart steadily, by at most `drift_ppm`.

**Proof.** Under that model the true alignment leaves at most `max_surplus` frames unexplained. The hypotheses that
leave at most so many are the *candidates*. The true alignment is one of them, so a label on which all candidates
agree is true. Frames on which they disagree, and steps that two frames claim, are ambiguous and get no label. All
alignments are tried: the true one assigns a step to at least one of the first `max_surplus + 1` frames, so one of
these is its anchor. With fewer frames nothing is proven. While the burst runs, `in_flight` more frames are needed.

*Explained* means two things. First, a frame lies within the jitter plus the drift since the anchor. This limit is
wide, but the true alignment always passes it. Second, the frames with these labels lie within the jitter of one
straight line of camera time over box time. As many frames as `max_surplus` still allows may be off this line.
Which frames to leave out is searched exhaustively: of three points that no line fits, at least one is a surplus
frame. A frame that any solution of this search leaves out gets no label.

Everything here is a pure function of its arguments and is run again on all frames while a burst continues.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.clock_alignment import DOUBTFUL, PENDING, SURPLUS, agree_on_steps
from coupole.devices import STEP_RECORD_DTYPE

UNLABELLED = -1


@dataclass(frozen=True)
class FaultModel:
    """The faults that a burst may have without giving a wrong label (see the module's docstring)."""

    jitter_us: float = 100.0
    drift_ppm: float = 100.0
    max_surplus: int = 3
    in_flight: int = 2
    """Number of frames that may reach the host before their step is in the log. The log must have been read to its
    end after the last frame was taken."""


@dataclass(frozen=True)
class ClockFit:
    """Camera time = `offset_ns` + (1 + `drift_ppm` * 1e-6) * box time, over the proven frames."""

    offset_ns: float
    drift_ppm: float
    residual_rms_us: float
    residual_max_us: float


@dataclass(frozen=True)
class Match:
    """Verdict on a burst, or on the part of it that is known so far."""

    step_of_frame: NDArray[np.int64]
    """[frames] index into the log, or UNLABELLED."""
    surplus: NDArray[np.bool_]
    """[frames] True for frames that no step has fired, as all candidates agree."""
    missing: NDArray[np.bool_]
    """[steps] an edge was sent, and all candidates agree that none of the frames belongs to it (while a burst
    runs, its frame may still be in transfer)."""
    lost_in_transfer: NDArray[np.bool_]
    """[steps] True for missing frames that the camera did expose, as the frame ids show."""
    ambiguous: bool
    """True if at least one frame could be neither labelled nor declared surplus or pending."""
    reason: str
    """Reason why nothing, or not everything, could be proven; empty if everything was."""
    clocks: ClockFit | None


@dataclass(frozen=True)
class _Aligned:
    """Steps that the candidates assign to each frame."""

    edge_rows: NDArray[np.int64]
    """Rows of the log whose step sent an edge."""
    candidate_rows: NDArray[np.int64]
    """[frames] row of `edge_rows` by the first candidate, or a negative code for no step."""
    agrees: NDArray[np.bool_]
    """[frames] True where all candidates give the same row or code."""


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
    id_modulus : first and last frame id; the first id follows the last id.
    complete : the burst is over and no frame is still in transfer.

    Within the fault model of the module's docstring a label is never wrong. If a label could be wrong, it is not
    given, and `ambiguous` is set.
    """
    model = model or FaultModel()
    n_frames, n_steps = len(frame_ids), len(log)
    edge_steps = np.flatnonzero(log["edge_sent"])
    if n_frames == 0:
        return _match_without_labels(n_frames, n_steps, missing=edge_steps)
    in_flight = 0 if complete else model.in_flight
    id_steps = np.diff(frame_ids) % (id_modulus[1] - id_modulus[0] + 1)
    obstacle = _obstacle(edge_steps, id_steps, (id_modulus[1] - id_modulus[0]) // 2, timestamps_ns)
    if not obstacle and n_frames <= model.max_surplus + in_flight:
        obstacle = "too few frames: all of them may be surplus, or may belong to steps that are not in the log yet"
    if obstacle:
        return _match_without_labels(n_frames, n_steps, reason=obstacle)

    step_ns = log["t_trigger_ns"][edge_steps]
    alignment = _Aligned(edge_steps, np.full(n_frames, UNLABELLED, np.int64), np.zeros(n_frames, np.bool_))
    candidates = agree_on_steps(
        timestamps_ns - timestamps_ns[0],
        step_ns - step_ns[0],
        model.jitter_us * 1e3,
        model.drift_ppm * 1e-6,
        model.max_surplus,
        in_flight,
        alignment.candidate_rows,
        alignment.agrees,
    )
    if candidates == 0:
        reason = f"every alignment of box and camera leaves more than {model.max_surplus} frames unexplained"
        return _match_without_labels(n_frames, n_steps, reason=reason)
    if candidates < 0:
        reason = "after a long gap, the clocks' drift makes it uncertain which step comes next"
        return _match_without_labels(n_frames, n_steps, reason=reason)
    return _verdict(log, timestamps_ns, id_steps, alignment)


def _obstacle(
    edge_rows: NDArray[np.int64], id_steps: NDArray[np.int64], most_id_step: int, timestamps_ns: NDArray[np.int64]
) -> str:
    """Return why frames that have come cannot be aligned with the log; empty if they can."""
    if len(edge_rows) == 0:
        return "frames came before the box sent an edge"
    if np.any(id_steps == 0) or np.any(id_steps > most_id_step):
        return "the camera's frame ids do not increase"
    if np.any(np.diff(timestamps_ns) <= 0):
        return "the camera's timestamps do not increase"
    return ""


def _match_without_labels(
    n_frames: int, n_steps: int, *, missing: NDArray[np.intp] | None = None, reason: str = ""
) -> Match:
    """Return the verdict if no frame gets a label. `missing` are rows of the log."""
    no_step = np.zeros(n_steps, np.bool_)
    is_missing = no_step.copy()
    if missing is not None:
        is_missing[missing] = True
    return Match(
        np.full(n_frames, UNLABELLED, np.int64),
        np.zeros(n_frames, np.bool_),
        is_missing,
        no_step,
        ambiguous=n_frames > 0,
        reason=reason,
        clocks=None,
    )


def _verdict(
    log: NDArray[np.void], timestamps_ns: NDArray[np.int64], id_steps: NDArray[np.int64], alignment: _Aligned
) -> Match:
    """Return the match. A label is given if all candidates agree on it and only one frame claims it. The match
    also has the missing steps and the open questions."""
    edge_steps, agreed_steps, agrees = alignment.edge_rows, alignment.candidate_rows, alignment.agrees
    steps = np.full(len(agreed_steps), UNLABELLED, np.int64)
    claims = np.bincount(agreed_steps[agreed_steps >= 0], minlength=len(edge_steps))
    is_labelled = agrees & (agreed_steps >= 0)
    is_labelled[is_labelled] = claims[agreed_steps[is_labelled]] == 1
    steps[is_labelled] = edge_steps[agreed_steps[is_labelled]]
    surplus = agrees & (agreed_steps == SURPLUS)
    is_undecided = ~is_labelled & ~surplus & ~(agrees & (agreed_steps == PENDING))
    missing = np.zeros(len(log), np.bool_)
    reasons = []
    if not agrees.all():
        reasons.append("more than one alignment of box and camera is possible")
    if np.any(agreed_steps == DOUBTFUL):
        reasons.append("the times of some frames do not agree with the clocks")
    if not reasons:
        missing[edge_steps[claims == 0]] = True
    if np.any(claims > 1):
        reasons.append(f"steps {edge_steps[claims > 1].tolist()} have more than one frame each")
    return Match(
        steps,
        surplus,
        missing,
        _lost_in_transfer(steps, id_steps, missing),
        ambiguous=bool(is_undecided.any()),
        reason="; ".join(reasons),
        clocks=_fit_clocks(log["t_trigger_ns"], timestamps_ns, steps),
    )


def compile_now() -> None:
    """Compile the alignment kernels before the first burst: it takes seconds on a fresh machine."""
    log = np.zeros(16, STEP_RECORD_DTYPE)
    log["edge_sent"] = True
    log["t_trigger_ns"] = 10_000_000 * np.arange(16)
    match(log, np.arange(16), 10_000_000 * np.arange(16), complete=True)
    assert agree_on_steps.signatures, "the compiled functions were not reached"


def _lost_in_transfer(
    steps: NDArray[np.int64], id_steps: NDArray[np.int64], missing: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """[steps] where a gap in the ids is as wide as the run of missing steps between two labelled frames."""
    is_lost = np.zeros_like(missing)
    ids_so_far = np.concatenate([[0], np.cumsum(id_steps)])
    labelled_frames = np.flatnonzero(steps >= 0)
    gaps = np.flatnonzero(np.diff(steps[labelled_frames]) > 1)
    for before, after in zip(labelled_frames[gaps], labelled_frames[gaps + 1], strict=True):
        inside = slice(steps[before] + 1, steps[after])
        ids_unseen = ids_so_far[after] - ids_so_far[before] - (after - before)
        if ids_unseen and ids_unseen == np.count_nonzero(missing[inside]):
            is_lost[inside] = missing[inside]
    return is_lost


def _fit_clocks(
    t_trigger_ns: NDArray[np.int64], timestamps_ns: NDArray[np.int64], steps: NDArray[np.int64]
) -> ClockFit | None:
    """Least-squares line through the labelled pairs; None for fewer than three."""
    labelled_frames = np.flatnonzero(steps >= 0)
    if len(labelled_frames) < 3:
        return None
    box_ns, camera_ns = t_trigger_ns[steps[labelled_frames]], timestamps_ns[labelled_frames]
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
