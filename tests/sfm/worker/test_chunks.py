"""Features and matches in chunks: the same as from one process, in any order of chunks."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from stages.sfm.worker import chunks
from stages.sfm.worker import database as sqlite
from stages.sfm.worker.chunks import Chunk
from stages.sfm.worker.job import (
    Features,
    Matching,
    PairSelection,
    Project,
    chunks_path,
    selected_pairs_path,
)
from tests.sfm.worker import sample_jobs as jobs

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # a process for each chunk

PHOTOGRAPHS = 9
TABLES = ("cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries")


def rows(database: Path, table: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(database)) as connection:
        return connection.execute(f"SELECT * FROM {table} ORDER BY 1").fetchall()


def found(project: Project) -> dict[str, list[tuple[object, ...]]]:
    return {table: rows(project.database, table) for table in TABLES}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """Features and matches found by one process."""
    project = jobs.sample_project(tmp_path_factory.mktemp("whole"), PHOTOGRAPHS)
    jobs.work(Features(project, jobs.SIFT))
    jobs.work(Matching(project, "auto"))
    return project


class SerialExecutor:
    """Runs chunks in reverse order, and fails after some (0: never). names: of the chunks."""

    def __init__(self, fail_after: int = 0) -> None:
        self.fail_after, self.names = fail_after, list[str]()

    def __call__(self, wanted: Sequence[Chunk], on_chunk: Callable[[], None]) -> None:
        for chunk in reversed(wanted):
            self.names.append(chunk.out.stem)
            chunks.run_chunk(chunk)
            on_chunk()
            self.fail_after -= 1
            if self.fail_after == 0:
                raise KeyboardInterrupt


def run_in_chunks(project: Project, executor: SerialExecutor) -> None:
    features, matching = Features(project, jobs.SIFT), Matching(project, "auto")
    chunks.extract_features_in_chunks(features, executor, lambda: None)
    jobs.work(features)
    left = 1
    while left:
        jobs.work(PairSelection(project, "auto"))
        left = chunks.match_pairs_in_chunks(matching, executor, lambda: None)
    jobs.work(matching)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "PHOTOGRAPHS_PER_CHUNK", 6)
    monkeypatch.setattr(chunks, "PAIRS_PER_CHUNK", 20)


def test_chunks_find_what_one_process_finds(whole: Project, tmp_path: Path) -> None:
    project, executor = jobs.sample_project(tmp_path, PHOTOGRAPHS), SerialExecutor()
    run_in_chunks(project, executor)
    assert found(project) == found(whole)
    assert len(executor.names) == len(set(executor.names)) > 3
    assert not list(chunks_path(project.database).glob("*.db"))


def test_finished_chunks_are_kept_when_the_executor_fails(whole: Project, tmp_path: Path) -> None:
    project, executor = jobs.sample_project(tmp_path, PHOTOGRAPHS), SerialExecutor(fail_after=1)
    for _ in range(2):  # among features, and among matches
        with pytest.raises(KeyboardInterrupt):
            run_in_chunks(project, executor)
        executor.fail_after = 2
    run_in_chunks(project, executor)
    assert found(project) == found(whole)
    assert len(executor.names) == len(set(executor.names))


def test_exhaustive_pairs_and_known_matches_work_in_chunks(whole: Project, tmp_path: Path) -> None:
    alone = replace(whole, database=tmp_path / "alone.db")
    shared = replace(whole, database=tmp_path / "shared.db")
    for project in (alone, shared):
        sqlite.copy(whole.database, project.database)
        sqlite.delete_geometries(project.database)
    jobs.work(Matching(alone, "exhaustive", drop_stationary=True))
    jobs.work(PairSelection(shared, "exhaustive"))
    job = Matching(shared, "exhaustive", drop_stationary=True)
    assert chunks.match_pairs_in_chunks(job, SerialExecutor(), lambda: None) == 36
    jobs.work(PairSelection(shared, "exhaustive"))
    assert selected_pairs_path(shared.database).read_text() == "[]"
    assert found(shared) == found(alone)


def test_a_finished_chunk_is_not_run_again(whole: Project, tmp_path: Path) -> None:
    out = tmp_path / "pair-0-1.db"
    out.write_bytes(b"done")
    chunks.run_chunk(Chunk(tmp_path / "no job", out, pairs=((0, 1),)))
    assert out.read_bytes() == b"done"
