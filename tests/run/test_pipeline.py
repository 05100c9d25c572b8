"""What runs, what is skipped, what is said about it, and what survives a failure."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from stages import formats
from stages.base.errors import Family, Interrupted, SplatError
from stages.base.memory import resident_mib
from stages.base.stage import Earlier
from stages.cameras import nerfstudio
from stages.run import manifest
from stages.run.failures import as_splat_error
from stages.run.listener import Listener
from stages.run.lock import HOLDER, locked
from stages.run.manifest import SCHEMA, Manifest, read_sealed
from stages.run.pipeline import Pipeline
from stages.run.runfile import RunFile
from stages.run.runfolder import is_run_folder
from stages.scene.storage import load_splats
from tests.run.fakes import CopySettings, CountSettings, SignSettings, fake_stages, photographs


class Heard(Listener):
    def __init__(self) -> None:
        self.events: list[tuple[str, str]] = []

    def started(self, stage, number, reason, resumed) -> None:
        self.events.append(("resumed" if resumed else "started", stage.name))

    def skipped(self, stage, number, manifest) -> None:
        self.events.append(("skipped", stage.name))

    def ran(self) -> list[str]:
        return [name for kind, name in self.events if kind != "skipped"]


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return photographs(tmp_path / "photos")


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    return tmp_path / "run"


@pytest.fixture
def finished(photos: Path, run_folder: Path) -> Pipeline:
    pipeline = Pipeline(run_folder, photos, fake_stages())
    pipeline.run()
    return pipeline


def ran(pipeline: Pipeline, settings=None) -> list[str]:
    heard = Heard()
    pipeline.run(settings, listener=heard)
    return heard.ran()


def reasons(pipeline: Pipeline, settings=None) -> dict[str, str]:
    return {step.stage.name: step.reason for step in pipeline.plan(settings)}


def test_run_makes_one_finished_folder_a_stage(finished: Pipeline, run_folder: Path) -> None:
    assert sorted(p.name for p in run_folder.iterdir() if not p.name.startswith(".")) == [
        "1-copy",
        "2-count",
        "3-sign",
        "run.json",
    ]
    assert finished.load("sign") == "42000 a b"
    assert not list(run_folder.glob(".*.partial"))


def test_manifest_says_what_was_made_from_what(finished: Pipeline, run_folder: Path) -> None:
    copied, counted = finished.manifest("copy"), finished.manifest("count")
    assert copied
    assert counted
    assert counted.inputs == {"copy": copied.output_digest}
    assert counted.settings == {"iterations": 7000, "seed": 0, "tool": "pen"}
    assert counted.seed == 0
    assert counted.warnings == [["count-low", "Few letters. Write more."]]
    assert set(copied.input_files["photos"]) == {"a.jpg", "b.jpg"}
    assert set(copied.outputs) == {"text/all.txt"}
    assert copied.metrics == {"characters": 6}
    assert 0.5 * resident_mib() < copied.peak_memory_mib < 100_000
    assert copied.libraries["python"]
    # from `printf onetwo | sha256sum`
    assert copied.outputs["text/all.txt"].sha256 == (
        "25b6746d5172ed6352966a013d93ac846e1110d5a25e8f183b5931f4688842a1"
    )


def test_manifest_says_how_long_its_stage_took(photos: Path, run_folder: Path) -> None:
    def slow(inputs, settings, folder, report) -> None:
        time.sleep(0.05)
        (folder / "count.txt").write_text("7")

    begun = time.monotonic()
    pipeline = Pipeline(run_folder, photos, fake_stages(count=slow))
    copied, counted, _ = pipeline.run()
    assert counted.seconds >= 0.05
    assert copied.seconds > 0
    # each rounded to milliseconds
    assert copied.seconds + counted.seconds <= time.monotonic() - begun + 0.001


def test_nothing_runs_twice(finished: Pipeline) -> None:
    assert ran(finished) == []
    assert all(not step.will_run for step in finished.status())


def test_changed_setting_runs_its_stage_and_those_after_it(finished: Pipeline) -> None:
    settings = {"count": CountSettings(iterations=30000)}
    assert reasons(finished, settings) == {
        "copy": "",
        "count": "iterations 7000 -> 30000",
        "sign": "count runs again first",
    }
    assert ran(finished, settings) == ["count", "sign"]


def test_a_stage_gets_its_earlier_output_where_only_the_setting_that_adds_to_it_changed(
    photos: Path, run_folder: Path
) -> None:
    seen: list[Earlier | None] = []

    def sign(inputs, settings, folder, report) -> None:
        seen.append(report.earlier)
        (folder / "signed.txt").write_text(" ".join(settings.names))

    copy, count, last = fake_stages(sign=sign)
    pipeline = Pipeline(run_folder, photos, [copy, count, dataclasses.replace(last, adds="names")])
    pipeline.run()
    pipeline.run({"sign": SignSettings(names=("a", "b", "c"))})
    pipeline.run({"count": CountSettings(iterations=5)})
    flip_bit(run_folder / "3-sign" / "signed.txt")
    pipeline.run({"sign": SignSettings(names=("a",))})
    first, added, other_input, damaged = seen
    assert first is None
    assert damaged is None
    assert added
    assert added.folder == run_folder / "3-sign"
    assert added.settings == {"names": ["a", "b"]}
    assert added.same_inputs == {"count"}
    assert other_input
    assert not other_input.same_inputs
    newer = dataclasses.replace(last, adds="names", version=2)
    Pipeline(run_folder, photos, [copy, count, newer]).run()
    assert seen[-1] is None


def test_settings_are_remembered(finished: Pipeline, run_folder: Path) -> None:
    finished.run({"count": CountSettings(iterations=5)})
    again = Pipeline(run_folder, stages=fake_stages())
    assert ran(again) == []
    assert again.load("count") == "30"


def test_setting_that_cannot_change_the_output_is_no_reason(finished: Pipeline) -> None:
    assert ran(finished, {"copy": CopySettings(threads=8)}) == []


def test_edited_photograph_is_named(finished: Pipeline, photos: Path) -> None:
    (photos / "a.jpg").write_text("six")
    assert reasons(finished)["copy"] == "photograph a.jpg changed"
    assert ran(finished) == ["copy", "count"]  # as many letters as before: sign has nothing to do


def test_added_and_removed_photographs_are_named(finished: Pipeline, photos: Path) -> None:
    (photos / "b.jpg").unlink()
    (photos / "c.jpg").write_text("x")
    assert reasons(finished)["copy"] == "photograph b.jpg is missing, photograph c.jpg is new"


@dataclasses.dataclass(frozen=True)
class WithDepth(CopySettings):
    depth: Path | None = dataclasses.field(default=None, metadata={"help": "maps"})


def test_each_of_several_depth_maps_of_one_name_is_a_reason(
    photos: Path, run_folder: Path, tmp_path: Path
) -> None:
    frames = []
    for camera in ("left", "right"):
        (tmp_path / "maps" / camera).mkdir(parents=True)
        (tmp_path / "maps" / camera / "1.png").write_text(camera)
        frames.append({"file_path": camera, "depth_file_path": f"{camera}/1.png"})
    file = tmp_path / "maps" / "transforms.json"
    file.write_text(json.dumps({"frames": frames}))
    stages = fake_stages()
    stages[0] = dataclasses.replace(stages[0], settings_type=WithDepth)
    pipeline = Pipeline(run_folder, photos, stages)
    pipeline.run({"copy": WithDepth(depth=file)})
    assert ran(pipeline) == []
    (tmp_path / "maps" / "left" / "1.png").write_text("changed")
    assert reasons(pipeline)["copy"] == "depth file left/1.png changed"


def test_hidden_files_among_photographs_do_not_count(finished: Pipeline, photos: Path) -> None:
    (photos / ".DS_Store").write_text("desktop")
    assert ran(finished) == []


def test_touched_photograph_with_the_same_bytes_is_no_reason(
    finished: Pipeline, photos: Path
) -> None:
    os.utime(photos / "a.jpg", (1, 1))
    assert ran(finished) == []


def test_changed_output_upstream_is_a_reason(finished: Pipeline, run_folder: Path) -> None:
    stages = fake_stages()
    stages[0] = dataclasses.replace(stages[0], version=2)
    newer = Pipeline(run_folder, stages=stages)
    assert reasons(newer)["copy"] == "new version of the stage (1 -> 2)"
    assert ran(newer) == ["copy"]  # the same bytes again


@pytest.mark.parametrize("harm", ["edit", "truncate", "remove"])
def test_damaged_output_runs_its_stage_again(
    finished: Pipeline, run_folder: Path, harm: str
) -> None:
    victim = run_folder / "2-count" / "count.txt"
    if harm == "edit":
        victim.write_text("42001")
    elif harm == "truncate":
        victim.write_text("")
    else:
        victim.unlink()
    words = "is missing" if harm == "remove" else "changed"
    assert reasons(finished)["count"] == f"its output count.txt {words}"
    assert ran(finished) == ["count"]
    assert victim.read_text() == "42000"


def test_flipped_bit_of_the_same_size_and_time_is_found_by_reading_all(
    finished: Pipeline, run_folder: Path
) -> None:
    finished.check_outputs()
    flip_bit(run_folder / "2-count" / "count.txt")
    assert not any(step.will_run for step in finished.plan())
    with pytest.raises(SplatError) as error:
        finished.check_outputs()
    assert error.value.code == "run-folder-damaged"
    assert "2-count/count.txt changed" in error.value.given
    assert str(run_folder / "2-count") in error.value.hint
    shutil.rmtree(run_folder / "2-count")  # as the hint says
    assert next(step.stage.name for step in finished.plan() if step.will_run) == "count"
    finished.run()
    finished.check_outputs()


def flip_bit(path: Path) -> None:
    """As a fault of the disk does: size and time stay."""
    stat, content = path.stat(), path.read_bytes()
    path.write_bytes(bytes([content[0] ^ 1]) + content[1:])
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def test_flipped_bit_is_not_read_by_the_next_stage_and_the_printed_repair_helps(
    finished: Pipeline, run_folder: Path
) -> None:
    right = finished.load("sign")
    flip_bit(run_folder / "2-count" / "count.txt")
    other = {"sign": SignSettings(names=("c",))}
    for use in (lambda: finished.run(other), lambda: finished.load("count")):
        with pytest.raises(SplatError) as error:
            use()
        assert error.value.code == "run-folder-damaged"
        assert "2-count/count.txt changed" in error.value.given
        assert f"Delete {run_folder / '2-count'}" in error.value.hint
    assert finished.load("sign") == right  # the refused run made nothing
    shutil.rmtree(run_folder / "2-count")
    finished.run(other)
    assert finished.load("sign") == "42000 c"


def test_flipped_bit_of_a_picture_is_found_by_the_stage_that_opens_it(
    photos: Path, run_folder: Path
) -> None:
    def copy(inputs, settings, folder, report) -> None:
        (folder / "text").mkdir()
        (folder / "text" / "all.txt").write_text("onetwo")
        (folder / "a.jpg").write_text("a picture")

    pipeline = Pipeline(run_folder, photos, fake_stages(copy=copy))
    pipeline.run()
    flip_bit(run_folder / "1-copy" / "a.jpg")
    assert pipeline.load("copy") == "onetwo"  # which opens no picture
    with pytest.raises(SplatError) as error:
        pipeline.run({"count": CountSettings(iterations=5)})
    assert "1-copy/a.jpg changed" in error.value.given


def test_extra_file_beside_the_outputs_does_no_harm(finished: Pipeline, run_folder: Path) -> None:
    (run_folder / "3-sign" / "thumbnail.png").write_text("a viewer left this")
    assert ran(finished) == []


def test_files_of_others_in_an_output_survive_its_replacement(
    finished: Pipeline, run_folder: Path
) -> None:
    export = run_folder / "3-sign"
    (export / "mine").mkdir()
    (export / "half.ply").write_text("edited")
    (export / "mine" / "notes.txt").write_text("notes")
    (export / "signed.txt").write_text("edited by hand")
    for names in (("c",), ("d",)):
        warnings = finished.run({"sign": SignSettings(names=names)})[-1].warnings
        assert warnings == [] if names == ("d",) else warnings[0][0] == "run-file-kept"
        assert (export / "half.ply").read_text() == "edited"
        assert (export / "mine" / "notes.txt").read_text() == "notes"
        assert (export / "signed.txt").read_text() == f"42000 {names[0]}"
        assert (export / "kept" / "signed.txt").read_text() == "edited by hand"
    assert ran(finished) == []
    assert sorted(p.name for p in run_folder.glob(".*")) == [".lock"]


def test_file_of_others_under_a_name_that_the_stage_needs_later_is_kept(
    photos: Path, run_folder: Path
) -> None:
    def sign(inputs, settings, folder, report) -> None:
        for name in settings.names:
            (folder / name).write_text("splat's")

    pipeline = Pipeline(run_folder, photos, fake_stages(sign=sign))
    pipeline.run()
    (run_folder / "3-sign" / "c").write_text("mine")
    warnings = pipeline.run({"sign": SignSettings(names=("a", "c"))})[-1].warnings
    assert warnings[0][0] == "run-file-kept"
    assert (run_folder / "3-sign" / "c").read_text() == "splat's"
    assert (run_folder / "3-sign" / "kept" / "c").read_text() == "mine"
    assert not (run_folder / "3-sign" / "b").exists()  # splat's own


@pytest.mark.parametrize("renames", range(8))
def test_files_of_others_survive_a_kill_at_every_rename(
    finished: Pipeline, run_folder: Path, monkeypatch: pytest.MonkeyPatch, renames: int
) -> None:
    export, rename = run_folder / "3-sign", Path.rename
    (export / "half.ply").write_text("edited")
    (export / "signed.txt").write_text("by hand")
    left = iter([True] * renames)

    def dying(self: Path, target: Path) -> Path:
        if not next(left, False):
            raise KeyboardInterrupt
        return rename(self, target)

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(Path, "rename", dying)
        finished.run({"sign": SignSettings(names=("c",))})
    finished.run({"sign": SignSettings(names=("c",))})
    assert (export / "half.ply").read_text() == "edited"
    assert (export / "kept" / "signed.txt").read_text() == "by hand"
    assert (export / "signed.txt").read_text() == "42000 c"
    assert {p.name for p in export.iterdir()} == {
        *("half.ply", "kept", "signed.txt", "manifest.json")
    }


@pytest.mark.parametrize("text", ["", "{", '{"schema": 2}'])
def test_a_damaged_run_file_is_refused(finished: Pipeline, run_folder: Path, text: str) -> None:
    (run_folder / "run.json").write_text(text)
    with pytest.raises(SplatError, match=r"delete .*run\.json.*give all options again") as caught:
        finished.run()
    assert caught.value.code == "manifest-edited"


def test_a_run_without_its_run_file_goes_on_with_the_same_photographs_and_settings(
    photos: Path, run_folder: Path
) -> None:
    settings = {"copy": CopySettings(upper=True), "count": CountSettings(iterations=5)}
    with pytest.raises(Interrupted):
        Pipeline(run_folder, photos, fake_stages(count=checkpointing(10, 6))).run(settings)
    run_file = run_folder / "run.json"
    run_file.unlink()
    again = Pipeline(run_folder, photos, stages=fake_stages(count=checkpointing(10, 6)))
    assert is_run_folder(run_folder)
    assert [step.reason for step in again.plan(settings)][:2] == ["", "was interrupted"]
    heard = Heard()
    again.run(settings, listener=heard)
    assert heard.events == [("skipped", "copy"), ("resumed", "count"), ("started", "sign")]
    assert again.load("count") == "10 from 6"
    recorded = RunFile.read(run_folder)
    assert recorded is not None
    assert recorded.settings["copy"]["upper"] is True
    run_file.unlink()
    other = photographs(run_folder.with_name("other"), z="zzz")
    with pytest.raises(SplatError) as caught:
        Pipeline(run_folder, other, fake_stages()).run()
    assert caught.value.code == "run-folder-other-photographs"


@pytest.mark.parametrize("lost", [False, True])
def test_run_folder_in_place_of_photographs_is_refused(
    finished: Pipeline, run_folder: Path, lost: bool
) -> None:
    if lost:
        (run_folder / "run.json").unlink()
    new = run_folder.with_name("new")
    with pytest.raises(SplatError, match="is a run folder") as caught:
        Pipeline(new, run_folder, fake_stages()).run()
    assert caught.value.code == "photographs-run-folder"
    assert int(caught.value.family) == 2
    assert not new.exists()


@pytest.mark.parametrize("inside", ["1-copy", "1-copy/inner", "2-count"])
def test_the_folder_of_a_stage_in_place_of_photographs_is_refused(
    finished: Pipeline, run_folder: Path, inside: str
) -> None:
    (run_folder / inside).mkdir(exist_ok=True)
    new = run_folder.with_name("new")
    with pytest.raises(SplatError, match=f"splat process {run_folder}$") as caught:
        Pipeline(new, run_folder / inside, fake_stages()).run()
    assert caught.value.code == "photographs-run-folder"
    assert not new.exists()


def test_photographs_that_users_keep_in_a_run_folder_are_accepted(
    finished: Pipeline, run_folder: Path
) -> None:
    kept = photographs(run_folder / "more")
    assert Pipeline(run_folder.with_name("new"), kept, fake_stages()).run()


def test_run_file_of_another_program_is_refused_and_kept(photos: Path, run_folder: Path) -> None:
    run_folder.mkdir()
    (run_folder / "run.json").write_text('{"program": "other"}')
    with pytest.raises(SplatError) as caught:
        Pipeline(run_folder, photos, fake_stages()).run()
    assert caught.value.code == "manifest-edited"
    assert [path.name for path in run_folder.iterdir()] == ["run.json"]


def test_copied_run_folder_stays_finished(finished: Pipeline, run_folder: Path) -> None:
    copy = run_folder.with_name("copy of run")
    shutil.copytree(run_folder, copy)
    for path in copy.rglob("*"):
        os.utime(path, (1, 1))
    assert ran(Pipeline(copy, stages=fake_stages())) == []


def test_photographs_moved_away_after_ingest_are_no_reason(
    finished: Pipeline, photos: Path, run_folder: Path
) -> None:
    shutil.move(photos, photos.with_name("archive"))
    assert ran(Pipeline(run_folder, stages=fake_stages())) == []
    assert ran(Pipeline(run_folder, photos.with_name("archive"), fake_stages())) == []


def test_output_digest_does_not_depend_on_time(photos: Path, tmp_path: Path) -> None:
    digests = []
    for name in ("one", "two"):
        pipeline = Pipeline(tmp_path / name, photos, fake_stages())
        digests.append([m.output_digest for m in pipeline.run()])
    assert digests[0] == digests[1]


# -- what must be refused


def test_other_photographs_are_refused(finished: Pipeline, run_folder: Path, tmp_path) -> None:
    other = photographs(tmp_path / "other", z="zzz")
    with pytest.raises(SplatError, match="--out") as caught:
        Pipeline(run_folder, other, fake_stages()).run()
    assert caught.value.code == "run-folder-other-photographs"


def test_other_photographs_are_refused_while_those_of_the_run_are_away(
    finished: Pipeline, photos: Path, run_folder: Path, tmp_path: Path
) -> None:
    """They may be on a card that is unplugged."""
    shutil.move(photos, photos.with_name("card"))
    with pytest.raises(SplatError) as caught:
        Pipeline(run_folder, photographs(tmp_path / "other", z="zzz"), fake_stages()).run()
    assert caught.value.code == "run-folder-other-photographs"
    assert ran(Pipeline(run_folder, photos.with_name("card"), fake_stages())) == []


def test_moved_photographs_may_have_become_more(
    finished: Pipeline, photos: Path, run_folder: Path
) -> None:
    moved = photos.with_name("archive")
    shutil.move(photos, moved)
    (moved / "c.jpg").write_text("x")
    assert "copy" in ran(Pipeline(run_folder, moved, fake_stages()))


def test_other_photographs_may_follow_those_of_which_nothing_came(
    photos: Path, run_folder: Path, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="bug"):
        Pipeline(run_folder, photos, fake_stages(copy=failing(ValueError("bug")))).run()
    other = photographs(tmp_path / "other", z="zzz")
    assert ran(Pipeline(run_folder, other, fake_stages()))


def test_foreign_folder_is_refused_and_untouched(photos: Path, run_folder: Path) -> None:
    run_folder.mkdir()
    (run_folder / "thesis.txt").write_text("mine")
    with pytest.raises(SplatError) as caught:
        Pipeline(run_folder, photos, fake_stages()).run()
    assert caught.value.code == "run-folder-foreign"
    assert [p.name for p in run_folder.iterdir()] == ["thesis.txt"]


def test_folder_whose_first_run_file_was_not_completed_is_not_foreign(
    photos: Path, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(SplatError) as caught:
            Pipeline(run_folder, photos, fake_stages()).run()
    assert caught.value.code == "disk-full"
    assert "run.json.tmp" in {path.name for path in run_folder.iterdir()}
    assert ran(Pipeline(run_folder, photos, fake_stages())) == ["copy", "count", "sign"]
    assert "run.json.tmp" not in {path.name for path in run_folder.iterdir()}


def test_settings_out_of_bounds_are_refused_before_anything_is_made(
    photos: Path, run_folder: Path
) -> None:
    with pytest.raises(SplatError, match="--iterations 0") as caught:
        Pipeline(run_folder, photos, fake_stages()).run({"count": CountSettings(iterations=0)})
    assert caught.value.code == "option-value"
    assert not run_folder.exists()


def test_recorded_settings_out_of_bounds_are_refused_before_any_stage_runs(
    finished: Pipeline, run_folder: Path, photos: Path
) -> None:
    recorded = RunFile.read(run_folder)
    assert recorded is not None
    recorded.updated({"count": CountSettings(iterations=0)}).write(run_folder)
    (photos / "a.jpg").write_text("longer")
    heard = Heard()
    with pytest.raises(SplatError, match="--iterations 0"):
        finished.run(listener=heard)
    assert heard.events == []


def test_photograph_that_may_not_be_read_does_not_stop_the_run(
    photos: Path, run_folder: Path, monkeypatch
) -> None:
    """Tests may run as a user whom permissions do not bind."""
    opened = Path.open

    def refusing(self: Path, *args, **kwargs):
        if self.name == "b.jpg":
            raise PermissionError(errno.EACCES, "Permission denied", str(self))
        return opened(self, *args, **kwargs)

    def copy(inputs, settings, folder, report) -> None:
        (folder / "text").mkdir()
        (folder / "text" / "all.txt").write_text("one")

    pipeline = Pipeline(run_folder, photos, fake_stages(copy=copy))
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", refusing)
        pipeline.run()
        assert ran(pipeline) == []
    assert reasons(pipeline)["copy"] == "photograph b.jpg changed"  # it may be read again


def test_run_folder_among_the_photographs_is_refused(photos: Path) -> None:
    with pytest.raises(SplatError) as caught:
        Pipeline(photos / "run", photos, fake_stages()).run()
    assert caught.value.code == "run-folder-inside-photographs"
    assert sorted(p.name for p in photos.iterdir()) == ["a.jpg", "b.jpg"]


def test_missing_photographs_are_refused(run_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SplatError) as caught:
        Pipeline(run_folder, tmp_path / "nowhere", fake_stages()).run()
    assert caught.value.code == "photographs-missing"
    assert not run_folder.exists()


def test_manifest_edited_by_hand_is_refused(finished: Pipeline, run_folder: Path) -> None:
    path = run_folder / "2-count" / "manifest.json"
    path.write_text(path.read_text().replace("7000", "9000"))
    with pytest.raises(SplatError, match="2-count") as caught:
        finished.run()
    assert caught.value.code == "manifest-edited"
    assert caught.value.family is Family.RUN_FOLDER
    shutil.rmtree(run_folder / "2-count")  # what the hint says
    assert ran(finished) == ["count"]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", '{"schema": "one"}', f'{{"schema": {SCHEMA}}}']
)
def test_damaged_manifest_is_refused(finished: Pipeline, run_folder: Path, text: str) -> None:
    (run_folder / "1-copy" / "manifest.json").write_text(text)
    with pytest.raises(SplatError) as caught:
        finished.plan()
    assert caught.value.code == "manifest-edited"


@pytest.mark.parametrize("name", ["run.json", "1-copy/manifest.json"])
def test_newer_schema_is_refused(finished: Pipeline, run_folder: Path, name: str) -> None:
    path = run_folder / name
    path.write_text(json.dumps({**json.loads(path.read_text()), "schema": 99}))
    with pytest.raises(SplatError) as caught:
        finished.run()
    assert caught.value.code == "run-folder-newer"


def test_a_run_folder_of_an_older_schema_is_refused_and_left_as_it_is(
    photos: Path, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(manifest, "SCHEMA", SCHEMA - 1)
        Pipeline(run_folder, photos, fake_stages()).run()
    (run_folder / ".lock").unlink()
    (run_folder / ".2-count.partial").mkdir()

    def state() -> dict[str, tuple[int, bytes]]:
        paths = (run_folder, *run_folder.rglob("*"))
        return {
            str(p): (p.stat().st_mtime_ns, p.read_bytes() if p.is_file() else b"") for p in paths
        }

    before = state()
    older = Pipeline(run_folder, photos, fake_stages())
    for use in (older.run, older.status, older.plan, lambda: older.manifest("copy")):
        with pytest.raises(SplatError, match="older version") as caught:
            use()
        assert caught.value.code == "run-folder-older"
        assert int(caught.value.family) == 5
        assert "--out" in caught.value.hint
    assert state() == before


def test_later_stage_alone_names_the_command_to_run_first(photos: Path, run_folder: Path) -> None:
    pipeline = Pipeline(run_folder, photos, fake_stages())
    pipeline.run(until="copy")
    with pytest.raises(SplatError, match="splat count") as caught:
        pipeline.run(until="sign", may_run={"sign"})
    assert caught.value.code == "stage-not-finished"
    pipeline.run(until="count", may_run={"count"})
    pipeline.run(until="sign", may_run={"sign"})


def test_second_process_is_refused_and_named(finished: Pipeline, run_folder: Path) -> None:
    with locked(run_folder), pytest.raises(SplatError, match=str(os.getpid())) as caught:
        finished.run()
    assert caught.value.code == "run-folder-busy"
    finished.run()


def test_clock_that_steps_backwards_changes_nothing(
    photos: Path, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files are then newer than the present, and each reading of the clock is earlier."""
    future = time.time() + 1e8
    for path in photos.iterdir():
        os.utime(path, (future, future))
    readings = iter(range(2_000_000_000, 0, -100_000))
    monkeypatch.setattr(time, "time", lambda: float(next(readings)))
    pipeline = Pipeline(run_folder, photos, fake_stages())
    manifests = pipeline.run()
    assert all(0 <= one.seconds < 60 and one.cpu_seconds >= 0 for one in manifests)
    for path in run_folder.rglob("*"):
        os.utime(path, (future, future))
    assert ran(pipeline) == []


