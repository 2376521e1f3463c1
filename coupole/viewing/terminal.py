"""Output for the operator: progress bars on a terminal, plain lines elsewhere, tables."""

from __future__ import annotations

import contextlib
import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console, ConsoleDimensions
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from coupole.viewing.text_outlet import terminal_size

if TYPE_CHECKING:
    from coupole.preflight.exposure_advice import Advice
    from coupole.storage.run_status import Status
    from coupole.viewing.live import Shown
    from coupole.viewing.progress import Outcome, ViewExposure
    from coupole.viewing.progress import Progress as RunProgress

_PLAIN_LINE_EVERY_S = 5.0
_WIDE = 110
"""Number of a terminal's columns from which rates are shown beside the bars."""
_MARKUP = re.compile(r"\[(bold|dim|green|red|yellow)\](.*?)\[/\]", re.DOTALL)


def make_console(*, quiet: bool) -> Console:
    """Return the console for text. It is standard error, so that standard output is free for `--json`."""
    stream: Any = _Terminal(sys.stderr)
    return _Console(file=stream, quiet=quiet, highlight=False, soft_wrap=not sys.stderr.isatty())


class _Console(Console):
    """Console as wide as the terminal that reads it, even if there is a queue between them. Of rich's markup it
    knows only `[red]words[/]` and the other names in `_MARKUP`. All other brackets, such as brackets in paths, are
    printed as they are."""

    def render_str(self, text: str, *, markup: bool | None = None, **options: Any) -> Text:
        parts, spans, end, length = [], [], 0, 0
        for match in _MARKUP.finditer(text) if markup is None else ():
            start = length + match.start() - end
            length = start + len(match[2])
            spans.append((match[1], start, length))
            parts += [text[end : match.start()], match[2]]
            end = match.end()
        plain = "".join([*parts, text[end:]])
        rendering = super().render_str(plain, **options | {"markup": False, "emoji": False})
        for colour, start, stop in spans:
            rendering.stylize(colour, start, stop)
        return rendering

    @property
    def size(self) -> ConsoleDimensions:
        size = terminal_size()
        return ConsoleDimensions(*size) if size and size.columns else super().size

    @size.setter
    def size(self, new_size: tuple[int, int]) -> None:
        self._width, self._height = new_size


