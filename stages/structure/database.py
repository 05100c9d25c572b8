"""COLMAP's SQLite database, seen through the standard library alone.

The parent process reads counts from it while the worker fills it, and repairs what a killed worker
left half-written. Nothing here imports pycolmap.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

_MAX_IMAGES = 2147483647  # COLMAP: pair id = first id x this + second id, first < second
_COUNTED = {"features": "descriptors", "matching": "two_view_geometries"}


def count_done(database: Path, step: str) -> int | None:
    """Photographs with features, or pairs matched and verified, about; None while it cannot be
    read.

    Looks without taking a lock: a worker that meets one when it opens the database gives up. What
    the worker has only written to SQLite's log is not counted yet.
    """
    if not database.exists():
        return None
    done = _count(database, _COUNTED[step])
    if done is None or step != "matching":
        return done
    return done + sum(_count(share, _COUNTED[step]) or 0 for share in shares(database))


def _count(database: Path, table: str) -> int | None:
    try:
        with closing(_open_without_lock(database)) as connection:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:
        return None


def keypoint_counts(database: Path, photographs: int) -> list[int]:
    """[photographs] keypoints of each, in order of the capture (image id - 1)."""
    counts = [0] * photographs
    with closing(_open_read_only(database)) as connection:
        for image_id, rows in connection.execute("SELECT image_id, rows FROM keypoints"):
            if 1 <= image_id <= photographs:
                counts[image_id - 1] = int(rows)
    return counts


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


def share_path(database: Path, number: int) -> Path:
    """Where the process with this number matches its pairs."""
    return database.with_name(f"{database.stem}.share-{number}.db")


def shares(database: Path) -> list[Path]:
    """The databases of such processes that are there."""
    return sorted(database.parent.glob(f"{database.stem}.share-*.db"))


def pairs_done(database: Path) -> set[tuple[int, int]]:
    """(first, second) ids of the pairs that were matched and verified."""
    with closing(_open_read_only(database)) as connection:
        rows = connection.execute("SELECT pair_id FROM two_view_geometries")
        return {(pair_id // _MAX_IMAGES, pair_id % _MAX_IMAGES) for (pair_id,) in rows}


def make_share(database: Path, share: Path, pairs: Sequence[tuple[int, int]]) -> None:
    """A database for matching `pairs`: cameras, the features of their photographs, and matches that
    are there without a geometry. Photographs are named by their ids, because COLMAP's lists of
    pairs have no place for names with spaces."""
    partial = share.with_name(share.name + ".partial")
    delete(partial)
    with closing(sqlite3.connect(partial)) as new:
        new.execute("ATTACH ? AS whole", (str(database),))
        schema = new.execute(
            "SELECT sql FROM whole.sqlite_master "
            "WHERE sql IS NOT NULL AND name NOT LIKE 'sqlite_%' ORDER BY type DESC"
        ).fetchall()  # tables before their indices
        for (sql,) in schema:
            new.execute(sql)
        version = new.execute("PRAGMA whole.user_version").fetchone()[0]
        new.execute(f"PRAGMA main.user_version = {version}")  # COLMAP's
        for table in ("rigs", "cameras", "frames", "frame_data"):
            new.execute(f"INSERT INTO {table} SELECT * FROM whole.{table}")
        new.execute(
            "INSERT INTO images (image_id, name, camera_id) "
            "SELECT image_id, CAST(image_id AS TEXT), camera_id FROM whole.images"
        )
        photographs = {(image_id,) for pair in pairs for image_id in pair}
        for table in ("keypoints", "descriptors"):
            query = f"INSERT INTO {table} SELECT * FROM whole.{table} WHERE image_id = ?"
            new.executemany(query, sorted(photographs))
        new.executemany(
            "INSERT INTO matches SELECT * FROM whole.matches WHERE pair_id = ?",
            [(first * _MAX_IMAGES + second,) for first, second in pairs],
        )
        new.commit()
    delete(share)
    partial.replace(share)


def merge(database: Path, share: Path) -> None:
    """Take over every pair that a share has matched and verified. Raises sqlite3.DatabaseError if
    the share is none."""
    with closing(sqlite3.connect(database, timeout=30.0)) as connection:
        connection.execute("ATTACH ? AS share", (str(share),))
        for table, other in (
            ("matches", "two_view_geometries"),
            ("two_view_geometries", "matches"),
        ):
            connection.execute(
                f"INSERT OR IGNORE INTO {table} SELECT * FROM share.{table} "
                f"WHERE pair_id IN (SELECT pair_id FROM share.{other})"
            )
        connection.commit()


def forget_geometries(database: Path) -> None:
    """Delete what verification found, and keep the matches that it started from."""
    with closing(sqlite3.connect(database, timeout=30.0)) as connection:
        connection.execute("DELETE FROM two_view_geometries")
        connection.commit()


def _open_read_only(database: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True, timeout=5.0)


def _open_without_lock(database: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