@pytest.mark.skipif(sys.platform != "linux", reason="a path has 4,095 bytes at most on Linux")
@pytest.mark.parametrize("length", [4000, 4090, 5000])
def test_long_path_works_or_is_refused_in_words(photos: Path, tmp_path: Path, length: int) -> None:
    deep = tmp_path
    while len(str(deep)) < length - 1:
        deep /= "x" * min(200, length - 1 - len(str(deep)))
    pipeline = Pipeline(deep, photos, fake_stages())
    if length == 4000:
        assert len(pipeline.run()) == 3
        return
    with pytest.raises(SplatError) as error:
        pipeline.run()
    assert (error.value.code, error.value.family) == ("name-too-long", Family.INPUT)


def test_lock_of_a_killed_process_does_not_count(finished: Pipeline, run_folder: Path) -> None:
    code = (
        "import os, sys, pathlib, signal\n"
        "from stages.run.lock import HOLDER, locked\n"
        "with locked(pathlib.Path(sys.argv[1])):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(run_folder)], check=False, timeout=30)
    assert (run_folder / HOLDER).read_text().strip().isdigit()
    assert finished.busy() is None
    assert ran(finished) == []


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no /proc here")
def test_place_where_no_folder_can_be_is_not_called_a_full_disk(photos: Path) -> None:
    with pytest.raises(SplatError, match="/proc/run") as caught:
        Pipeline(Path("/proc/run"), photos, fake_stages()).run()
    assert caught.value.code == "run-folder-unusable"


def test_run_folder_below_a_file_is_refused(photos: Path) -> None:
    below = photos.parent / "file"
    below.write_text("")
    with pytest.raises(SplatError) as caught:
        Pipeline(below / "run", photos, fake_stages()).run()
    assert caught.value.code == "run-folder-unusable"


def test_folder_without_write_permission_is_refused(
    photos: Path, run_folder: Path, monkeypatch
) -> None:
    def denied(self: Path, *args, **kwargs) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "mkdir", denied)
    with pytest.raises(SplatError, match="--out") as caught:
        Pipeline(run_folder, photos, fake_stages()).run()
    assert caught.value.code == "not-permitted"
    assert caught.value.family is Family.RESOURCES


