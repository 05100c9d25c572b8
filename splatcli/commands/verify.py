"""`splat verify`: whether a file holds what was trained."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from splatcli import console
from splatcli.folders import find_run_folder
from splatcli.photo_check import check_on_photos
from stages import formats
from stages.base.errors import QualityError, UsageError
from stages.base.text import quoted
from stages.formats import format_of
from stages.formats.mesh_table import MESHES
from stages.formats.sog_quantisation import splats_to_write
from stages.formats.values import drop_undrawable
from stages.proof.losses import changes_shown
from stages.proof.prover import Proof, Prover, cameras_for, provers_of
from stages.run import results, runfolder
from stages.run.pipeline import Pipeline
from stages.scene import QuantisedSplats, View

_FEW = ("splats", "bytes_per_splat", "verify_db", "verify_mean_db")  # of several files
_ELSEWHERE = 1e-6  # units between two origins


@dataclass(frozen=True)
class _Original:
    """What files are compared with.

    name: for messages. provers_of: one for each model of splats that a file may hold, likeliest
    first. run: that has it in its export folder, if it is a file.
    """

    name: str
    provers_of: Callable[[Path], Iterable[Prover]]
    run: Pipeline | None = None


def verify(
    target: Annotated[
        Path | None,
        typer.Argument(
            help="Splat file, or a run folder for all its files; by default the run here."
        ),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="Run folder or splat file that it must equal; by default the run around it.",
        ),
    ] = None,
    photos: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="Photographs or video: measure the splats of any program on them instead.",
        ),
    ] = None,
    cameras: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="Cameras of --photos that the splats were trained with."),
    ] = None,
    split: Annotated[
        bool, typer.Option("--split", help="Use the test photographs of --cameras.")
    ] = False,
) -> None:
    """Verify a file: read it with a second parser, draw it, compare it with what was trained.

    With --photos: draw it from their cameras and compare it with them. Exit status 7 if a file is
    wrong.
    """
    if photos is not None:
        if target is None or against is not None:
            raise _two_originals()
        check_on_photos(target, photos, {"cameras": cameras, "split": split})
        return
    if cameras is not None:
        raise _two_originals()
    _verify_files(_files(target), against)


def _verify_files(files: list[Path], against: Path | None) -> None:
    """Compare each file with its original, and print what was found."""
    for file in files:
        formats.format_of(file)  # raises before any work is done
    console.note_compiling()
    original, proofs = None, []
    losses: list[str] = []
    for number, file in enumerate(files):
        console.step(f"verifying {file}", done=number, total=len(files))
        # Our own reader first: it reports damage that makes other parsers crash.
        origin = formats.read(file).origin
        original = original or _original(file, against)
        for prover in original.provers_of(file):
            proof = prover.prove(file)
            if not proof.fault:
                break
        proofs.append((file, proof))
        shown = [] if proof.fault else [*changes_shown(file, prover.splats, proof).values()]
        if (apart := float(np.linalg.norm(origin - prover.splats.origin))) > _ELSEWHERE:
            shown.append(
                f"{file.name} lies {apart:.4g} units from {original.name}, by the origins that "
                "both declare; their positions were compared relative to these."
            )
        losses += shown
        if console.mode.as_json:
            console.emit("verified", **_facts(file, proof, original), warnings=shown)
    assert original is not None
    if not console.mode.as_json:
        _print(proofs, original, losses)
    _raise_if_wrong(proofs, original)


def _two_originals() -> UsageError:
    return UsageError(
        "option-alone",
        given="--photos, --cameras and --against do not go together so.",
        wanted="A file with --photos and --cameras, or a file or a run with or without --against.",
        hint="splat verify FILE --photos PHOTOS --cameras MODEL",
    )


def _files(target: Path | None) -> list[Path]:
    """The file itself, or the exported files of a run except meshes, which hold no splats."""
    if target is not None and not target.is_dir():
        return [target]
    pipeline = Pipeline(find_run_folder(target))
    pipeline.check_outputs()
    assets = pipeline.load("export")
    files = [file for file in assets.files if file.format not in MESHES]
    if not files:
        raise UsageError(
            "verify-no-splats",
            given=f"{assets.folder} holds meshes only.",
            wanted="Files of splats: meshes were read back and compared when they were written.",
            hint="Export one, for example: splat export --format ply",
        )
    return [assets.folder / file.path for file in files]


def _original(file: Path, against: Path | None) -> _Original:
    if against is not None and not against.is_dir():
        around = (results.run_around(path) for path in (against, file))
        views = next(filter(None, map(results.views_of, around)), ())
        return _of_file(against, views)
    if against is not None and not runfolder.is_run_folder(against):
        raise runfolder.missing(against)
    run = Pipeline(against) if against is not None else results.run_around(file)
    if run is None:
        raise UsageError(
            "verify-no-original",
            given=f"{file} is in no run's 7-export, and --against is not given.",
            wanted="The original that the file must equal: a run folder or a splat file.",
            hint="Name it with --against. `splat info` reads a file and describes it.",
        )
    return _of_run(run)


def _of_file(file: Path, views: tuple[View, ...]) -> _Original:
    """views: of the capture, if it is known."""
    splats = drop_undrawable(formats.read(file))[0]
    cameras = cameras_for(splats, views)
    prover = Prover.of(splats, cameras, source_format=format_of(file).ending)
    return _Original(str(file), lambda verified: [prover], results.run_around(file))


def _of_run(run: Pipeline) -> _Original:
    """The splats that the run's export writes to a file, which may be fine-tuned for its format;
    then the splats that a conversion would write."""
    quantised: QuantisedSplats = run.load("quantise")
    views = results.reconstruction_of(run).views
    cameras = cameras_for(drop_undrawable(quantised.splats)[0], views)
    prover_of = provers_of(quantised, cameras, results.backend_of_run(run))

    def provers(file: Path) -> Iterator[Prover]:
        row = format_of(file)
        yield prover_of(splats_to_write(row, quantised))
        if row.ending in quantised.finetuned:
            yield prover_of(splats_to_write(row, replace(quantised, finetuned={})))

    return _Original(f"the run {run.run_folder}", provers)


def _facts(file: Path, proof: Proof, original: _Original) -> dict[str, Any]:
    row = format_of(file)
    size = row.size_bytes(file)
    return {
        "file": str(file),
        "format": row.ending,
        "against": original.name,
        "splats": proof.splats,
        "size_bytes": size,
        "bytes_per_splat": round(size / max(1, proof.splats), 2),
        **proof.figures,
        "right": not proof.fault,
        "fault": proof.fault,
    }


def _print(proofs: list[tuple[Path, Proof]], original: _Original, losses: list[str]) -> None:
    facts = [_facts(file, proof, original) for file, proof in proofs]
    if console.mode.quiet:
        for each in facts:
            what = each["fault"] or console.fidelity(each["verify_db"])
            console.out.print(f"{each['file']}: {what}", markup=False)
        return
    if len(facts) > 1:
        _print_several(facts, original)
    else:
        _print_one(facts[0], original)
    for loss in losses:
        console.warn(f"Warning: {loss}")


def _print_several(facts: list[dict[str, Any]], original: _Original) -> None:
    rows = [
        (
            Path(each["file"]).name,
            *(_figure(name, each.get(name, "-")) for name in _FEW),
            _worst(each),
            "wrong" if each["fault"] else "right",
        )
        for each in facts
    ]
    headings = ("file", *map(_label, _FEW), "largest change", "verdict")
    console.table(headings, rows, title=f"Compared with {original.name}")


def _print_one(facts: dict[str, Any], original: _Original) -> None:
    hidden = {"file", "size_bytes", "against", "right", "fault"}
    hidden |= {"worst_attribute", "worst_splat"}
    rows = [(_label(name), _figure(name, facts[name])) for name in facts if name not in hidden]
    rows.append(("worst", _worst(facts)))
    rows.append(("verdict", "wrong" if facts["fault"] else "right"))
    headings = ("", Path(facts["file"]).name)
    console.table(headings, rows, title=f"Compared with {original.name}")


def _worst(facts: dict[str, Any]) -> str:
    name = facts.get("worst_attribute")
    return f"{console.label(name)} of splat {facts['worst_splat']:,}" if name else "-"


def _figure(name: str, value: Any) -> str:
    is_psnr = name in ("verify_db", "verify_mean_db") and isinstance(value, float)
    return console.fidelity(value) if is_psnr else console.figure(name, value)


def _label(name: str) -> str:
    labels = {"verify_db": "worst PSNR", "verify_mean_db": "mean PSNR", "verify_cameras": "cameras"}
    if name.startswith("max_"):
        what, _, unit = name.removeprefix("max_").partition("_error")
        return f"{console.label(what)} off by" + unit.replace("_", ", ")
    return labels.get(name, console.label(name))


def _raise_if_wrong(proofs: list[tuple[Path, Proof]], original: _Original) -> None:
    wrong = [(file, proof.fault) for file, proof in proofs if proof.fault]
    if not wrong:
        return
    hint = "Write it again with `splat export` or `splat convert`."
    file = wrong[0][0]
    if original.run and file.parent.samefile(original.run.stage_folder("export")):
        hint = (  # formats of one run need not hold the same splats
            "Formats of a run may be fine-tuned each by itself: "
            f"splat verify {quoted(file)} --against {quoted(original.run.run_folder)}"
        )
    raise QualityError(
        "verify-failed",
        given="; ".join(f"{file.name} is wrong: {fault}" for file, fault in wrong) + ".",
        wanted=f"The same splats as in {original.name}.",
        hint=hint,
    )
