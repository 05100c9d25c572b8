"""A file of splats measured on photographs: a run as far as training, which makes no step, in a
folder that is removed afterwards."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from splatcli import console, log, progress, run_result, run_settings
from splatcli.input_files import check_files
from stages.base.errors import QualityError
from stages.evaluate.verdict import WRONG
from stages.formats import format_of
from stages.run.listener import Listeners
from stages.run.manifest import Manifest
from stages.run.pipeline import Pipeline

SIDE = 1600  # pixels at most of the photographs: what most programs train at
_OF_SEEDING = ("splats", "given_world", "given_drawing", "given_drawing_db", "other_drawing_db")
_OF_TRAINING = (
    *("psnr_db", "psnr_half_db", "psnr_quarter_db", "psnr_worst_db", "psnr_worst_view"),
    *("ssim", "flip", "evaluated_side_px", "held_out", "verdict"),
)


def check_on_photos(file: Path, photos: Path, options: dict[str, Any]) -> None:
    """Measure the splats of `file` on held-out photographs and print what was found.

    options: of a run, "cameras" among them. Raises SplatError as `splat process --splats`, and
    "verify-failed" where the verdict is that the splats are wrong.
    """
    given = {"splats": file, "train_side": SIDE, "max_side": SIDE, **options}
    settings = run_settings.of_new_run(given)
    check_files(settings)
    with TemporaryDirectory(prefix="splat-") as folder:
        pipeline = Pipeline(Path(folder) / "run", photos)
        listeners = Listeners(log.LogListener(), progress.listener_for(console.mode))
        manifests = pipeline.run(settings, until="train", listener=listeners)
    _, _, seeding, training = manifests
    verdict = training.metrics["verdict"]
    if console.mode.as_json:
        console.emit("verified", **_facts(file, photos, seeding, training))
    elif console.mode.quiet:
        console.out.print(f"{file}: {training.metrics.get('psnr_db', '-')} dB", markup=False)
    else:
        _print(file, seeding, training)
    if verdict["grade"] == WRONG:
        raise QualityError(
            "verify-failed",
            given=f"{file.name} does not show what the photographs show: {verdict['text']}",
            wanted="Splats that show held-out photographs.",
            hint="Check that they are the photographs and cameras that it was trained with.",
        )


def _facts(file: Path, photos: Path, seeding: Manifest, training: Manifest) -> dict[str, Any]:
    chosen = {name: seeding.metrics.get(name) for name in _OF_SEEDING}
    chosen |= {name: training.metrics.get(name) for name in _OF_TRAINING}
    row = format_of(file)
    return {
        "file": str(file),
        "format": row.ending,
        "against": str(photos),
        "size_bytes": row.size_bytes(file),
        **chosen,
        "warnings": [message for _, message in (*seeding.warnings, *training.warnings)],
    }


def _print(file: Path, seeding: Manifest, training: Manifest) -> None:
    found = seeding.metrics
    rows = [
        ("splats", console.figure("splats", found["splats"])),
        ("world", found["given_world"]),
        ("drawing", _drawings(found)),
    ]
    console.table(("", file.name), rows, title="As it fits the photographs best")
    run_result.show_quality(training)
    console.out.print()
    console.paragraph(console.out, run_result.styled(training.metrics["verdict"]))


def _drawings(found: dict[str, Any]) -> str:
    best, other = found["given_drawing_db"], found["other_drawing_db"]
    return f"{found['given_drawing']} ({best:.2f} dB, else {other:.2f} dB)"