def test_what_may_not_be_read_is_said_to_need_reading(tmp_path: Path, monkeypatch) -> None:
    """Root may read everything: the system's answer is put in its place."""
    secret, error = tmp_path / "a.ply", PermissionError(errno.EACCES, "Permission denied")
    secret.write_bytes(b"ply")
    error.filename = str(secret)
    refused = {secret: os.R_OK}
    monkeypatch.setattr(os, "access", lambda path, mode: not refused.get(Path(path), 0) & mode)
    found = as_splat_error(error, "info", tmp_path)
    assert found is not None
    assert (found.code, found.family) == ("not-permitted", Family.RESOURCES)
    assert "read" in found.wanted
    assert "--out" not in found.hint
    refused.clear()
    written = as_splat_error(error, "info", tmp_path)
    assert written is not None
    assert "write" in written.wanted


@pytest.mark.parametrize("read", [formats.read, load_splats, nerfstudio.read, read_sealed])
def test_a_file_that_may_not_be_read_is_not_called_damaged(
    tmp_path: Path, monkeypatch, read: Callable[[Path], object]
) -> None:
    path = tmp_path / ("a.json" if read in (nerfstudio.read, read_sealed) else "a.ply")
    path.write_bytes(b"{}")

    def denied(self: Path, *args, **kwargs) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", denied)
    with pytest.raises(SplatError) as caught:
        read(path)
    assert (caught.value.code, caught.value.family) == ("not-permitted", Family.RESOURCES)


