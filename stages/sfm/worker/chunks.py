"""Features and matches of many photographs in chunks, which an executor may run on other machines.

A chunk reads photographs, and features from the job's database, which stays unchanged while chunks
run. It writes a database of its own to the work folder, completely or not at all, and the next step
of the job merges that. The result does not depend on who ran which chunk: each photograph and each
pair is processed independently, with a vocabulary that is built once.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event

from stages.base import threads
from stages.base.blocks import blocks
from stages.sfm.worker import database as sqlite
from stages.sfm.worker.job import (
    Features,
    FeaturesChunk,
    Job,
    Matching,
    MatchingChunk,
    chunks_path,
    selected_pairs_path,
)
from stages.sfm.worker.pairs import Pair
from stages.sfm.worker.process import run_worker

PHOTOGRAPHS_PER_CHUNK, PAIRS_PER_CHUNK = 16, 128  # some seconds of one core
CHUNK_MEMORY_MIB = 2560.0  # the pictures of one chunk, or the indexed features that it matches
_MAX_SECONDS = 7 * 86400.0  # the process that submits chunks checks the deadline


@dataclass(frozen=True)
class Chunk:
    """Some photographs or pairs of a job.

    Args:
        job: file of the whole job, `Features` or `Matching`.
        out: the database to write.
        photographs: positions of photographs, for features.
        pairs: pairs of positions of photographs, for matching.
    """

    job: Path
    out: Path
    photographs: tuple[int, ...] = ()
    pairs: tuple[Pair, ...] = ()


ChunkExecutor = Callable[[Sequence[Chunk], Callable[[], None]], None]
"""Runs chunks (`run_chunk`) in any order, and calls its second argument after each. Exceptions of
either pass through; raises Interrupted when it is stopped."""


def extract_features_in_chunks(
    job: Features, executor: ChunkExecutor, on_chunk: Callable[[], None]
) -> None:
    """Extract the features that neither the database nor a finished chunk holds."""
    have: set[int] = set()
    for database in (job.project.database, *chunks_path(job.project.database).glob("*.db")):
        if database.exists():
            have |= sqlite.photographs_with_features(database)
    photographs = range(len(job.project.photographs))
    missing = [position for position in photographs if position not in have]
    file, folder = _write_job(job)
    parts = (tuple(missing[part]) for part in blocks(len(missing), PHOTOGRAPHS_PER_CHUNK))
    executor([Chunk(file, folder / f"photograph-{p[0]}.db", p) for p in parts], on_chunk)


def match_pairs_in_chunks(
    job: Matching, executor: ChunkExecutor, on_chunk: Callable[[], None]
) -> int:
    """Match the pairs that the step "pair selection" selected; returns how many these are."""
    selected = json.loads(selected_pairs_path(job.project.database).read_text())
    pairs = [(first, second) for first, second in selected]
    file, folder = _write_job(job)
    parts = (tuple(pairs[part]) for part in blocks(len(pairs), PAIRS_PER_CHUNK))
    names = ((f"pair-{p[0][0]}-{p[0][1]}.db", p) for p in parts)
    executor([Chunk(file, folder / name, pairs=p) for name, p in names], on_chunk)
    return len(pairs)


def _write_job(job: Job) -> tuple[Path, Path]:
    """(the file of the job, the folder of its chunks), with absolute paths."""
    database = job.project.database.absolute()
    job = replace(job, project=replace(job.project, database=database))
    folder = chunks_path(database)
    folder.mkdir(exist_ok=True)
    return job.write(folder / "job.json"), folder


def run_chunk(chunk: Chunk) -> None:
    """Run a chunk in a worker process, unless its database exists. Raises SplatError."""
    if chunk.out.exists():
        return
    job: Features | Matching = Job.read(chunk.job)
    # A folder of its own: a chunk that seemed lost may run twice at once.
    folder = Path(tempfile.mkdtemp(prefix=f"{chunk.out.stem}-", dir=chunk.out.parent))
    project = replace(job.project, database=folder / "chunk.db", threads=threads.count())
    part: Job
    if isinstance(job, Features):
        part = FeaturesChunk(project, job.sift, chunk.photographs)
    else:
        source = job.project.database
        part = MatchingChunk(project, source, chunk.pairs, job.drop_stationary)
    run_worker(part, folder, Event(), _MAX_SECONDS, lambda: None)
    os.replace(project.database, chunk.out)
    shutil.rmtree(folder, ignore_errors=True)
