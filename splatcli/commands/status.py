"""`splat status`: what is finished in a run folder, and what would run again."""

from __future__ import annotations

from typing import Annotated

import typer

from splatcli import console, run_result
from splatcli.arguments import Run
from splatcli.folders import find_run_folder
from stages.run.pipeline import Pipeline, Step


def status(
    run: Run = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read all files of finished stages: damage is named.")
    ] = False,
) -> None:
    """Say what is finished, what would run again, and why."""
    pipeline = Pipeline(find_run_folder(run))
    steps, busy = pipeline.status(), pipeline.busy()
    _print(pipeline, steps, busy)
    if verify:
        pipeline.check_outputs()
        if console.mode.as_json:
            console.emit("verified")
        else:
            console.note("All files of finished stages are as they were written.")


def _print(pipeline: Pipeline, steps: list[Step], busy: int | None) -> None:
    if console.mode.as_json:
        rows = [
            {
                "stage": s.stage.name,
                "state": _state(s, busy),
                "reason": s.reason or None,
                "warnings": s.manifest.warnings if s.manifest else [],
            }
            for s in steps
        ]
        console.emit("status", run_folder=str(pipeline.run_folder), busy=busy, stages=rows)
        return
    console.table(
        ("stage", "state", "time", "peak memory", ""),
        [
            (
                f"{s.number}-{s.stage.name}",
                _state(s, busy),
                run_result.time_of(s.manifest) if s.manifest else "-",
                run_result.memory(s.manifest.peak_memory_mib) if s.manifest else "-",
                s.reason or (run_result.headline(s.manifest) if s.manifest else ""),
            )
            for s in steps
        ],
        title=str(pipeline.run_folder),
    )
    finished = {s.stage.name: s.manifest for s in steps if s.manifest and not s.will_run}
    if training := finished.get("train"):
        run_result.show_choice(training)
        run_result.show_quality(training, finished.get("prune"))
    if busy:
        console.out.print(f"\nProcess {busy} is working on it now.")


def _state(step: Step, busy: int | None) -> str:
    if busy and step.interrupted:
        return "running"
    if not step.will_run:
        return "finished"
    if step.failed:
        return "failed"
    if step.manifest is not None:
        return "runs again"
    return "interrupted" if step.interrupted else "to do"