# -- what must survive


def failing(error: BaseException):
    def run(inputs, settings, folder, report) -> None:
        (folder / "half.txt").write_text("half")
        raise error

    return run


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "disk-full"),
        (MemoryError(), "out-of-memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), "out-of-memory"),
        (PermissionError(errno.EACCES, "Permission denied", "x.png"), "not-permitted"),
    ],
)
def test_machine_refusals_keep_what_is_finished(
    photos: Path, run_folder: Path, error: Exception, code: str
) -> None:
    broken = Pipeline(run_folder, photos, fake_stages(count=failing(error)))
    with pytest.raises(SplatError) as caught:
        broken.run()
    assert caught.value.code == code
    assert caught.value.family is Family.RESOURCES
    assert broken.manifest("copy") is not None
    assert not (run_folder / "2-count").exists()
    assert ran(Pipeline(run_folder, photos, fake_stages())) == ["count", "sign"]


def test_full_disk_under_a_library_error_is_recognised(photos: Path, run_folder: Path) -> None:
    def run(inputs, settings, folder, report) -> None:
        try:
            with open("/dev/full", "w") as full:
                full.write("x" * 100_000)
        except OSError as error:
            raise RuntimeError("archive writer failed") from error

    with pytest.raises(SplatError) as caught:
        Pipeline(run_folder, photos, fake_stages(count=run)).run()
    assert caught.value.code == "disk-full"


