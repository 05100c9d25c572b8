"""What cannot be combined with --blocks, and what takes it back from a run."""

from __future__ import annotations

import re
import shlex
import socket
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from splatcli import input_files, run_settings
from stages.distributed import blocks, cluster
from stages.run import pipeline

BLOCKS = ("run", "--blocks", "2", "--max-splats", "1000")


@pytest.fixture
def trained_blocks(splat: Any, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of blocks of the trainings in blocks that began."""
    began: list[int] = []

    class Training:
        def __init__(self, *given: object) -> None: ...

        def train(self, count: int, seeds: object, folder: Path) -> None:
            (folder / "out.ply").write_text("made")
            began.append(count)

    monkeypatch.setattr(blocks, "_BlockTraining", Training)
    monkeypatch.setattr(blocks, "_with_roles", lambda whole: whole)
    sfm = SimpleNamespace(views=())
    stages = [
        replace(stage, load=lambda folder: sfm) if stage.name == "sfm" else stage
        for stage in vars(pipeline)["STAGES"]
    ]
    monkeypatch.setattr(pipeline, "STAGES", tuple(stages))
    return began


@pytest.mark.parametrize(
    ("given", "unset"),
    [
        (("--seconds", "60"), "--seconds 0"),
        (("--within", "-1", "-1", "1", "1"), "--within 0 0 0 0"),
        (("--refine-in-training",), "--no-refine-in-training"),
        (("--splats", "given.ply"), '--splats ""'),
        (
            ("--within", "-1", "-1", "1", "1", "--splats", "given.ply"),
            '--within 0 0 0 0 --splats ""',
        ),
    ],
)
def test_what_blocks_refuse_is_taken_back_as_the_hint_says(
    splat, trained_blocks, monkeypatch, given, unset
) -> None:
    monkeypatch.setattr(input_files, "check_files", lambda settings: None)  # of --splats
    Path("given.ply").write_text("given")
    command = "process" if "--splats" in given else "train"
    splat("process", "photos")
    result = splat(command, "run", *given)
    assert result.exit_code == 0, result.output
    refused = splat(command, *BLOCKS)
    assert refused.exit_code == 2
    assert "blocks-without-end" in refused.stderr
    names = " and ".join(re.findall("--[a-z-]+", " ".join(given)))
    assert f"--blocks cannot be combined with {names}." in refused.stderr
    where = "`splat process`" if command == "process" else "the command"
    assert f"Add `{unset}` to {where}." in " ".join(refused.stderr.split())
    assert trained_blocks == []
    again = splat(command, *BLOCKS, *shlex.split(unset))
    assert again.exit_code == 0, again.output
    assert trained_blocks == [2]


def test_a_cluster_without_blocks_is_said_to_be_unused(splat) -> None:
    result = splat("process", "photos", "--cluster", "elsewhere:6379")
    assert result.exit_code == 0
    assert "cluster-unused" in result.stderr
    assert "cluster-unused" not in splat("process", "photos").stderr


def test_what_blocks_refuse_is_refused_before_the_first_stage(splat) -> None:
    given = ("--blocks", "2", "--max-splats", "1000", "--seconds", "60")
    result = splat("process", "photos", *given)
    assert result.exit_code == 2
    assert "blocks-without-end" in result.stderr
    assert not Path("run").exists()


def test_an_address_where_no_cluster_answers_is_refused_before_the_first_stage(
    splat, monkeypatch
) -> None:
    monkeypatch.setattr(cluster, "_ray", lambda: None)  # as if Ray were installed
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    given = ("--blocks", "2", "--max-splats", "1000", "--cluster", f"127.0.0.1:{port}")
    result = splat("process", "photos", *given)
    assert result.exit_code == 2
    assert "cluster-not-found" in result.stderr
    assert not Path("run").exists()


@pytest.mark.parametrize("corners", ["1 1 -1 -1", "0 0 0 1", "0 1 1 1", "1 0 0 1"])
def test_a_rectangle_without_an_area_is_refused(splat, corners: str) -> None:
    splat("process", "photos")
    result = splat("train", "run", "--within", *corners.split())
    assert result.exit_code == 2
    assert "option-value" in result.stderr
    assert f"--within {corners} cannot be used." in result.stderr


def test_no_rectangle_is_none(splat) -> None:
    splat("process", "photos")
    for given, recorded in (("-1 -2 3 4", (-1.0, -2.0, 3.0, 4.0)), ("0 0 0 0", ())):
        assert splat("train", "run", "--within", *given.split()).exit_code == 0
        settings = run_settings.recorded(pipeline.Pipeline(Path("run")))
        assert settings["train"].within == recorded
