"""COLMAP's SQLite database, seen through the standard library alone.

The parent process reads counts from it, and repairs what a killed worker left half-written.
Nothing here imports pycolmap.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from threading import Lock
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

_MAX_IMAGES = 2147483647  # COLMAP: pair id = first id x this + second id, first < second
_KEYPOINT = 4  # numbers of one, see `features.find`


def keypoint_counts(database: Path, photographs: int) -> list[int]:
    """[photographs] keypoints of each, in order of the capture (image id - 1)."""
    counts = [0] * photographs
    with closing(_open_read_only(database)) as connection:
        for image_id, rows in connection.execute("SELECT image_id, rows FROM keypoints"):
            if 1 <= image_id <= photographs:
                counts[image_id - 1] = int(rows)
    return counts


def photographs_with_features(database: Path) -> set[int]:
    """Positions of photographs whose features are there."""
    with closing(_open_read_only(database)) as connection:
        return {
            image_id - 1 for (image_id,) in connection.execute("SELECT image_id FROM descriptors")
        }


def inliers_of_pairs(database: Path) -> dict[tuple[int, int], int]:
    """Inliers by (first, second) position, of every pair that was matched and verified."""
    query = "SELECT pair_id, rows FROM two_view_geometries"
    with closing(_open_read_only(database)) as connection:
        return {
            (pair_id // _MAX_IMAGES - 1, pair_id % _MAX_IMAGES - 1): int(rows)
            for pair_id, rows in connection.execute(query)
        }


def verified_pairs(database: Path) -> list[tuple[int, int, int, int]]:
    """(first, second, inliers, configuration) of every pair with inliers, by position.

    configuration: COLMAP's TwoViewGeometry: 2 calibrated, 3 uncalibrated, 4 planar, 5 panoramic,
    6 planar or panoramic, 7 watermark, 8 multiple.
    """
    query = "SELECT pair_id, rows, config FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id"
    with closing(_open_read_only(database)) as connection:
        return [
            (pair_id // _MAX_IMAGES - 1, pair_id % _MAX_IMAGES - 1, int(rows), int(config))
            for pair_id, rows, config in connection.execute(query)
        ]


def repair(database: Path) -> None:
    """Delete rows whose counterpart a killed worker had no time to write.

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


class Features:
    """Features and matches in a database, for several threads at once. still: nobody writes to it
    now, so that machines which share its disk and no locks can read it."""

    def __init__(self, database: Path, still: bool = False) -> None:
        self._lock = Lock()
        self._connection = _open_read_only(database, still, check_same_thread=False)

    def __enter__(self) -> Features:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._connection.close()

    def descriptors(self, position: int) -> NDArray[np.uint8]:
        """[N, 128], largest features first."""
        data = self._data("descriptors", "image_id", position + 1)
        return np.frombuffer(data or b"", np.uint8).reshape(-1, 128)

    def points(self, position: int) -> NDArray[np.float64]:
        """[N, 2] x, y of features (pixels)."""
        data = self._data("keypoints", "image_id", position + 1)
        rows = np.frombuffer(data or b"", np.float32).reshape(-1, _KEYPOINT)
        return rows[:, :2].astype(np.float64)

    def matches(self, first: int, second: int) -> NDArray[np.uint32] | None:
        """[M, 2] rows of features that match, None where nobody has looked."""
        data = self._data("matches", "pair_id", (first + 1) * _MAX_IMAGES + second + 1)
        return None if data is None else np.frombuffer(data, np.uint32).reshape(-1, 2)

    def _data(self, table: str, key: str, value: int) -> bytes | None:
        with self._lock:
            row = self._connection.execute(
                f"SELECT data FROM {table} WHERE {key} = ?", (value,)
            ).fetchone()
        return None if row is None else row[0] or b""


def take_cameras(database: Path, source: Path) -> None:
    """Let the cameras of `database` be those of `source`, to which nobody writes."""
    with closing(_attached(database, source)) as connection, connection:
        connection.execute("DELETE FROM cameras")
        connection.execute("INSERT INTO cameras SELECT * FROM other.cameras")


def gather(database: Path, shares: Iterable[Path]) -> None:
    """Add the features and matches in `shares`, databases that nobody writes to; what was there
    stays. A share that is in is deleted."""
    for share in shares:
        with closing(_attached(database, share)) as connection, connection:
            for table in ("keypoints", "descriptors", "matches", "two_view_geometries"):
                connection.execute(f"INSERT OR IGNORE INTO {table} SELECT * FROM other.{table}")
        share.unlink()


def delete(database: Path) -> None:
    """Remove the database and what SQLite keeps beside it."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        database.with_name(database.name + suffix).unlink(missing_ok=True)


def copy(source: Path, target: Path) -> None:
    """A copy of a database that nobody writes to, made whole or not at all."""
    partial = target.with_name(target.name + ".partial")
    delete(partial)
    with closing(_open_read_only(source)) as old, closing(sqlite3.connect(partial)) as new:
        old.backup(new)
    delete(target)
    partial.replace(target)


def forget_geometries(database: Path) -> None:
    """Delete what verification found, and keep the matches that it started from."""
    with closing(sqlite3.connect(database, timeout=30.0)) as connection:
        connection.execute("DELETE FROM two_view_geometries")
        connection.commit()


def _attached(database: Path, other: Path) -> sqlite3.Connection:
    """A connection to `database`, with `other` for reading under the name "other"."""
    connection = sqlite3.connect(database.absolute().as_uri(), uri=True, timeout=30.0)
    connection.execute("ATTACH ? AS other", (f"{other.absolute().as_uri()}?immutable=1",))
    return connection


def _open_read_only(
    database: Path, still: bool = False, check_same_thread: bool = True
) -> sqlite3.Connection:
    how = "immutable=1" if still else "mode=ro"
    return sqlite3.connect(
        f"{database.absolute().as_uri()}?{how}",
        uri=True,
        timeout=5.0,
        check_same_thread=check_same_thread,
    )