def test_failing_stage_keeps_the_old_finished_work(finished: Pipeline, run_folder: Path) -> None:
    broken = Pipeline(run_folder, stages=fake_stages(count=failing(ValueError("bug"))))
    with pytest.raises(ValueError, match="bug"):
        broken.run({"count": CountSettings(iterations=1)})
    assert finished.load("count") == "42000"
    assert "iterations 7000 -> 1" in reasons(finished)["count"]


@pytest.mark.parametrize(
    ("family", "recorded"),
    [(Family.USAGE, 7000), (Family.INPUT, 7000), (Family.RESOURCES, 1), (Family.RUN_FOLDER, 1)],
)
def test_settings_that_a_stage_refuses_are_not_recorded(
    finished: Pipeline, run_folder: Path, family: Family, recorded: int
) -> None:
    error = SplatError("count-x", given="1.", wanted="2.", hint="3.", family=family)
    refusing = Pipeline(run_folder, stages=fake_stages(count=failing(error)))
    with pytest.raises(SplatError):
        refusing.run({"copy": CopySettings(threads=2), "count": CountSettings(iterations=1)})
    settings = finished.recorded_settings()
    assert settings["count"].iterations == recorded
    assert settings["copy"].threads == 2


@pytest.mark.parametrize("refusal", [OSError(errno.ENAMETOOLONG, "too long", "m" * 300), None])
def test_wrong_settings_of_two_stages_do_not_keep_each_other_alive(
    finished: Pipeline, run_folder: Path, refusal: Exception | None
) -> None:
    refusal = refusal or SplatError("x", given="1.", wanted="2.", hint="3.")
    refusing = Pipeline(run_folder, stages=fake_stages(count=failing(refusal)))
    wrong = {"count": CountSettings(iterations=1), "sign": SignSettings(names=("wrong",))}
    with pytest.raises(SplatError):
        refusing.run(wrong)
    settings = finished.recorded_settings()
    assert (settings["count"], settings["sign"]) == (CountSettings(), SignSettings())