class _Terminal:
    """A stream that may go away (a closed window, a broken pipe). Text that the stream does not take is dropped,
    so that the session ends normally."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def step_bars(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar for each step of a job, with the time left. Call the given function with a step, the number that
    is done, and the number in all. A step is over when the next one begins. Without a terminal there are no bars;
    each step gets a line when it begins."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def say(step: str, count: int, of: int) -> None:
            if step not in tasks:
                for task in bars.tasks:
                    bars.update(task.id, completed=task.total)
                tasks[step] = bars.add_task(step)
                if not console.is_terminal:
                    console.print(f"{step} ...", markup=False)
            bars.update(tasks[step], completed=count, total=of)

        yield say
        for task in bars.tasks:
            bars.update(task.id, completed=task.total)


def alarm(message: str) -> None:
    """Show a message that a person must see: on standard error, even with `--json`."""
    print(message, file=_Terminal(sys.stderr), flush=True)


def duration_text(seconds: float) -> str:
    """Return a duration as `2 h 05 min`, `3 min 20 s` or `12.3 s`."""
    if seconds >= 3600:
        return f"{int(seconds // 3600)} h {int(seconds % 3600 // 60):02d} min"
    return f"{int(seconds // 60)} min {seconds % 60:02.0f} s" if seconds >= 60 else f"{seconds:.1f} s"


def bytes_text(count: float) -> str:
    """Return a size as `1.25 GB`, `39.3 MB` or `12 kB`."""
    if count < 1e5:
        return f"{count / 1e3:.0f} kB"
    return f"{count / 1e9:.2f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"


class RunObserver:
    """Watches a run: bars on a terminal, a line every few seconds elsewhere."""

    def __init__(self, console: Console, frame_bytes: int, proven_before: int, *, speed: float = 1.0) -> None:
        """`speed` is the speed of the cell's clock, in its seconds per second of real time."""
        self._console, self._frame_bytes, self._speed = console, frame_bytes, speed
        self._started_s = time.monotonic()
        self._printed_s = 0.0
        self._before = proven_before
        self.newest: RunProgress | None = None
        self._bars: Progress | None = None
        self._view_bar: Any = None
        self._run_bar: Any = None

    @contextmanager
    def showing(self, frames: int, views: int) -> Iterator[None]:
        """Progress bars during the run, if this is a terminal."""
        if not self._console.is_terminal or self._console.quiet:
            yield
            return
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}", justify="left", markup=False),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[detail]}", markup=False),
        )
        with Progress(*columns, console=self._console, expand=True) as self._bars:
            self._run_bar = self._bars.add_task("frames", total=frames, completed=self._before, detail="")
            self._view_bar = self._bars.add_task("views", total=views, detail="")
            yield
        self._bars = None

    def progress(self, progress: RunProgress) -> None:
        self.newest = progress
        elapsed_s = max(1e-6, time.monotonic() - self._started_s)
        rate = (progress.proven - self._before) / elapsed_s
        remaining_time = f"{duration_text(progress.left_s / self._speed)} left"
        dose = f"{progress.dose_lux_h:.3f} lux.h"
        rates = f"{rate:5.1f} frames/s  {rate * self._frame_bytes / 1e6:5.1f} MB/s  "
        detail = f"{dose}, {remaining_time}" if self._console.width < _WIDE else f"{rates}{dose}, {remaining_time}"
        if self._bars is not None:
            self._bars.update(self._run_bar, completed=progress.proven, detail=detail)
            self._bars.update(
                self._view_bar,
                completed=progress.view_number,
                description=f"view {progress.view}",
                detail=progress.light,
            )
        elif time.monotonic() - self._printed_s > _PLAIN_LINE_EVERY_S:
            self._printed_s = time.monotonic()
            self._console.print(
                f"view {progress.view} ({progress.view_number + 1}/{progress.views}) {progress.light}: "
                f"{progress.proven}/{progress.frames} frames proven, {rates}{dose}, {remaining_time}"
            )

    def note(self, message: str) -> None:
        self._console.print(message)


def show_status(console: Console, status: Status) -> None:
    """Show the progress of a run. Only failures are red."""
    colour = {"done": "green", "failed": "red"}.get(status.state, "yellow")
    note = ", but stopped" if status.stopped_pid else ""
    console.print(
        f"[{colour}]{status.state}{note}[/]: {status.proven} of {status.shots} shots proven, "
        f"{status.darks_proven} dark frames, {status.reshot} re-shot; last event {status.last_event or 'none'}"
    )
    if status.stopped_pid:
        console.print(
            f"  its process {status.stopped_pid} is stopped (Ctrl-Z, SIGSTOP): nothing continues; `kill -CONT "
            f"{status.stopped_pid}` lets it run again, and the run then asks a person (`coupole go-on`)",
            markup=False,
        )
    if status.reason and status.reason not in status.faults:
        console.print(f"  {status.reason}", markup=False)
    console.print(f"  proof: {status.proof}")
    console.print(f"  light on the object: {status.dose_lux_h:.3f} lux.h")
    if status.most_views is not None:
        console.print(f"  chosen in the run: {status.views_in_words}", markup=False)
    for view, (proven, total) in status.views.items():
        console.print(f"  {view}: {proven} of {total} frames")
    if status.frames_discarded:
        console.print(
            f"  {status.frames_discarded} frames were discarded when their samples were safe, as the plan says "
            "(discard: after_fit)"
        )
    for finding in status.findings:
        console.print("  [yellow]found:[/]", Text(finding))
    if status.processing is not None:
        console.print("  reflectance:", Text(status.processing.words), soft_wrap=True)
        if status.processing.remedy:
            console.print(
                f"  continue from the present state by: {status.processing.remedy}", markup=False, soft_wrap=True
            )
    for hold in status.holds:
        console.print("  [yellow]held:[/]", Text(hold))
    for fault in status.faults:
        console.print("  [red]fault:[/]", Text(fault))
    if status.go_on:
        console.print(f"  left to take: {status.left_in_words}; continue with")
        if status.before_that:
            console.print(f"  {status.before_that}", markup=False, soft_wrap=True)
            console.print("  (the arm has a fault: find the cause, check that the cell is clear), and then")
        console.print(f"  {status.go_on}", markup=False, soft_wrap=True)


