from __future__ import annotations

from pathlib import Path

import pytest

from probe2road.errors import OutputError
from probe2road.io.atomic import atomic_path


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def write_half(target: Path) -> None:
    with atomic_path(target) as temporary:
        temporary.write_text("half")
        temporary.with_name("roads.gpkg-journal").write_text("a library's side file")
        raise ZeroDivisionError


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_behind(tmp_path: Path) -> None:
    target = tmp_path / "roads.gpkg"
    target.write_text("old")
    with pytest.raises(ZeroDivisionError):
        write_half(target)
    assert target.read_text() == "old"
    assert names(tmp_path) == ["roads.gpkg"]


def test_a_complete_write_replaces_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "roads.osm.pbf"
    target.write_text("old")
    with atomic_path(target) as temporary:
        assert temporary.name == "roads.osm.pbf"
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert names(tmp_path) == ["roads.osm.pbf"]


def test_a_folder_is_replaced_as_a_whole(tmp_path: Path) -> None:
    target = tmp_path / "stages"
    target.mkdir()
    (target / "stale").touch()
    with atomic_path(target) as temporary:
        temporary.mkdir()
        (temporary / "fresh").touch()
    assert names(target) == ["fresh"]
    assert names(tmp_path) == ["stages"]


def test_a_file_never_replaces_a_folder_nor_a_folder_a_file(tmp_path: Path) -> None:
    folder, file = tmp_path / "folder", tmp_path / "file"
    folder.mkdir()
    file.touch()
    with pytest.raises(OutputError, match="is a folder, and a file would replace it"), atomic_path(folder) as temporary:
        temporary.touch()
    with pytest.raises(OutputError, match="is a file, and a folder would replace it"), atomic_path(file) as temporary:
        temporary.mkdir()
    assert names(tmp_path) == ["file", "folder"]


def test_a_missing_parent_is_named(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError, match=r"folder .*absent does not exist; create it first"),
        atomic_path(tmp_path / "absent" / "roads.gpkg"),
    ):
        pass
