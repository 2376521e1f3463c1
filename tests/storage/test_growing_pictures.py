"""Pictures that grow while a run goes on: a reader finds whole ones, whatever the writer does meanwhile."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from coupole.pages.maps import picture_png
from coupole.storage import growing_pictures
from coupole.storage.growing_pictures import (
    PICTURES,
    GrowingPictures,
    PageSoFar,
    PictureShown,
    ViewPictures,
    file_so_far,
    new_picture_name,
    read_growing,
)

PNG = picture_png(np.arange(40_000, dtype=np.uint8).reshape(200, 200))


def put(writer: GrowingPictures, view: str, frames: int, count: int = 3) -> None:
    names = [new_picture_name(f"kind{number}") for number in range(count)]
    pictures = tuple(
        PictureShown(file=name, title=name, width_px=200, height_px=200, unit="%", low=0.0, high=1.0)
        for name in names
    )
    shown = ViewPictures(
        view=view,
        kind="first-look",
        fitted_views=1,
        views=2,
        frames=frames,
        triangles=1,
        t="2026-01-01T00:00:00.000Z",
        pictures=pictures,
    )
    writer.put_view(shown, dict.fromkeys(names, PNG))


def test_a_reader_never_finds_half_a_picture_nor_one_that_is_gone(tmp_path: Path) -> None:
    writer, over = GrowingPictures(tmp_path, is_simulated=True), threading.Event()
    put(writer, "top", 0)

    def write() -> None:
        for number in range(300):
            put(writer, "top" if number % 2 else "side", number)
        over.set()

    writing = threading.Thread(target=write)
    writing.start()
    looks = 0
    while not over.is_set() or not looks:
        growing = read_growing(tmp_path)
        assert growing.of_views, "the index is whole"
        for name in growing.files:
            assert (tmp_path / PICTURES / name).read_bytes() == PNG
        looks += 1
    writing.join()
    assert [view.frames for view in read_growing(tmp_path).of_views] == [299, 298]


def test_a_writer_that_is_killed_between_pictures_and_index_leaves_the_earlier_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = GrowingPictures(tmp_path, is_simulated=True)
    put(writer, "top", 1)
    before = read_growing(tmp_path)

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as since:
        since.setattr(Path, "write_text", killed)
        with pytest.raises(KeyboardInterrupt):
            put(writer, "top", 2)
    assert read_growing(tmp_path) == before
    assert all(file_so_far(tmp_path, name) for name in before.files)


def test_another_session_keeps_what_was_drawn_and_files_go_a_minute_after_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(GrowingPictures(tmp_path, is_simulated=True), "top", 1)
    writer = GrowingPictures(tmp_path, is_simulated=True)
    put(writer, "side", 2)
    first, second = read_growing(tmp_path).of_views
    assert (first.view, second.view) == ("top", "side")
    put(writer, "top", 3)
    assert [view.frames for view in read_growing(tmp_path).of_views] == [3, 2], "in its old place"
    for picture in first.pictures:
        assert (tmp_path / PICTURES / picture.file).exists(), "a browser may be loading it"
    monkeypatch.setattr(growing_pictures, "_KEPT_S", 0.0)
    put(writer, "side", 4)
    for picture in first.pictures:
        assert not (tmp_path / PICTURES / picture.file).exists()
    assert all(file_so_far(tmp_path, name) for name in read_growing(tmp_path).files)


def test_only_whole_files_of_the_index_inside_the_folder_are_served(tmp_path: Path) -> None:
    result = tmp_path / "result"
    writer = GrowingPictures(result, is_simulated=True)
    put(writer, "top", 1)
    half, gone, linked = (picture.file for picture in read_growing(result).of_views[0].pictures)
    for name in (half, gone, linked):
        assert file_so_far(result, name) == result / PICTURES / name
    (result / PICTURES / half).write_bytes(PNG[:-5])
    (result / PICTURES / gone).unlink()
    (tmp_path / "secret.png").write_bytes(PNG)
    (result / PICTURES / linked).unlink()
    (result / PICTURES / linked).symlink_to(tmp_path / "secret.png")
    (result / PICTURES / "0a0a0a0a-other.png").write_bytes(PNG)
    for name in (half, gone, linked, "0a0a0a0a-other.png", "../../../secret.png", "pictures.json", ""):
        assert file_so_far(result, name) is None, name


def test_an_index_that_is_damaged_or_names_other_places_shows_nothing(tmp_path: Path) -> None:
    writer = GrowingPictures(tmp_path, is_simulated=True)
    put(writer, "top", 1)
    index = tmp_path / PICTURES / "pictures.json"
    text, name = index.read_text(), read_growing(tmp_path).of_views[0].pictures[0].file
    for wrong in (text[:-20], text.replace(name, "../../secret.png"), "[]", ""):
        index.write_text(wrong)
        assert read_growing(tmp_path).of_views == ()


def test_the_page_stays_when_pictures_are_replaced(tmp_path: Path) -> None:
    writer = GrowingPictures(tmp_path, is_simulated=True)
    name = writer.new_page()
    (writer.folder / name).write_text("<p>")
    page = PageSoFar(file=name, fitted_views=1, views=2, t="2026-01-01T00:00:00.000Z")
    writer.put_page(page)
    put(writer, "top", 1)
    assert read_growing(tmp_path).page == page
    assert file_so_far(tmp_path, name) == writer.folder / name
