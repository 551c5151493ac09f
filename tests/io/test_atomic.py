from __future__ import annotations

import contextlib
import itertools
from pathlib import Path

import pytest

from probe2road.errors import OutputError
from probe2road.io.atomic import atomic_path, atomic_paths, settled


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


def write_pair(folder: Path, text: str) -> None:
    with atomic_paths([folder / "roads.csv", folder / "turns.csv"]) as places:
        for place in places:
            place.write_text(text)


def killed_at_move(folder: Path, number: int, text: str, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Stop as a kill would, in the place of one of the renames; whether there are so many."""
    count = itertools.count()
    real = Path.replace

    def replace(path: Path, target: Path) -> Path:
        if next(count) == number:
            raise KeyboardInterrupt
        return real(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", replace)
        patch.setattr("shutil.rmtree", lambda *words, **options: None)
        with contextlib.suppress(KeyboardInterrupt):
            write_pair(folder, text)
            return False
    return True


def test_files_that_belong_together_are_all_old_or_all_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    for number in range(5):
        folder = tmp_path / str(number)
        folder.mkdir()
        write_pair(folder, "old")
        if not killed_at_move(folder, number, "new", monkeypatch):
            break
        texts = {settled(folder / name).read_text() for name in ("roads.csv", "turns.csv")}
        assert len(texts) == 1
        assert not list(folder.glob(".*.p2r-commit"))
        seen += texts
    assert seen == ["old", "new", "new"]


def test_a_folder_that_takes_no_changes_is_read_as_it_was_committed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_pair(tmp_path, "old")
    assert killed_at_move(tmp_path, 2, "new", monkeypatch)

    def refuse(path: Path, target: Path) -> Path:
        raise PermissionError(path)

    monkeypatch.setattr(Path, "replace", refuse)
    assert {settled(tmp_path / name).read_text() for name in ("roads.csv", "turns.csv")} == {"new"}
    assert (tmp_path / "turns.csv").read_text() == "old"


def test_a_sibling_that_is_not_written_is_gone_with_the_old_files(tmp_path: Path) -> None:
    write_pair(tmp_path, "old")
    with atomic_paths([tmp_path / "roads.csv", tmp_path / "turns.csv"]) as (roads, _):
        roads.write_text("new")
    assert names(tmp_path) == ["roads.csv"]
