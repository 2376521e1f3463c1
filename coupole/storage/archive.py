"""Archives a run: the file of each view is replaced by a compressed one with the same frames.

Views are archived one after the other, so that each view frees its space before the next one needs space.
`storage.archive_view` archives one view without risk of data loss. Only the view's file shows that it is archived;
the journal records how frames were taken, and is not changed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from coupole.errors import UnprovenError
from coupole.storage import frame_file, manifest
from coupole.storage.archive_view import ArchivedView, Progress, archive_view
from coupole.storage.bitshuffle import Codec
from coupole.storage.discarding import discarded_views, finish
from coupole.storage.processing import refuse_while_processed
from coupole.storage.run import Run

KEPT_FOLDER = "unarchived"
"""Subfolder of the run for the original files, with `keep`."""


@dataclass
class Archived:
    """Result of `archive_run`."""

    views: list[ArchivedView] = field(default_factory=list)
    already: list[str] = field(default_factory=list)
    """Views that an earlier call archived."""
    incomplete: list[str] = field(default_factory=list)
    """Views that were not archived because frames are missing."""

    def figures(self) -> dict[str, Any]:
        """Content of `--json`: sizes in bytes, speeds in MB/s of uncompressed frames."""
        pixel_bytes, stored_bytes = sum(v.pixel_bytes for v in self.views), sum(v.stored_bytes for v in self.views)
        seconds = sum((v.compress_s + v.read_back_s for v in self.views), 0.0)
        return {
            "views": [view.figures() for view in self.views],
            "already": self.already,
            "incomplete": self.incomplete,
            "frames": sum(v.frames for v in self.views),
            "bytes": pixel_bytes,
            "stored_bytes": stored_bytes,
            "ratio": round(pixel_bytes / stored_bytes, 4) if stored_bytes else None,
            "mb_s": round(pixel_bytes / seconds / 1e6, 1) if seconds else None,
            "duration_s": round(seconds, 3),
            "freed_bytes": sum(v.freed_bytes for v in self.views),
        }


def archive_run(
    run: Run,
    codec: Codec,
    *,
    keep: bool = False,
    partial: bool = False,
    progress: Progress = lambda what, done, total: None,
    on_view: Callable[[ArchivedView], None] = lambda view: None,
) -> Archived:
    """Archive all views of a run.

    With `keep` the original files are kept in `RUN/unarchived`. With `partial` the complete views of an incomplete
    run are archived; incomplete views never are, so that the run can be resumed.

    Raises InputError if another process has locked the run or makes its result, and UnprovenError if frames are
    missing (without `partial`). Raises ChecksumMismatch if a frame, before or after compression, differs from the
    proven frame, and DiskFull. After an error the current view is unchanged.
    """
    with run.hold_lock():
        if run.asked_result:
            refuse_while_processed(run.folder, run.asked_result)
        proven = run.proven()
        missing = [shot for shot in run.expected_shots() if shot not in proven]
        if missing and not partial:
            raise UnprovenError(
                f"{run.folder}: {len(missing)} frames are missing, the first {missing[0]}. Resume the run first, "
                "or archive its complete views with --partial."
            )
        open_views = run.open_views()
        if (open_views or run.wants_views) and not partial:
            of_what = f"the shots of {open_views[0]}" if open_views else "its views"
            raise UnprovenError(
                f"{run.folder}: {of_what} are not all chosen yet. Resume the run first, or archive its complete "
                "views with --partial."
            )
        finish(run)  # what a crash has left
        event_of_view = discarded_views(run)
        result = Archived(incomplete=sorted({shot.view for shot in missing} | set(open_views)))
        for view in run.views:
            path = run.view_path(view)
            if view in result.incomplete:
                continue
            if frame_file.read_layout(path).is_archived:
                result.already.append(view)
                continue
            name, kept_name = str(path.relative_to(run.folder)), f"{KEPT_FOLDER}/{path.name}"
            manifest.forget(run.folder, [name])
            gone = {shot for shot, _ in event_of_view[view].frames} if view in event_of_view else ()
            frames = [
                frame for shot, frame in proven.items() if run.folder / frame.file == path and shot not in gone
            ]
            archived_view = archive_view(
                path, frames, codec, progress, keep_in=run.folder / KEPT_FOLDER if keep else None
            )
            manifest.enter(run.folder, [name, kept_name] if keep else [name])
            result.views.append(archived_view)
            on_view(archived_view)
    return result
