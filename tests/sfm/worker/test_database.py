"""What a killed worker leaves in COLMAP's database is repaired."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from stages.base.errors import ResourceError
from stages.sfm.worker import database as sqlite

PAIR = 2147483647


def make(path: Path) -> Path:
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(
            f"""
            CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER);
            CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY);
            CREATE TABLE matches (pair_id INTEGER PRIMARY KEY);
            CREATE TABLE two_view_geometries
                (pair_id INTEGER PRIMARY KEY, rows INTEGER, config INTEGER);
            INSERT INTO keypoints VALUES (1, 900), (2, 0), (3, 700);
            INSERT INTO descriptors VALUES (1), (2);
            INSERT INTO matches VALUES ({PAIR + 2}), ({PAIR + 3});
            INSERT INTO two_view_geometries VALUES ({PAIR + 2}, 44, 2), ({2 * PAIR + 3}, 9, 5);
            """
        )
    return path


def test_half_written_photographs_and_pairs_are_deleted(tmp_path: Path) -> None:
    path = make(tmp_path / "é #1.db")
    sqlite.repair(path)
    assert sqlite.keypoint_counts(path, 4) == [900, 0, 0, 0]
    assert sqlite.verified_pairs(path) == [(0, 1, 44, 2)]
    assert sqlite.photographs_with_features(path) == {0, 1}
    assert sqlite.inliers_of_pairs(path) == {(0, 1): 44}


def test_a_copy_holds_the_same(tmp_path: Path) -> None:
    path = make(tmp_path / "a.db")
    sqlite.copy(path, tmp_path / "b.db")
    assert sqlite.verified_pairs(tmp_path / "b.db") == sqlite.verified_pairs(path)


def test_a_file_that_is_no_database_raises_and_can_be_deleted(tmp_path: Path) -> None:
    garbage = tmp_path / "garbage.db"
    garbage.write_bytes(b"no database at all" * 100)
    with pytest.raises(sqlite3.DatabaseError):
        sqlite.repair(garbage)
    sqlite.delete(garbage)
    assert not garbage.exists()


@pytest.mark.parametrize("damage", ["garbage", "empty", "pages", "cut", "header", "missing"])
def test_a_damaged_database_takes_the_files_along_that_say_what_it_holds(
    tmp_path: Path, damage: str
) -> None:
    path, markers = make(tmp_path / "a.db"), [tmp_path / "a.done", tmp_path / "never.done"]
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE data (content BLOB)")
        connection.execute("INSERT INTO data VALUES (?)", (b"x" * 100_000,))
        connection.commit()
    markers[0].touch()
    assert sqlite.usable(path, *markers)
    assert path.exists()
    assert markers[0].exists()
    content = path.read_bytes()
    middle = len(content) - 50_000
    pages = content[:middle] + bytes(8192) + content[middle + 8192 :]
    damaged = {"garbage": b"no database" * 100, "empty": b"", "pages": pages}
    damaged |= {"cut": content[:middle], "header": content[:50]}
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(damaged[damage])
    assert not sqlite.usable(path, *markers)
    assert list(tmp_path.iterdir()) == []


def test_a_database_that_is_in_use_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, marker = make(tmp_path / "a.db"), tmp_path / "a.done"
    marker.touch()
    connect = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda name, **_: connect(name, timeout=0.0))
    with closing(connect(path)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(ResourceError, match="locked") as error:
            sqlite.usable(path, marker)
    assert error.value.code == "sfm-database-refused"
    assert marker.exists()
    assert sqlite.usable(path, marker)
