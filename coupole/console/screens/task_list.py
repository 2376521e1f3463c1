"""Commands that people began at the console: state, duration, output."""

from __future__ import annotations

import html
from collections.abc import Callable

from nicegui import ui

from coupole.console.people.accounts import Role
from coupole.console.processes.tasks import Task
from coupole.console.screens.parts import button, moment
from coupole.console.screens.visit import Visit
from coupole.viewing.terminal import duration_text

_LOOK_EVERY_S = 1.0
_KINDS = {"under way": "running", "done": "done", "failed": "halted"}
_NONE = "No command was begun here since the console started."


class TaskList:
    """The tasks, the newest first; updated while the screen is open."""

    def __init__(
        self, visit: Visit, is_wanted: Callable[[Task], bool], *, empty: str = _NONE, most: int = 10
    ) -> None:
        self._visit, self._wanted, self._most = visit, is_wanted, most
        self._rows: dict[str, _Row] = {}
        self._empty = ui.label(empty).classes("hint")
        self._box = ui.column().classes("gap").props("data-name=tasks").style("width:100%")
        self.look()
        ui.timer(_LOOK_EVERY_S, self.look)

    def look(self) -> None:
        """Show the present state."""
        tasks = [task for task in self._visit.service.tasks.newest_first if self._wanted(task)][: self._most]
        for task_id in set(self._rows) - {task.id for task in tasks}:
            self._rows.pop(task_id).box.delete()
        for task in reversed(tasks):
            if task.id not in self._rows:
                with self._box:
                    self._rows[task.id] = _Row(self._visit, task)
                self._rows[task.id].box.move(target_index=0)
            self._rows[task.id].show()
        self._empty.set_visibility(bool(self._empty.text) and not tasks)


class _Row:
    def __init__(self, visit: Visit, task: Task) -> None:
        self._visit, self._task, self._shown = visit, task, ""
        with ui.column().classes("task") as self.box:
            with ui.row().classes("task-row"):
                self._state = ui.label().classes("chip state").props("role=status")
                ui.label(task.words).classes("task-words")
                self._time = ui.label().classes("hint")
                self._stop = button("Stop", self._end, name="stop-task", kind="flat")
            self._why = ui.label()
            with ui.expansion("What it printed").classes("printed"):
                self._said = ui.html("", sanitize=False).classes("mono")

    def show(self) -> None:
        task = self._task
        running, code = task.running, task.exit_code
        words = "under way" if running else "done" if code == 0 else "failed"
        self._state.text = words
        self._state.props(f"data-state={_KINDS[words]}")
        self._time.text = f"{task.by}, {moment(task.begun_at)} UTC, {duration_text(task.duration_s)}"
        self._stop.set_visibility(running and self._visit.may_act)
        self._why.text = task.why or (f"in {task.figures['out']}" if "out" in task.figures else "")
        self._why.classes(add="bad" if task.why else "hint", remove="hint" if task.why else "bad")
        self._why.set_visibility(bool(self._why.text))
        output = task.output_text
        if output != self._shown:
            self._shown = output
            self._said.set_content(html.escape(output))

    async def _end(self) -> None:
        await self._visit.act(f"stop {self._task.words}", self._task.stop, role=Role.OPERATOR, acts=False)
