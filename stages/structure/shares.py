"""Matching in several processes of one thread each, in the worker process.

COLMAP's threads that build their search indices at the same time now and then build wrong ones: in
one of some hundred runs all matches of two photographs, one a thread, were others. So no process
has two such threads, and cores are used by processes instead: each matches a share of the pairs in
a database of its own, and what it found is put together afterwards. What a killed share found is
kept.
"""

from __future__ import annotations

import contextlib
import math
import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from stages.structure import database as sqlite
from stages.structure.job import Job

Pair = tuple[int, int]

_FEWEST_PAIRS = 40  # a process: starting one takes as long as matching about ten
_POLL_SECONDS = 0.05


def split(pairs: Sequence[Pair], parts: int) -> list[list[Pair]]:
    """`pairs` of image ids in at most `parts` shares of equal length.

    Pairs among the same photographs come into the same share, so that few photographs are indexed
    in more than one.
    """
    parts = min(parts, math.ceil(len(pairs) / _FEWEST_PAIRS))
    if not parts:
        return []
    blocks = max(2, round(math.sqrt(2 * parts)))
    side = max(1, math.ceil(max(max(pair) for pair in pairs) / blocks))
    ordered = sorted(pairs, key=lambda pair: (pair[0] // side, pair[1] // side, pair))
    cuts = [len(ordered) * part // parts for part in range(parts + 1)]
    return [ordered[cuts[part] : cuts[part + 1]] for part in range(parts)]


def match_in_shares(job: Job, wanted: Sequence[Pair], processes: int) -> None:
    """Match and verify those of the `wanted` pairs (first < second) that the job's database does
    not hold. Ends this process as a share ends that fails."""
    database = Path(job.database)
    _gather(database)
    done = sqlite.pairs_done(database)
    shares = []
    for number, pairs in enumerate(split([p for p in wanted if p not in done], processes)):
        share = sqlite.share_path(database, number)
        sqlite.make_share(database, share, pairs)
        # In a share a photograph's name is its id.
        pairs_path(share).write_text("".join(f"{first} {second}\n" for first, second in pairs))
        shares.append(replace(job, step="share", database=str(share)))
    _run_all(shares)
    _gather(database)


def pairs_path(share: Path) -> Path:
    """The list of a share's pairs, a line each."""
    return share.with_suffix(".txt")


def _gather(database: Path) -> None:
    """Take over what shares found, also those of a worker that was killed."""
    for share in sqlite.shares(database):
        with contextlib.suppress(sqlite3.DatabaseError):  # what cannot be read is matched again
            sqlite.merge(database, share)
        sqlite.delete(share)
        pairs_path(share).unlink(missing_ok=True)


def _run_all(jobs: list[Job]) -> None:
    running = [_start(job) for job in jobs]
    try:
        while running:
            time.sleep(_POLL_SECONDS)
            for process in running:
                if process.poll():
                    _end_like(process.returncode)
            running = [process for process in running if process.poll() is None]
    finally:
        for process in running:
            process.kill()


def _end_like(status: int) -> None:
    """End as a share did, by its signal if it was one; its words are in the log, which all share,
    and the other shares end with this process."""
    if status < 0:
        os.kill(os.getpid(), -status)
    raise SystemExit(status)


def _start(job: Job) -> subprocess.Popen[bytes]:
    """A share's process. It ends with this one, which holds its standard input."""
    path = job.write(Path(job.database).with_suffix(".json"))
    command = [sys.executable, "-P", "-m", "stages.structure.worker", str(path)]
    return subprocess.Popen(command, stdin=subprocess.PIPE)
