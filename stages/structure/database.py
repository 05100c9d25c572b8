"""COLMAP's SQLite database, seen through the standard library alone.

The parent process reads counts from it, and repairs what a killed worker left half-written.
Nothing here imports pycolmap.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

_MAX_IMAGES = 2147483647  # COLMAP: pair id = first id x this + second id, first < second


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


def _open_read_only(database: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True, timeout=5.0)
