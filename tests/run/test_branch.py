"""A run that begins as another one: what it shares, and that neither changes the other."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from stages.base.errors import SplatError
from stages.run.branch import branch
from stages.run.pipeline import Pipeline
from tests.run.fakes import CountSettings, fake_stages, photographs


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished run in the name of its folder "run", with 3 x 7000 counted letters."""
    folder = tmp_path / "run"
    Pipeline(folder, photographs(tmp_path / "photos"), fake_stages()).run()
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.mark.parametrize("links", [True, False])
def test_stages_whose_settings_stay_do_not_run_again_and_the_first_run_stays(
    run: Path, tmp_path: Path, monkeypatch, links: bool
) -> None:
    before = contents(run)
    if not links:  # as on a FAT or network disk

        def refuse(*_):
            raise PermissionError

        monkeypatch.setattr(os, "link", refuse)
    branch(run, tmp_path / "more" / "second")
    second = Pipeline(tmp_path / "more" / "second", stages=fake_stages())
    assert [step.will_run for step in second.plan()] == [False, False, False]
    second.run({"count": CountSettings(iterations=2)})
    assert second.load("count") == "12"
    assert second.recorded_photos() == tmp_path / "photos"
    assert contents(run) == before
    assert Pipeline(run, stages=fake_stages()).load("count") == "42000"


def test_a_file_of_the_users_own_is_copied(run: Path, tmp_path: Path) -> None:
    mine = run / "2-count" / "notes.txt"
    mine.write_text("mine")
    branch(run, tmp_path / "second")
    mine.write_text("changed")
    assert (tmp_path / "second" / "2-count" / "notes.txt").read_text() == "mine"


def test_links_of_others_stay_links(run: Path, tmp_path: Path) -> None:
    """They may lead nowhere, or to a folder that is large."""
    (tmp_path / "large").mkdir()
    links = {"nowhere": tmp_path / "missing", "away": tmp_path / "large"}
    for name, place in links.items():
        (run / "2-count" / name).symlink_to(place)
    branch(run, tmp_path / "second")
    for name, place in links.items():
        assert (tmp_path / "second" / "2-count" / name).readlink() == place


def test_a_run_among_the_photographs_is_refused(run: Path, tmp_path: Path) -> None:
    """Ingest would read its pictures."""
    with pytest.raises(SplatError) as caught:
        branch(run, tmp_path / "photos" / "second")
    assert caught.value.code == "run-folder-inside-photographs"
    assert not (tmp_path / "photos" / "second").exists()


def test_a_file_in_the_place_of_the_new_run_is_refused_and_stays(run: Path, tmp_path: Path) -> None:
    target = tmp_path / "notes"
    target.write_text("mine")
    with pytest.raises(SplatError) as caught:
        branch(run, target)
    assert caught.value.code == "run-folder-foreign"
    assert target.read_text() == "mine"


def test_a_damaged_run_leaves_no_half_of_the_new_one(run: Path, tmp_path: Path) -> None:
    (run / "1-copy" / "manifest.json").write_text("{")
    with pytest.raises(SplatError):
        branch(run, tmp_path / "second")
    assert {path.name for path in tmp_path.iterdir()} == {"photos", "run"}


def test_a_folder_with_other_things_is_refused_and_stays(run: Path, tmp_path: Path) -> None:
    target = tmp_path / "album"
    target.mkdir()
    (target / "a.jpg").write_text("one")
    with pytest.raises(SplatError) as caught:
        branch(run, target)
    assert caught.value.code == "run-folder-foreign"
    assert contents(target) == {"a.jpg": b"one"}


def test_a_folder_that_cannot_be_made_is_an_error_in_words(run: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SplatError) as caught:
        branch(run, tmp_path / "file" / "second")
    assert caught.value.code == "run-folder-unusable"


def test_a_disk_that_fills_leaves_nothing(run: Path, tmp_path: Path, monkeypatch) -> None:
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copytree", full)
    with pytest.raises(SplatError) as caught:
        branch(run, tmp_path / "second")
    assert caught.value.code == "disk-full"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos", "run"]
