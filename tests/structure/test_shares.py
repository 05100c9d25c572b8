"""Pairs shared out to processes: all of them, once each, with the same result as in one process."""

from __future__ import annotations

import itertools
import shutil
import signal
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from threading import Event

import pytest

from stages.structure import database as sqlite
from stages.structure.job import CameraGuess, Job
from stages.structure.process import WorkerCrashed, crash_error, run_worker
from stages.structure.shares import pairs_path, split
from tests.structure.bad_captures import SAMPLE

PHOTOGRAPHS = 14  # 91 pairs: enough for three shares


@pytest.mark.parametrize("photographs", [2, 9, 64, 201])
@pytest.mark.parametrize("parts", [1, 2, 3, 8, 16])
def test_every_pair_is_in_one_share_and_shares_are_equal(photographs: int, parts: int) -> None:
    pairs = list(itertools.combinations(range(1, photographs + 1), 2))
    shares = split(pairs, parts)
    assert sorted(itertools.chain.from_iterable(shares)) == pairs
    sizes = [len(share) for share in shares]
    assert len(shares) <= parts
    assert max(sizes) - min(sizes) <= 1


def test_most_shares_of_many_need_only_some_of_the_photographs() -> None:
    shares = split(list(itertools.combinations(range(1, 201), 2)), 8)
    seen = [len({image for pair in share for image in pair}) for share in shares]
    assert sum(seen) < 0.75 * 8 * 200


def test_no_pairs_need_no_share() -> None:
    assert split([], 4) == []


@pytest.fixture(scope="module")
def features(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """Photographs whose names have spaces, with their features found."""
    folder = tmp_path_factory.mktemp("features")
    names = []
    for number, source in enumerate(sorted(SAMPLE.glob("*.jpg"))[:PHOTOGRAPHS]):
        names.append(f"é {number}.jpg")
        shutil.copy(source, folder / names[-1])
    job = Job(
        step="features",
        images_root=str(folder),
        database=str(folder / "base.db"),
        out="",
        progress="",
        names=tuple(names),
        camera_of=(0,) * len(names),
        cameras=(CameraGuess(640, 480, None),),
        max_features=800,
        threads=2,
    )
    work(job)
    return job


def work(job: Job) -> None:
    run_worker(job, Path(job.database).parent, Event(), 120.0, lambda: None)


def matching(features: Job, folder: Path, threads: int) -> Job:
    database = folder / "base.db"
    sqlite.copy(Path(features.database), database)
    return replace(features, step="matching", database=str(database), threads=threads)


def found(job: Job) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(job.database)) as connection:
        return [
            row
            for table in ("matches", "two_view_geometries")
            for row in connection.execute(f"SELECT * FROM {table} ORDER BY pair_id")
        ]


@pytest.fixture(scope="module")
def whole(features: Job, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[object, ...]]:
    """What one process finds."""
    job = matching(features, tmp_path_factory.mktemp("whole"), 1)
    work(job)
    return found(job)


def test_three_processes_find_what_one_finds(
    features: Job, whole: list[tuple[object, ...]], tmp_path: Path
) -> None:
    job = matching(features, tmp_path, 3)
    work(job)
    assert found(job) == whole
    assert len(whole) == 2 * 91
    assert sqlite.shares(Path(job.database)) == []


def test_what_a_killed_share_found_is_kept(
    features: Job, whole: list[tuple[object, ...]], tmp_path: Path
) -> None:
    job = matching(features, tmp_path, 2)
    database = Path(job.database)
    pairs = list(itertools.combinations(range(1, 9), 2))
    share = sqlite.share_path(database, 1)
    sqlite.make_share(database, share, pairs)
    pairs_path(share).write_text("".join(f"{a} {b}\n" for a, b in pairs))
    work(replace(job, step="share", database=str(share)))
    sqlite.share_path(database, 5).write_bytes(b"no database at all" * 100)
    assert sqlite.count_done(database, "matching") == len(pairs)

    with closing(sqlite3.connect(share)) as connection:  # marked, to know them again
        connection.execute("UPDATE two_view_geometries SET config = 7")
        connection.commit()
    work(job)
    marked = [row for row in found(job)[91:] if row[4] == 7]
    assert len(marked) == len(pairs)
    assert [row[:4] for row in found(job)] == [row[:4] for row in whole]
    assert sqlite.shares(database) == []


def test_matches_without_a_geometry_are_verified_and_not_matched_again(
    features: Job, whole: list[tuple[object, ...]], tmp_path: Path
) -> None:
    job = matching(features, tmp_path, 2)
    work(job)
    with closing(sqlite3.connect(job.database)) as connection:
        connection.execute("DELETE FROM two_view_geometries")
        connection.execute("UPDATE matches SET rows = 0, data = ''")
        connection.commit()
    work(job)
    assert len(found(job)) == len(whole)
    assert all(row[1] == 0 for row in found(job))


def test_a_share_that_fails_ends_the_work_with_its_words(features: Job, tmp_path: Path) -> None:
    job = matching(features, tmp_path, 2)
    with closing(sqlite3.connect(job.database)) as connection:
        connection.execute("UPDATE descriptors SET cols = 77 WHERE image_id = 3")
        connection.commit()
    with pytest.raises(WorkerCrashed) as crash:
        work(job)
    assert crash.value.step == "matching"
    assert crash.value.status == -signal.SIGABRT
    assert "Check failed" in crash_error(crash.value, tmp_path).given