def test_settings_of_later_stages_stay_where_the_input_was_refused(
    finished: Pipeline, photos: Path, run_folder: Path
) -> None:
    refusal = SplatError("x", given="1.", wanted="2.", hint="3.")
    (photos / "c.jpg").write_text("three")
    with pytest.raises(SplatError):
        Pipeline(run_folder, stages=fake_stages(copy=failing(refusal))).run(
            {"sign": SignSettings(names=("c",))}
        )
    assert finished.recorded_settings()["sign"].names == ("c",)


def test_photographs_under_another_spelling_are_the_same(
    finished: Pipeline, photos: Path, run_folder: Path
) -> None:
    (photos / "c.jpg").write_text("three")
    link = photos.parent / "link"
    link.symlink_to(photos)
    for spelling in (photos.parent / "run" / ".." / "photos", link):
        Pipeline(run_folder, spelling, fake_stages()).run()
        assert finished.recorded_photos() == photos
    assert finished.load("copy") == "onetwothree"


def checkpointing(total: int, stop_after: int):
    """Adds a letter at a time to a checkpoint; stops after some, once."""

    def run(inputs, settings, folder, report) -> None:
        checkpoint = folder / "checkpoint"
        done = int(checkpoint.read_text()) if checkpoint.exists() else 0
        first = done
        while done < total:
            if report.stop_requested.is_set() or done - first == stop_after:
                raise Interrupted
            done += 1
            checkpoint.write_text(str(done))
        checkpoint.unlink()
        (folder / "count.txt").write_text(f"{total} from {first}")

    return run


