"""Runs of the sfm stage that end too early, and how to compare what they leave."""

from __future__ import annotations

import hashlib
from pathlib import Path
from threading import Event

import pytest

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.scene import Capture
from stages.sfm import stage as sfm
from stages.sfm.settings import SfmSettings


def digests(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def interrupted(capture: Capture, folder: Path, settings: SfmSettings) -> None:
    """Stop the stage when it begins to match."""
    report = Report()
    report.stop_requested = Event()
    report.listener = lambda label, done, total, numbers: (
        report.stop_requested.set() if label == "matching" else None
    )
    with pytest.raises(Interrupted):
        sfm.run({"ingest": capture}, settings, folder, report)


def damage_database(path: Path, how: str) -> None:
    """What a power cut leaves, since COLMAP does not wait for the disk."""
    content = path.read_bytes()
    assert len(content) > 65536
    path.write_bytes(b"" if how == "empty" else bytes(8192) + content[8192:])
