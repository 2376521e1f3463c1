"""What the operator reads and answers at the terminal."""

from __future__ import annotations

import pytest
from rich.table import Table

from coupole.viewing.terminal import make_console


@pytest.mark.parametrize(
    "folder", ["/data [old]/run", "/x[/y]z", "/[bold]x", "/a :bell: b", "/back\\[red]slash\\"]
)
def test_brackets_of_a_path_are_printed_as_they_are(folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    """They would otherwise be rich's markup: left out, or an error that ends the session."""
    console, table = make_console(quiet=False), Table(box=None, show_header=False)
    table.add_row("device", folder)
    console.print(f"  frames  {folder}")
    console.print("[red]bad:[/]", folder)
    console.print(f"[yellow]{folder}[/]: report.html")
    console.print(table)
    lines = [line.strip() for line in capsys.readouterr().err.splitlines()]
    assert lines == [f"frames  {folder}", f"bad: {folder}", f"{folder}: report.html", f"device  {folder}"]


def test_colours_of_messages_remain() -> None:
    text = make_console(quiet=False).render_str("  [yellow]note:[/] a [red]b[/]", style="bold")
    assert text.plain == "  note: a b"
    assert [(span.start, span.end, span.style) for span in text.spans] == [(2, 7, "yellow"), (10, 11, "red")]