def test_interrupted_stage_goes_on_from_its_checkpoint(photos: Path, run_folder: Path) -> None:
    pipeline = Pipeline(run_folder, photos, fake_stages(count=checkpointing(10, 6)))
    with pytest.raises(Interrupted):
        pipeline.run()
    assert [s.interrupted for s in pipeline.status()] == [False, True, False]
    heard = Heard()
    pipeline.run(listener=heard)
    assert heard.events == [("skipped", "copy"), ("resumed", "count"), ("started", "sign")]
    assert pipeline.load("count") == "10 from 6"


def test_incomplete_files_and_folders_of_a_killed_attempt_are_removed(
    photos: Path, run_folder: Path
) -> None:
    pipeline = Pipeline(run_folder, photos, fake_stages(count=checkpointing(10, 6)))
    with pytest.raises(Interrupted):
        pipeline.run()
    partial = run_folder / ".2-count.partial"
    for folder in (partial / ".partial-0-1-scene.usdz", partial / "below" / ".partial-0-1-a"):
        (folder / ".partial-0-1-inner").mkdir(parents=True)
        (folder / ".partial-0-1-scene.usdc").write_text("half")
    (partial / "below" / ".partial-0-1-b.ply").write_text("half")
    pipeline.run()
    assert pipeline.load("count") == "10 from 6"
    assert not list(run_folder.rglob(".partial-*"))


def test_failed_stage_is_told_with_its_reason_until_it_runs_again(
    photos: Path, run_folder: Path
) -> None:
    refusal = SplatError("count-x", given="Two cats.", wanted="A dog.", hint="Bark.")
    with pytest.raises(SplatError):
        Pipeline(run_folder, photos, fake_stages(count=failing(refusal))).run()
    pipeline = Pipeline(run_folder, photos, fake_stages(count=checkpointing(10, 6)))
    step = pipeline.status()[1]
    assert (step.failed, step.reason) == (True, "Two cats. (count-x)")
    with pytest.raises(Interrupted):
        pipeline.run()
    step = pipeline.status()[1]
    assert (step.failed, step.interrupted, step.reason) == (False, True, "was interrupted")
    pipeline.run()
    assert not pipeline.status()[1].will_run
    assert "failure.json" not in {p.name for p in (run_folder / "2-count").iterdir()}


