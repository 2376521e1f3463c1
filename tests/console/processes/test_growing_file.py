"""What a process prints is read as it comes, not again and again."""

from __future__ import annotations

from pathlib import Path

from coupole.console.processes.growing_file import GrowingFile


def test_the_end_of_what_grows_is_told_and_only_what_is_new_is_read(tmp_path: Path) -> None:
    path = tmp_path / "said.log"
    file = GrowingFile(path, 8)
    assert file.text == ""
    path.write_text("one ")
    assert file.text == "one "
    path.write_text("ONE two ")  # what was read is not read again
    assert file.text == "one two "
    with path.open("a") as more:
        more.write("a very long line, and the end")
    assert file.text == " the end"
    path.write_bytes("é".encode()[:1])
    assert file.text == "\N{REPLACEMENT CHARACTER}", "begun anew"
    with path.open("ab") as rest:
        rest.write("é".encode()[1:])
    assert file.text == "é"
