"""Notices events at a cell and notifies people, in separate threads, so that nothing else waits."""

from __future__ import annotations

import contextlib
import json
import queue
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from coupole.console.plans.plan_queue import Entry, PlanQueue
from coupole.console.upkeep.notifications import Message, Settings, ways
from coupole.errors import CoupoleError, InputError, StorageError
from coupole.plan.cell import Cell
from coupole.storage.arm_faults import faults_of
from coupole.storage.line_file import LineFile, utc_now

_LOOK_EVERY_S, _TRIALS, _AGAIN_AFTER_S, _MOST_WAITING = 1.0, 3, 5.0, 100
_RELIEF = 1.1
"""Factor on the limit: a disk counts as low again only after this multiple of the limit was free."""


class Occurrences:
    """Search for events at a cell since the last call."""

    def __init__(self, cell: Cell, plans: PlanQueue, disk_low_gb: float) -> None:
        self._cell, self._queue, self._low_bytes = cell, plans, disk_low_gb * 1e9
        self._ended = {entry.id for entry in plans.entries if entry.ended}
        self._halted = plans.halt_reason
        self._known_fault = self._newest_fault()
        self._disk_was_low = False

    def since(self) -> Iterator[Message]:
        """Return the new events. Raises StorageError if the arm's faults cannot be read."""
        for entry in self._queue.entries:
            if entry.ended and entry.id not in self._ended:
                self._ended.add(entry.id)
                yield self._ending(entry)
        if (halt_reason := self._queue.halt_reason) != self._halted:
            self._halted = halt_reason
            ended_words = [entry.words for entry in self._queue.entries if entry.ended]
            if halt_reason and not halt_reason.startswith(tuple(ended_words)):
                yield self._message("fault", "the queue has stopped", halt_reason)
        if (fault := self._newest_fault()) != self._known_fault:
            self._known_fault = fault
            if fault:
                words = (
                    f"{fault}\nUntil somebody has been there and says `coupole confirm`, the arm does not move."
                )
                yield self._message("arm-fault", "the arm has a fault", words)
        yield from self._disk()

    def _ending(self, entry: Entry) -> Message:
        if entry.hold:
            return self._message("hold", entry.words, f"The queue waits for a person: {entry.hold}")
        waiting = f"{len(self._queue.waiting)} entries wait." if self._queue.waiting else "Nothing waits."
        text = f"{entry.words} of {entry.by}: {entry.said or 'complete'}\n{entry.run}\n{waiting}"
        if entry.state == "failed":
            return self._message("fault", f"{entry.words} failed", text)
        return self._message("plan-ended", f"{entry.words} is {entry.state}", text)

    def _newest_fault(self) -> str:
        standing = faults_of(self._cell).standing()
        return f"{standing[-1].t}: {standing[-1].message}" if standing else ""

    def _disk(self) -> Iterator[Message]:
        folder = next(
            path for path in (self._cell.storage_folder, *self._cell.storage_folder.parents) if path.exists()
        )
        free_bytes = shutil.disk_usage(folder).free
        if free_bytes < self._low_bytes and not self._disk_was_low:
            self._disk_was_low = True
            words = f"{free_bytes / 1e9:.1f} GB are free, less than the limit of {self._low_bytes / 1e9:g} GB."
            yield self._message("disk-low", f"little room left in {folder}", words)
        elif free_bytes > _RELIEF * self._low_bytes:
            self._disk_was_low = False

    def _message(self, event: object, subject: str, text: str) -> Message:
        return Message.now(self._cell.rig.name, event, subject, text)  # type: ignore[arg-type]


class Notifier:
    """Sends events while its context lasts. `trouble` is the error of the last message; each delivery is a line in
    `notifications.jsonl`.
    """

    def __init__(self, settings: Settings | None, occurrences: Occurrences, folder: Path) -> None:
        self._settings, self._occurrences = settings, occurrences
        self._log = folder / "notifications.jsonl"
        self._messages: queue.Queue[Message | None] = queue.Queue(_MOST_WAITING)
        self._ending = threading.Event()
        self.trouble = ""

    def __enter__(self) -> Notifier:
        if self._settings is not None:
            for work in (self._watch, self._deliver):
                threading.Thread(target=work, name=f"notifications, {work.__name__}", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the threads; messages that are not sent yet are dropped."""
        self._ending.set()
        with contextlib.suppress(queue.Full):
            self._messages.put_nowait(None)

    def _watch(self) -> None:
        assert self._settings is not None
        while not self._ending.wait(_LOOK_EVERY_S):
            try:
                for message in self._occurrences.since():
                    if message.event in self._settings.events:
                        self._messages.put_nowait(message)
            except (CoupoleError, OSError, queue.Full) as error:
                self.trouble = f"notifications: {error or 'too many wait to be sent'}"

    def _deliver(self) -> None:
        assert self._settings is not None
        while (message := self._messages.get()) is not None:
            troubles = [words for words in self._send_by_all_ways(message).values() if words]
            self.trouble = "; ".join(f"notification not sent: {words}" for words in troubles)

    def _send_by_all_ways(self, message: Message) -> dict[str, str]:
        assert self._settings is not None
        error_of_way = {}
        for way, send in ways(self._settings).items():
            for trial in range(_TRIALS):
                try:
                    send(message)
                except (OSError, ValueError) as error:
                    error_of_way[way] = f"{way}: {error or type(error).__name__}"
                    if trial + 1 == _TRIALS or self._ending.wait(_AGAIN_AFTER_S):
                        break
                else:
                    error_of_way[way] = ""
                    break
            self._note(message, way, error_of_way[way])
        return error_of_way

    def _note(self, message: Message, way: str, trouble: str) -> None:
        line = {"t": utc_now(), "event": message.event, "subject": message.subject, "by": way, "trouble": trouble}
        with contextlib.suppress(StorageError):
            file = LineFile(self._log)
            try:
                file.append([json.dumps(line, ensure_ascii=False) + "\n"])
            finally:
                file.close()


def send_test(settings: Settings, cell: str) -> dict[str, str]:
    """Send a message by each way, once; return the error of each, empty if it was sent."""
    message = Message.now(
        cell, "test", "a test of its notifications", "If you read this, notifications reach you."
    )
    error_of_way = {}
    for way, send in ways(settings).items():
        begun_s = time.monotonic()
        try:
            send(message)
            error_of_way[way] = ""
        except (OSError, ValueError) as error:
            error_of_way[way] = f"{error or type(error).__name__} (after {time.monotonic() - begun_s:.0f} s)"
    if not error_of_way:
        raise InputError("the settings name no channel: expected `email`, `webhooks` or `desktop: true`")
    return error_of_way