def test_reason_of_a_crash_and_of_a_stage_that_ran_again_is_kept_too(
    finished: Pipeline, run_folder: Path
) -> None:
    broken = Pipeline(run_folder, stages=fake_stages(count=failing(ValueError("no cats"))))
    with pytest.raises(ValueError, match="no cats"):
        broken.run({"count": CountSettings(iterations=1)})
    step = broken.status()[1]
    assert step.failed
    assert step.reason == (
        "iterations 7000 -> 1, failed at the last attempt: ValueError: no cats. (bug)"
    )
    finished.run({"count": CountSettings()})  # as it was finished before
    assert not finished.status()[1].failed


def test_what_a_stage_offers_to_draw_reaches_the_listener(photos: Path, run_folder: Path) -> None:
    def offering(inputs, settings, folder, report) -> None:
        report.offer(lambda camera: f"seen from {camera}")
        (folder / "count.txt").write_text("7")

    class Looking(Listener):
        seen: tuple[str, str] | None = None

        def drawable(self, stage, draw) -> None:
            self.seen = (stage.name, draw("above"))

    looking = Looking()
    Pipeline(run_folder, photos, fake_stages(count=offering)).run(listener=looking)
    assert looking.seen == ("count", "seen from above")


def test_leftovers_of_other_settings_are_not_used(photos: Path, run_folder: Path) -> None:
    pipeline = Pipeline(run_folder, photos, fake_stages(count=checkpointing(10, 6)))
    with pytest.raises(Interrupted):
        pipeline.run()
    with pytest.raises(Interrupted):
        pipeline.run({"count": CountSettings(seed=1)})
    pipeline.run()
    assert pipeline.load("count") == "10 from 6"  # 12 would be both attempts added up


def test_half_done_work_goes_on_under_a_setting_that_may_change_midway(
    photos: Path, run_folder: Path
) -> None:
    pipeline = Pipeline(run_folder, photos, fake_stages(count=checkpointing(10, 6)))
    with pytest.raises(Interrupted):
        pipeline.run()
    pipeline.run({"count": CountSettings(tool="pencil")})
    assert pipeline.load("count") == "10 from 6"
    step = pipeline.plan({"count": CountSettings(tool="pen")})[1]
    assert step.reason == "tool pencil -> pen"  # what is finished was made with one of them


def test_stop_between_stages_keeps_the_finished_ones(photos: Path, run_folder: Path) -> None:
    def stop_then_finish(inputs, settings, folder, report) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        (folder / "count.txt").write_text("7")

    pipeline = Pipeline(run_folder, photos, fake_stages(count=stop_then_finish))
    with pytest.raises(Interrupted):
        pipeline.run()
    assert pipeline.load("count") == "7"
    assert pipeline.manifest("sign") is None


def test_second_signal_stops_at_once(photos: Path, run_folder: Path) -> None:
    def stubborn(inputs, settings, folder, report) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        threading.Event().wait(10)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        Pipeline(run_folder, photos, fake_stages(count=stubborn)).run()
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("moment", ["before both renames", "between the renames", "after both"])
def test_crash_while_replacing_leaves_one_whole_result(
    finished: Pipeline, run_folder: Path, moment: str
) -> None:
    final, partial = run_folder / "2-count", run_folder / ".2-count.partial"
    old = run_folder / ".2-count.old"
    shutil.copytree(final, partial)
    if moment == "between the renames":
        final.rename(old)
    elif moment == "after both":
        final.rename(old)
        partial.rename(final)
    assert ran(finished) == []
    assert not partial.exists()
    assert not old.exists()
    assert isinstance(Manifest.read(final), Manifest)


def test_folder_is_flushed_to_the_disk_after_each_rename_in_it(
    finished: Pipeline, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[tuple[str, int]] = []
    fsync = os.fsync

    def noting(rename):
        def call(source: Path, target: Path) -> None:
            rename(source, target)
            events.append(("rename", Path(target).parent.stat().st_ino))

        return call

    def syncing(file: int) -> None:
        fsync(file)
        events.append(("sync", os.fstat(file).st_ino))

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", noting(os.rename))
        patch.setattr(os, "replace", noting(os.replace))
        patch.setattr(os, "fsync", syncing)
        finished.run({"count": CountSettings(iterations=5)})
    renames = [(at, folder) for at, (kind, folder) in enumerate(events) if kind == "rename"]
    assert len(renames) >= 5
    assert run_folder.stat().st_ino in {folder for _, folder in renames}
    for at, folder in renames:
        assert ("sync", folder) in events[at:]


def test_seconds_cpu_seconds_and_memory_of_all_attempts_are_added_up(
    photos: Path, run_folder: Path
) -> None:
    pipeline = Pipeline(run_folder, photos, fake_stages(count=checkpointing(10, 6)))
    with pytest.raises(Interrupted):
        pipeline.run()
    usage = run_folder / ".2-count.partial" / "usage.json"
    before = {"seconds": 100.0, "cpu_seconds": 300.0, "peak_memory_mib": 9e6}
    usage.write_text(json.dumps(before))
    begun = time.monotonic()
    pipeline.run()
    counted = pipeline.manifest("count")
    assert counted is not None
    assert 100.0 < counted.seconds <= 100.0 + time.monotonic() - begun
    assert 300.0 <= counted.cpu_seconds < 400.0
    assert counted.peak_memory_mib == 9e6
    assert set(counted.outputs) == {"count.txt"}