def show_dry_run(
    console: Console, exposures: Mapping[str, ViewExposure], outcome: Outcome, figures: dict[str, Any]
) -> None:
    """Print the result of a dry run."""
    from coupole.preflight.exposure_scale import HOW_TO_KNOW

    console.print(
        f"dry run: {duration_text(figures['duration_s'])} of the cell's time in "
        f"{duration_text(figures['machine_s'])} ({figures['speed']:.1f} times faster); preflight "
        f"said {duration_text(figures['preflight_s'])}"
    )
    if figures["exposure_scale"] is None:
        console.print(f"exposure: not known; {HOW_TO_KNOW}")
    else:
        table = Table("view", "pictures", "brightest", "saturated", "exposure", box=None)
        for view, exposure in exposures.items():
            table.add_row(
                view,
                str(exposure.pictures),
                f"{exposure.brightest:.0%}",
                f"{exposure.saturated_share:.2%}",
                exposure.verdict(),
            )
        console.print(table)
        console.print(f"exposure judged by {figures['exposure_scale']}", markup=False)
    if outcome.reshot or outcome.over_triggers or outcome.lost_transfers:
        console.print(
            f"{outcome.reshot} shots re-shot, {outcome.over_triggers} edges came while the camera was busy, "
            f"{outcome.lost_transfers} frames lost in transfer"
        )


def show_advice(console: Console, advice: Advice) -> None:
    """Print the result of metering."""
    table = Table("view", "at least", "at most", "object", box=None)
    for view in advice.views:
        table.add_row(
            view.view,
            f"{view.shortest_us:,.0f} us",
            f"{view.longest_us:,.0f} us",
            f"{view.object_share:.0%} of the pixels",
        )
    console.print(table)
    console.print(f"noise: {advice.noise.read_dn:.2f} DN read, {advice.noise.gain_dn:.4f} DN per electron")
    for remark in advice.remarks:
        console.print(f"[yellow]{remark}[/]")
    exposures = ", ".join(f"{exposure_us:,}" for exposure_us in advice.exposure.exposures_us)
    console.print(f"proposed: {advice.exposure.kind} {exposures} us")


class LiveFigures:
    """The live view's figures. They are updated in place on a terminal; elsewhere a line is printed from time to
    time."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, refresh_per_second=5, transient=True) if console.is_terminal else None
        self._best: dict[str, float] = {}
        self._said_s, self._number = 0.0, 0

    def __enter__(self) -> LiveFigures:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, frame: Shown | None) -> None:
        """Print the figures of the newest frame, if they are new."""
        if frame is None or frame.number == self._number:
            return
        self._number = frame.number
        figures = frame.figures
        best = self._best[frame.title] = max(self._best.get(frame.title, 0.0), figures.sharpness)
        saturation = ", ".join(f"{name} {share:.2%}" for name, share in figures.saturated.items())
        detail = f"sharpness {figures.sharpness / best:.0%} of the best" if best else "nothing but noise"
        if frame.run:  # its frames are under different lights: their sharpness cannot be compared
            detail = f"{frame.run}, {frame.dose_lux_h:.3f} lux.h"
        line = (
            f"{frame.title}, {frame.exposure_us} us: brightest {figures.brightest:.0%}; saturated {saturation}; "
            f"{detail}; {frame.frames_per_s:.1f} frames/s"
        )
        if self._live is not None:
            self._live.update("\n".join([line, *(_bars(name, bins) for name, bins in figures.histograms.items())]))
        elif time.monotonic() - self._said_s > _PLAIN_LINE_EVERY_S:
            self._said_s = time.monotonic()
            self._console.print(line)


def _bars(name: str, bins: list[int]) -> str:
    """Return a histogram as one line of blocks, logarithmic."""
    blocks = " ▁▂▃▄▅▆▇█"
    top = math.log1p(max(bins)) or 1.0
    pairs = [max(bins[i : i + 2]) for i in range(0, len(bins), 2)]
    return f"{name:>2} " + "".join(blocks[round(math.log1p(n) / top * (len(blocks) - 1))] for n in pairs)
