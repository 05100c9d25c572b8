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
from stages.sfm.worker.job import Job, chunks_path, selected_pairs_path
from tests.sfm.worker import sample_jobs as jobs

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # a process for each chunk

PHOTOGRAPHS = 9
TABLES = ("cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries")


def rows(database: Path, table: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(database)) as connection:
        return connection.execute(f"SELECT * FROM {table} ORDER BY 1").fetchall()


def found(job: Job) -> dict[str, list[tuple[object, ...]]]:
    return {table: rows(Path(job.database), table) for table in TABLES}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """Features and matches found by one process."""
    job = jobs.sample_job(tmp_path_factory.mktemp("whole"), PHOTOGRAPHS)
    jobs.work(job)
    jobs.work(replace(job, step="matching"))
    return job


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


def run_in_chunks(job: Job, executor: SerialExecutor) -> None:
    chunks.extract_features_in_chunks(job, executor, lambda: None)
    jobs.work(job)
    left = 1
    while left:
        jobs.work(replace(job, step="pair selection"))
        left = chunks.match_pairs_in_chunks(job, executor, lambda: None)
    jobs.work(replace(job, step="matching"))


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "PHOTOGRAPHS_PER_CHUNK", 6)
    monkeypatch.setattr(chunks, "PAIRS_PER_CHUNK", 20)


def test_chunks_find_what_one_process_finds(whole: Job, tmp_path: Path) -> None:
    job, executor = jobs.sample_job(tmp_path, PHOTOGRAPHS), SerialExecutor()
    run_in_chunks(job, executor)
    assert found(job) == found(whole)
    assert len(executor.names) == len(set(executor.names)) > 3
    assert not list(chunks_path(job).glob("*.db"))


def test_finished_chunks_are_kept_when_the_executor_fails(whole: Job, tmp_path: Path) -> None:
    job, executor = jobs.sample_job(tmp_path, PHOTOGRAPHS), SerialExecutor(fail_after=1)
    for _ in range(2):  # among features, and among matches
        with pytest.raises(KeyboardInterrupt):
            run_in_chunks(job, executor)
        executor.fail_after = 2
    run_in_chunks(job, executor)
    assert found(job) == found(whole)
    assert len(executor.names) == len(set(executor.names))


def test_exhaustive_pairs_and_known_matches_work_in_chunks(whole: Job, tmp_path: Path) -> None:
    plain, shared = tmp_path / "plain.db", tmp_path / "shared.db"
    for path in (plain, shared):
        sqlite.copy(Path(whole.database), path)
        sqlite.delete_geometries(path)
    wanted = replace(whole, step="matching", matching="exhaustive", drop_stationary=True)
    jobs.work(replace(wanted, database=str(plain)))
    job = replace(wanted, database=str(shared), step="pair selection")
    jobs.work(job)
    assert chunks.match_pairs_in_chunks(job, SerialExecutor(), lambda: None) == 36
    jobs.work(job)
    assert selected_pairs_path(job).read_text() == "[]"
    assert found(job) == found(replace(job, database=str(plain)))


def test_a_finished_chunk_is_not_run_again(whole: Job, tmp_path: Path) -> None:
    out = tmp_path / "pair-0-1.db"
    out.write_bytes(b"done")
    chunks.run_chunk(Chunk(tmp_path / "no job", out, pairs=((0, 1),)))
    assert out.read_bytes() == b"done"
