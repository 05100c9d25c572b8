"""COLMAP's SQLite database, read and repaired with the standard library.

The parent process reads counts from it, and repairs what a killed worker left half-written.
Nothing here imports pycolmap.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import ResourceError, SplatError

_MAX_IMAGES = 2147483647  # COLMAP: pair id = first id x this + second id, first < second
_NO_DAMAGE = {  # primary result codes of SQLite that say nothing of the file
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_NOMEM,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_PERM,
}
_KEYPOINT = 4  # numbers per keypoint, see `features.sift_features`


def keypoint_counts(database: Path, photographs: int) -> list[int]:
    """[photographs] number of keypoints of each, by position in the capture (image id - 1)."""
    counts = [0] * photographs
    for image_id, rows in _selected(database, "image_id, rows FROM keypoints"):
        if 1 <= image_id <= photographs:
            counts[image_id - 1] = int(rows)
    return counts


def photographs_with_features(database: Path) -> set[int]:
    """Positions of photographs whose features are in the database."""
    return {image_id - 1 for (image_id,) in _selected(database, "image_id FROM descriptors")}


def inliers_of_pairs(database: Path) -> dict[tuple[int, int], int]:
    """Inliers by (first, second) position, of every pair that was matched and verified."""
    pairs = _selected(database, "pair_id, rows FROM two_view_geometries")
    return {
        (pair_id // _MAX_IMAGES - 1, pair_id % _MAX_IMAGES - 1): int(rows)
        for pair_id, rows in pairs
    }


def verified_pairs(database: Path) -> list[tuple[int, int, int, int]]:
    """(first, second, inliers, configuration) of every pair with inliers, by position.

    configuration: COLMAP's TwoViewGeometry: 2 calibrated, 3 uncalibrated, 4 planar, 5 panoramic,
    6 planar or panoramic, 7 watermark, 8 multiple.
    """
    what = "pair_id, rows, config FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id"
    return [
        (pair_id // _MAX_IMAGES - 1, pair_id % _MAX_IMAGES - 1, int(rows), int(config))
        for pair_id, rows, config in _selected(database, what)
    ]


def repair(database: Path) -> None:
    """Delete rows whose counterpart in another table a killed worker had not written yet.

    Raises sqlite3.DatabaseError if the file is no database.
    """
    halves = (
        ("keypoints", "descriptors", "image_id"),
        ("descriptors", "keypoints", "image_id"),
        ("matches", "two_view_geometries", "pair_id"),
        ("two_view_geometries", "matches", "pair_id"),
    )
    with closing(sqlite3.connect(database, timeout=30.0)) as connection:
        for table, other, key in halves:
            connection.execute(
                f"DELETE FROM {table} WHERE {key} NOT IN (SELECT {key} FROM {other})"
            )
        connection.commit()


def usable(database: Path, *dependents: Path) -> bool:
    """Whether the database is there and whole, after `repair`. If not, it is deleted, and the files
    `dependents` that tell what it holds with it.

    COLMAP does not wait for the disk, so a power cut can leave a database with missing pages.
    Raises SplatError "sfm-database-refused" where it may be whole and cannot be read or written.
    """
    if database.exists():
        try:
            repair(database)
            _check_pages(database)
            return True
        except sqlite3.DatabaseError as error:
            if getattr(error, "sqlite_errorcode", 0) & 0xFF in _NO_DAMAGE:
                raise _refused(database, error) from error
            delete(database)
    for path in dependents:
        path.unlink(missing_ok=True)
    return False


def _refused(database: Path, error: sqlite3.DatabaseError) -> SplatError:
    return ResourceError(
        "sfm-database-refused",
        given=f"{database} cannot be read or written now: {error}.",
        wanted="A database that no other program has open, on a disk with free space.",
        hint="Close programs that have it open, free some space, and run the same command again. "
        "If that does not help, delete the file.",
    )


def _check_pages(database: Path) -> None:
    """Raises sqlite3.DatabaseError if pages of the file are damaged."""
    with closing(_open_read_only(database)) as connection:
        found = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    if found != "ok":
        raise sqlite3.DatabaseError(found)


class StoredFeatures:
    """Reads features and matches from a database, from several threads at once.

    immutable: nothing writes to the database meanwhile, so it is read without locks (which network
    file systems may lack).
    """

    def __init__(self, database: Path, immutable: bool = False) -> None:
        self._lock = Lock()
        self._connection = _open_read_only(database, immutable, check_same_thread=False)

    def close(self) -> None:
        self._connection.close()

    def descriptors(self, position: int) -> NDArray[np.uint8]:
        """[N, 128] uint8, largest features first."""
        data = self._data("descriptors", "image_id", position + 1)
        return np.frombuffer(data or b"", np.uint8).reshape(-1, 128)

    def points(self, position: int) -> NDArray[np.float64]:
        """[N, 2] x, y of keypoints (pixels)."""
        data = self._data("keypoints", "image_id", position + 1)
        rows = np.frombuffer(data or b"", np.float32).reshape(-1, _KEYPOINT)
        return rows[:, :2].astype(np.float64)

    def matches(self, first: int, second: int) -> NDArray[np.uint32] | None:
        """[M, 2] indices of features that match; None if the pair was not matched yet."""
        data = self._data("matches", "pair_id", (first + 1) * _MAX_IMAGES + second + 1)
        return None if data is None else np.frombuffer(data, np.uint32).reshape(-1, 2)

    def _data(self, table: str, key: str, value: int) -> bytes | None:
        with self._lock:
            row = self._connection.execute(
                f"SELECT data FROM {table} WHERE {key} = ?", (value,)
            ).fetchone()
        return None if row is None else row[0] or b""


def delete(database: Path) -> None:
    """Remove the database and the files that SQLite keeps beside it."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        database.with_name(database.name + suffix).unlink(missing_ok=True)


def copy(source: Path, target: Path) -> None:
    """Copy a database that nothing writes to; the target appears when it is complete."""
    partial = target.with_name(target.name + ".partial")
    delete(partial)
    with closing(_open_read_only(source)) as old, closing(sqlite3.connect(partial)) as new:
        old.backup(new)
    delete(target)
    partial.replace(target)


def _selected(database: Path, what: str) -> list[tuple[int, ...]]:
    """The rows of a SELECT of integers."""
    with closing(_open_read_only(database)) as connection:
        return connection.execute(f"SELECT {what}").fetchall()


def _open_read_only(
    database: Path, immutable: bool = False, check_same_thread: bool = True
) -> sqlite3.Connection:
    how = "immutable=1" if immutable else "mode=ro"
    return sqlite3.connect(
        f"{database.absolute().as_uri()}?{how}",
        uri=True,
        timeout=5.0,
        check_same_thread=check_same_thread,
    )
