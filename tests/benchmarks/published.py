"""Scenes with published figures: `python -m tests.benchmarks.published RUN ... --plot FILE`.

A run is a finished one of a scene of NeRF-synthetic, by its own cameras and split, that exported a
.sog. The scene is the first part of its folder's name, before a hyphen. The table gives for each
run, and for what others published: PSNR and SSIM of all test views at their own size, over white;
the splats; the bytes of the .sog, and the PSNR of what is read back from it; and the processor time
of training and of all stages.
The plot shows PSNR against processor time and against bytes.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from stages.base.plots import write_plot
from stages.evaluate.evaluation import (
    Score,
    evaluate,
    image_renderer,
    load_evaluation_views,
)
from stages.run import results
from stages.run.pipeline import Pipeline
from stages.scene import Splats, draw_settings_of, split_held_out

MB, SIDE = 1e6, 800  # px, as published
EARLIEST_S = 60.0  # before it the plot would show little else
SECONDS, MEGABYTES = (100, 200, 500, 1000, 2000, 5000), (0.3, 0.5, 1, 2)  # ticks
COLOURS = {"chair": "#1f5fa8", "lego": "#c8641e", "mic": "#3a8f5c"}


@dataclass(frozen=True)
class Published:
    """PSNR (dB) of all 200 test views at 800 px, splats and megabytes where they are known."""

    method: str
    scene: str
    psnr_db: float
    splats: int | None = None
    megabytes: float | None = None


# NerfBaselines' figures of 3DGS and 3DGS-MCMC, the splats of 3DGS from the literature on it, and
# the figures of Liu et al. 2024, "HEMGS".
PUBLISHED = (
    Published("3DGS", "chair", 35.84, 299_000),
    Published("3DGS", "lego", 35.70, 298_000),
    Published("3DGS", "mic", 35.49, 277_000),
    Published("3DGS-MCMC", "chair", 36.32),
    Published("3DGS-MCMC", "lego", 35.75),
    Published("3DGS-MCMC", "mic", 37.28),
    Published("HEMGS", "chair", 34.72, megabytes=1.12),
    Published("HEMGS", "lego", 35.31, megabytes=1.42),
    Published("HEMGS", "mic", 36.57, megabytes=0.68),
)


@dataclass(frozen=True)
class Measured:
    """A run's figures: means over the test views; seconds of the processor. course: seconds, and
    PSNR of a dozen test views, while it was trained."""

    scene: str
    steps: int
    side: int
    psnr_db: float
    ssim: float
    splats: int
    megabytes: float
    sog_db: float
    training_s: float
    all_s: float
    course: tuple[tuple[float, float], ...] = ()


def measure(folder: Path) -> Measured:
    """The figures of a finished run. Raises SplatError."""
    pipeline = Pipeline(folder)
    splats = results.final_splats(pipeline)
    trained, sog = pipeline.manifest("train"), folder / "7-export" / "scene.sog"
    if trained is None or not sog.is_file():
        raise SystemExit(f"{folder} has no 7-export/scene.sog: `splat export {folder} -f sog`.")
    scores = _scores(pipeline, splats)
    seconds = {stage.name: _cpu_seconds(pipeline, stage.name) for stage in pipeline.layout.stages}
    return Measured(
        scene=folder.name.partition("-")[0],
        steps=trained.metrics["steps"],
        side=pipeline.recorded_settings()["train"].train_side,
        psnr_db=_mean(scores),
        ssim=float(np.mean([score.ssim for score in scores])),
        splats=len(splats),
        megabytes=sog.stat().st_size / MB,
        sog_db=_mean(_scores(pipeline, results.read_file(sog))),
        training_s=seconds["train"],
        all_s=sum(seconds.values()),
        course=tuple((at["cpu_seconds"], at["psnr_db"]) for at in trained.metrics["history"]),
    )


def _scores(pipeline: Pipeline, splats: Splats) -> list[Score]:
    reconstruction = results.reconstruction_of(pipeline)
    test = split_held_out(reconstruction.views)[1]
    settings = draw_settings_of(reconstruction, SIDE)
    views = load_evaluation_views(reconstruction.folder, test, settings)
    return evaluate(image_renderer(splats, "cpu"), views)


def _mean(scores: list[Score]) -> float:
    return float(np.mean([score.psnr_db for score in scores]))


def _cpu_seconds(pipeline: Pipeline, stage: str) -> float:
    manifest = pipeline.manifest(stage)
    return 0.0 if manifest is None else float(manifest.cpu_seconds)


def print_table(runs: list[Measured]) -> None:
    heads = ("scene", "method", "PSNR", "SSIM", "splats", ".sog MB", "its PSNR", "CPU s", "in all")
    table = Table(*heads)
    for scene in dict.fromkeys(run.scene for run in runs):
        for run in (run for run in runs if run.scene == scene):
            figures = f"{run.psnr_db:.2f}", f"{run.ssim:.4f}", f"{run.splats:,}"
            size = f"{run.megabytes:.2f}", f"{run.sog_db:.2f}"
            time = f"{run.training_s:,.0f}", f"{run.all_s:,.0f}"
            table.add_row(
                scene, f"splat, {run.steps:,} steps, {run.side} px", *figures, *size, *time
            )
        for other in (other for other in PUBLISHED if other.scene == scene):
            count = "" if other.splats is None else f"{other.splats:,}"
            megabytes = "" if other.megabytes is None else f"{other.megabytes:.2f}"
            table.add_row(scene, other.method, f"{other.psnr_db:.2f}", "", count, megabytes)
    Console(width=150).print(table)


def plot(path: Path, runs: list[Measured]) -> None:
    """PSNR against seconds and against megabytes, both on logarithmic axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 4.0), dpi=110, layout="constrained")
    by_time, by_size = figure.subplots(1, 2, sharey=True)
    by_time.set(xlabel="processor time of training (s)", ylabel="PSNR of 200 test views (dB)")
    by_size.set(xlabel="size of the .sog (MB)")
    for scene in dict.fromkeys(run.scene for run in runs):
        same = sorted((run for run in runs if run.scene == scene), key=lambda run: run.training_s)
        style = {"color": COLOURS.get(scene), "label": scene, "ms": 4}
        by_time.plot([r.training_s for r in same], [r.psnr_db for r in same], "o", **style)
        longest = [(s, psnr_db) for s, psnr_db in same[-1].course if s >= EARLIEST_S]
        if longest:
            by_time.plot(*zip(*longest, strict=True), "-", color=COLOURS.get(scene), lw=0.9)
        by_size.plot([r.megabytes for r in same], [r.sog_db for r in same], "o-", lw=0.9, **style)
        for other in (other for other in PUBLISHED if other.scene == scene):
            if other.megabytes is not None:
                by_size.plot(other.megabytes, other.psnr_db, "x", color=COLOURS.get(scene))
            elif other.method == "3DGS":
                by_time.axhline(other.psnr_db, color=COLOURS.get(scene), ls=":", lw=0.9)
    by_time.set_title("line: in training, 12 views; dotted: 3D Gaussian Splatting", fontsize=9)
    by_size.set_title("crosses: HEMGS", fontsize=9)
    for axes, ticks in ((by_time, SECONDS), (by_size, MEGABYTES)):
        axes.set_xscale("log")
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.grid(color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
    by_time.legend(loc="lower right")
    write_plot(path, figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--plot", type=Path)
    given = parser.parse_args()
    runs = [measure(folder) for folder in given.runs]
    print_table(runs)
    if given.plot is not None:
        plot(given.plot, runs)


if __name__ == "__main__":
    main()
