"""Features and matches found in shares: the same as found in one go, whoever does them."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from stages.structure import chunks
from stages.structure import database as sqlite
from stages.structure.chunks import Chunk
from stages.structure.job import Job, chunks_path, selected_pairs_path
from tests.structure import sample_jobs as jobs

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # a process for each share

PHOTOGRAPHS = 9
TABLES = ("cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries")


def rows(database: Path, table: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(database)) as connection:
        return connection.execute(f"SELECT * FROM {table} ORDER BY 1").fetchall()


def found(job: Job) -> dict[str, list[tuple[object, ...]]]:
    return {table: rows(Path(job.database), table) for table in TABLES}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """Features and matches found in one go."""
    job = jobs.sample_job(tmp_path_factory.mktemp("whole"), PHOTOGRAPHS)
    jobs.work(job)
    jobs.work(replace(job, step="matching"))
    return job


class Hands:
    """Does shares backwards, and is lost after so many (0: never). asked: the shares' names."""

    def __init__(self, lose: int = 0) -> None:
        self.lose, self.asked = lose, list[str]()

    def __call__(self, wanted: Sequence[Chunk], look: Callable[[], None]) -> None:
        for share in reversed(wanted):
            self.asked.append(share.out.stem)
            chunks.run_chunk(share)
            look()
            self.lose -= 1
            if self.lose == 0:
                raise KeyboardInterrupt


def in_shares(job: Job, executor: Hands) -> None:
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


def test_shares_find_what_one_process_finds(whole: Job, tmp_path: Path) -> None:
    job, executor = jobs.sample_job(tmp_path, PHOTOGRAPHS), Hands()
    in_shares(job, executor)
    assert found(job) == found(whole)
    assert len(executor.asked) == len(set(executor.asked)) > 3
    assert not list(chunks_path(job).glob("*.db"))


def test_finished_shares_are_kept_when_the_head_is_lost(whole: Job, tmp_path: Path) -> None:
    job, executor = jobs.sample_job(tmp_path, PHOTOGRAPHS), Hands(lose=1)
    for _ in range(2):  # among features, and among matches
        with pytest.raises(KeyboardInterrupt):
            in_shares(job, executor)
        executor.lose = 2
    in_shares(job, executor)
    assert found(job) == found(whole)
    assert len(executor.asked) == len(set(executor.asked))


def test_every_pair_and_known_matches_are_shared_too(whole: Job, tmp_path: Path) -> None:
    plain, shared = tmp_path / "plain.db", tmp_path / "shared.db"
    for path in (plain, shared):
        sqlite.copy(Path(whole.database), path)
        sqlite.delete_geometries(path)
    wanted = replace(whole, step="matching", matching="exhaustive", drop_stationary=True)
    jobs.work(replace(wanted, database=str(plain)))
    job = replace(wanted, database=str(shared), step="pair selection")
    jobs.work(job)
    assert chunks.match_pairs_in_chunks(job, Hands(), lambda: None) == 36
    jobs.work(job)
    assert selected_pairs_path(job).read_text() == "[]"
    assert found(job) == found(replace(job, database=str(plain)))


def test_a_share_that_is_done_is_not_done_again(whole: Job, tmp_path: Path) -> None:
    out = tmp_path / "pair-0-1.db"
    out.write_bytes(b"done")
    chunks.run_chunk(Chunk(tmp_path / "no job", out, pairs=((0, 1),)))
    assert out.read_bytes() == b"done"
