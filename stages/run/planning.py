"""Decides which stages run, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.base.errors import SplatError
from stages.base.stage import Stage
from stages.run.digests import FileRecords, combined_digest, damage, record_files
from stages.run.manifest import Manifest
from stages.run.request import Request, settings_to_data, why_again
from stages.run.workspace import Layout

PHOTOS = "photos"  # the input of a stage that reads no other
MASKS, RIG_MASK, DEPTH, SPLATS = "masks", "rig_mask", "depth", "splats"
_NAMED_AT_MOST = 3


@dataclass(frozen=True)
class Step:
    """One line of a plan.

    reason: why the stage runs; "" if it does not. manifest: of the finished run, if there is one.
    interrupted: whether there is unfinished work. failed: whether its last attempt failed.
    """

    stage: Stage
    number: int
    will_run: bool
    reason: str
    manifest: Manifest | None = None
    interrupted: bool = False
    failed: bool = False


class Planner:
    """Goes through the stages in order and keeps the digest of each output that is known.

    photos: the photographs, or None if the run folder does not record them.
    """

    def __init__(self, layout: Layout, photos: Path | None, wanted: Mapping[str, Any]) -> None:
        """wanted: settings by stage name."""
        self.layout, self.photos, self.wanted = layout, photos, wanted
        self._digests: dict[str, str] = {}
        self._pending: dict[str, bool] = {}  # name -> has finished before
        self._photo_records: FileRecords | None = None

    def plan(self) -> list[Step]:
        """One step for each stage. Raises SplatError, OSError."""
        steps = []
        for stage in self.layout.stages:
            step = self.assess(stage)
            if step.will_run:
                self._pending[stage.name] = step.manifest is not None
            elif step.manifest is not None:
                self.learn(stage, step.manifest)
            steps.append(step)
        return steps

    def learn(self, stage: Stage, manifest: Manifest) -> None:
        """Keep the digest of the stage's final output."""
        self._digests[stage.name] = manifest.output_digest

    def assess(self, stage: Stage) -> Step:
        """Whether `stage` has to run, given the outputs of the stages before it."""
        space = self.layout.workspace(stage)
        number = self.layout.number(stage)
        manifest = Manifest.read(space.final)
        interrupted = space.partial.exists()
        waiting = [
            f"{name} {'runs again' if self._pending[name] else 'has to run'} first"
            for name in stage.reads
            if name in self._pending
        ]
        failure = space.failure()
        if manifest is None:
            first = "was interrupted" if interrupted else "has not run yet"
            return Step(stage, number, True, failure or first, None, interrupted, bool(failure))
        reasons = why_again(self._request_if_known(stage, manifest, bool(waiting)), manifest)
        broken = damage(space.final, manifest.outputs)[:_NAMED_AT_MOST]
        reasons += waiting + [f"its output {change}" for change in broken]
        runs = bool(reasons)
        if runs and failure:
            reasons.append(f"failed at the last attempt: {failure}")
        why = ", ".join(reasons)
        return Step(stage, number, runs, why, manifest, interrupted, runs and bool(failure))

    def request(self, stage: Stage) -> Request:
        """The request for `stage`. Raises SplatError (photographs-missing), OSError."""
        settings = self.wanted[stage.name]
        files = self._files(stage, settings)
        inputs = {name: self._digests[name] for name in stage.reads}
        inputs |= {name: combined_digest(records) for name, records in files.items()}
        return Request(stage, settings_to_data(settings), inputs, files)

    def _files(self, stage: Stage, settings: Any) -> dict[str, FileRecords]:
        """Records of the user's own files that the stage reads, by input: photographs, masks, depth
        maps, and files that settings name. Named files that were removed after the stage finished
        count as unchanged."""
        # They load NumPy, which `splat --help` does without.
        from stages.cameras.camera_formats import files_of
        from stages.ingest import depth_files, masks

        done = Manifest.read(self.layout.workspace(stage).final)
        known = done.input_files if done else {}
        named = {name: value for name, value in vars(settings).items() if isinstance(value, Path)}
        records_of = {}
        if not stage.reads:
            photos = self.existing_photos()
            if self._photo_records is None:
                self._photo_records = record_files(photos, known.get(PHOTOS), users=True)
            records_of[PHOTOS] = self._photo_records
            folder = masks.mask_folder(photos, named.get(MASKS))
            depth = depth_files.depth_source(photos, named.get(DEPTH))
            found_beside = {MASKS: folder, DEPTH: depth}
            named |= {name: path for name, path in found_beside.items() if path is not None}
        for name, path in named.items():
            if name in known and not path.exists():
                records_of[name] = known[name]
                continue
            try:
                if name == DEPTH:
                    files = depth_files.files_of(path)
                else:
                    files = [path] if name in (MASKS, RIG_MASK, SPLATS) else files_of(path)
            except SplatError as error:
                # a folder that lost the files that made it one of cameras
                if name not in known or error.code != "cameras-unknown":
                    raise
                records_of[name] = known[name]
                continue
            records_of[name] = {}
            for file in files:
                lead = depth_files.folder_of(file, path) if name == DEPTH else ""
                old = known.get(name, {}).items()
                before = {key[len(lead) :]: one for key, one in old if key.startswith(lead)}
                records = record_files(file, before, users=True)
                records_of[name] |= {lead + key: record for key, record in records.items()}
        return records_of

    def existing_photos(self) -> Path:
        """Where the photographs are. Raises SplatError (photographs-missing)."""
        if self.photos is None or not self.photos.exists():
            raise SplatError(
                "photographs-missing",
                given=f"The photographs are not at {self.photos}."
                if self.photos
                else "The run folder does not say where its photographs are.",
                wanted="The folder of photographs that the run is made from.",
                hint="Put it back, or name its new place: splat process PHOTOS --out RUN",
            )
        return self.photos

    def _request_if_known(self, stage: Stage, done: Manifest, waiting: bool) -> Request:
        """The request with the inputs of the finished run where the present ones are unknown.
        Outputs of stages that have to run first are a reason of their own, and photographs that
        were moved away after ingest are none."""
        gone = not stage.reads and (self.photos is None or not self.photos.exists())
        if waiting or gone:
            settings = settings_to_data(self.wanted[stage.name])
            return Request(stage, settings, done.inputs, done.input_files)
        return self.request(stage)
