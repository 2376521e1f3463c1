"""A file in memory behaves as Python's own, and its bytes reach the disk."""

from __future__ import annotations

import io
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given
from hypothesis import strategies as st

from coupole.storage.unwritten_file import UnwrittenFile

PLACES = st.one_of(st.integers(0, 300_000), st.sampled_from([65535, 65536, 65537, 131_072]))
CHANGES = st.lists(st.tuples(PLACES, st.binary(min_size=1, max_size=70).map(lambda text: text * 1000)), max_size=6)


@given(CHANGES, PLACES, st.integers(0, 200_000))
def test_it_reads_and_writes_as_a_file_does(changes: list[tuple[int, bytes]], place: int, count: int) -> None:
    own, other = UnwrittenFile(), io.BytesIO()
    for file in (own, other):
        for begin, data in changes:
            file.seek(begin)
            file.write(data)
        file.seek(place)
    assert own.read(count) == other.read(count)
    assert own.tell() == other.tell()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        with path.open("wb") as on_disk:
            if own.seek(0, io.SEEK_END):
                own.write_to(on_disk.fileno())
        assert path.read_bytes() == other.getvalue()


def test_it_grows_without_memory_for_what_was_not_written(tmp_path: Path) -> None:
    file = UnwrittenFile()
    file.truncate(10**12)
    assert file.seek(0, io.SEEK_END) == 10**12
    file.seek(10**12 - 3)
    assert file.read() == bytes(3)
