"""Pairs matched and verified: the same by any number of threads and after any interruption."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from stages.sfm.worker import database as sqlite
from stages.sfm.worker.job import Features, Matching, Project
from stages.sfm.worker.pairs import exhaustive_pairs
from stages.sfm.worker.progress import read_progress
from tests.sfm.worker import sample_jobs as jobs

PHOTOGRAPHS = 9

Rows = list[tuple[object, ...]]


@pytest.fixture(scope="module")
def features(tmp_path_factory: pytest.TempPathFactory) -> Project:
    project = jobs.sample_project(tmp_path_factory.mktemp("features"), PHOTOGRAPHS)
    jobs.work(Features(project, jobs.SIFT))
    return project


def matching(features: Project, folder: Path, how: str, threads: int = 2) -> Matching:
    database = folder / "base.db"
    sqlite.copy(features.database, database)
    return Matching(replace(features, database=database, threads=threads), how)


def found(job: Matching, table: str) -> Rows:
    with closing(sqlite3.connect(job.project.database)) as connection:
        return connection.execute(f"SELECT * FROM {table} ORDER BY pair_id").fetchall()


@pytest.fixture(scope="module")
def whole(features: Project, tmp_path_factory: pytest.TempPathFactory) -> tuple[Rows, Rows]:
    """What one thread finds."""
    job = matching(features, tmp_path_factory.mktemp("whole"), "exhaustive", 1)
    jobs.work(job)
    return found(job, "matches"), found(job, "two_view_geometries")


@pytest.mark.slow
def test_three_threads_find_what_one_finds(
    features: Project, whole: tuple[Rows, Rows], tmp_path: Path
) -> None:
    job = matching(features, tmp_path, "exhaustive", 3)
    jobs.work(job)
    assert (found(job, "matches"), found(job, "two_view_geometries")) == whole
    assert len(whole[0]) == len(exhaustive_pairs(PHOTOGRAPHS))
    assert read_progress(job.project.database) == ("matching", 36, 36)


@pytest.mark.slow
def test_what_was_found_before_is_kept_and_the_missing_added(
    features: Project, whole: tuple[Rows, Rows], tmp_path: Path
) -> None:
    job = matching(features, tmp_path, "auto")
    jobs.work(job)
    chosen = found(job, "two_view_geometries")
    assert len(chosen) >= PHOTOGRAPHS - 1
    assert set(chosen) <= set(whole[1])
    with closing(sqlite3.connect(job.project.database)) as connection:  # marked, to know them again
        connection.execute("UPDATE two_view_geometries SET config = 7")
        connection.execute("DELETE FROM matches WHERE pair_id % 3 = 0")
        connection.execute("DELETE FROM two_view_geometries WHERE pair_id % 3 = 0")
        connection.commit()
        kept = connection.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0]
    jobs.work(replace(job, how="exhaustive"))
    now = found(job, "two_view_geometries")
    assert len(now) == len(whole[1])
    assert sum(row[4] == 7 for row in now) == kept
    assert [row[:4] for row in now] == [row[:4] for row in whole[1]]
    assert found(job, "matches") == whole[0]


def test_photographs_without_features_match_nothing(features: Project, tmp_path: Path) -> None:
    job = matching(features, tmp_path, "auto")
    with closing(sqlite3.connect(job.project.database)) as connection:
        for table in ("keypoints", "descriptors"):
            connection.execute(f"UPDATE {table} SET rows = 0, data = '' WHERE image_id = 4")
        connection.commit()
    jobs.work(job)
    inliers = sqlite.inliers_of_pairs(job.project.database)
    assert {pair for pair in inliers if 3 in pair} == {
        p for p in exhaustive_pairs(PHOTOGRAPHS) if 3 in p
    }
    assert all(count == 0 for pair, count in inliers.items() if 3 in pair)
