"""Features and matches of many photographs in shares, which others may do at the same time.

A share reads photographs, and features from the job's database, to which nobody writes meanwhile.
It leaves a database of its own in the work folder, whole or not at all; the next step of the job
takes it in. What comes of it does not depend on who did what: each photograph and each pair is
found for itself, under words that are made once.
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
from typing import TYPE_CHECKING

from stages.base import threads
from stages.base.blocks import blocks
from stages.structure import database as sqlite
from stages.structure.job import Job, chunks_path, selected_pairs_path
from stages.structure.process import WorkerCrashed, crash_error, run_worker

if TYPE_CHECKING:
    from stages.structure.pairs import Pair

PHOTOGRAPHS_PER_CHUNK, PAIRS_PER_CHUNK = 16, 128  # in a share: some seconds of one core
CHUNK_MEMORY_MIB = (
    2560.0  # sorted features of so many photographs, or the pictures they are found in
)
_MOST_S = 7 * 86400.0  # who hands shares out looks at the clock


@dataclass(frozen=True)
class Chunk:
    """job: file of the whole job. out: the database to leave. photographs, or pairs: positions."""

    job: Path
    out: Path
    photographs: tuple[int, ...] = ()
    pairs: tuple[Pair, ...] = ()


ChunkExecutor = Callable[[Sequence[Chunk], Callable[[], None]], None]
"""Does shares to their ends, in any order, and calls the second each time that one ends. Raises as
`do` and as the second, and Interrupted."""


def extract_features_in_chunks(job: Job, executor: ChunkExecutor, look: Callable[[], None]) -> None:
    """Have the features found that neither the job's database nor a finished share holds."""
    have: set[int] = set()
    for database in (Path(job.database), *chunks_path(job).glob("*.db")):
        if database.exists():
            have |= sqlite.photographs_with_features(database)
    missing = [position for position in range(len(job.names)) if position not in have]
    file, folder = _written(job)
    parts = (tuple(missing[part]) for part in blocks(len(missing), PHOTOGRAPHS_PER_CHUNK))
    executor([Chunk(file, folder / f"photograph-{p[0]}.db", p) for p in parts], look)


def match_pairs_in_chunks(job: Job, executor: ChunkExecutor, look: Callable[[], None]) -> int:
    """Have the pairs matched that the step "choosing" chose; how many they are."""
    chosen = [(first, second) for first, second in json.loads(selected_pairs_path(job).read_text())]
    file, folder = _written(job)
    parts = (tuple(chosen[part]) for part in blocks(len(chosen), PAIRS_PER_CHUNK))
    executor([Chunk(file, folder / f"pair-{p[0][0]}-{p[0][1]}.db", pairs=p) for p in parts], look)
    return len(chosen)


def _written(job: Job) -> tuple[Path, Path]:
    """(the job's file, the folder for its shares), at paths that mean the same everywhere."""
    whole = replace(job, database=str(Path(job.database).absolute()))
    folder = chunks_path(whole)
    folder.mkdir(exist_ok=True)
    return whole.write(folder / "job.json"), folder


def run_chunk(share: Chunk) -> None:
    """Do a share, unless it is done, in a worker process. Raises SplatError."""
    if share.out.exists():
        return
    job = Job.read(share.job)
    # Beside the others' and not where they are: a share that seemed lost may be done twice at once.
    folder = Path(tempfile.mkdtemp(prefix=f"{share.out.stem}-", dir=share.out.parent))
    part = replace(
        job,
        step="features share" if share.photographs else "matching share",
        source=job.database,
        database=str(folder / "share.db"),
        progress=str(folder / "progress.json"),
        threads=threads.count(),
        photographs=share.photographs,
        pairs=share.pairs,
    )
    try:
        run_worker(part, folder, Event(), _MOST_S, lambda: None)
    except WorkerCrashed as crash:
        raise crash_error(crash, folder) from crash
    os.replace(part.database, share.out)
    shutil.rmtree(folder, ignore_errors=True)
