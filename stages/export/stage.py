"""Stage 7: writes files that other programs open, and checks each one.

Every file is read back by a parser that did not write it, drawn from cameras of the capture, and
compared with the splats that it was made from. A wrong file stops the export. Nothing is trained
here: `quantise` has fine-tuned the splats to the rounding of the formats.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

from stages import formats
from stages.base.bad_files import reading, stage_output
from stages.base.errors import Interrupted, QualityError, SplatError
from stages.base.stage import Report
from stages.base.text import counted, size
from stages.export.reuse import digest_of, take_file
from stages.export.settings import ExportSettings
from stages.formats import format_of
from stages.formats.format_table import FORMATS
from stages.formats.mesh_files import CODECS_OF_MESHES
from stages.formats.output_formats import mesh_formats
from stages.formats.sog_quantisation import splats_to_write
from stages.formats.values import drop_undrawable
from stages.mesh.collision_mesh import make_collision_mesh
from stages.proof.losses import losses_of
from stages.proof.prover import Prover, cameras_for, provers_of
from stages.raster.backends import report_backend
from stages.scene import (
    ExportedAssets,
    ExportedFile,
    QuantisedSplats,
    Reconstruction,
    SizeLimit,
    Splats,
)

_INDEX = "assets.json"


def run(
    inputs: Mapping[str, Any], settings: ExportSettings, folder: Path, report: Report
) -> ExportedAssets:
    """Write inputs["quantise"] in all formats into `folder`, seen by the views of inputs["sfm"].
    Files of an earlier export that would come out the same are taken from it.

    Metrics: files (how many), splats, dropped; formats: by format size_bytes, bytes_per_splat,
    made_from (digest of the splats that decide the file and its figures), and the figures of
    `proof.Proof`, among them verify_db (PSNR between pictures of the splats and of the file, the
    worst camera) and the largest errors of the values; mesh: the figures of `CollisionMesh`. Raises
    SplatError "export-verify-failed" (family QUALITY), and what keeps a file from being written.
    """
    quantised: QuantisedSplats = replace(inputs["quantise"], drawing=settings.drawing)
    reconstruction: Reconstruction = inputs["sfm"]
    place = reconstruction.place
    splats, dropped = drop_undrawable(replace(quantised.splats, place=place))
    _warn_of_missing(len(splats), dropped, report)
    chosen = tuple(name for name in dict.fromkeys(settings.formats) if name in FORMATS)
    prover_of = cache(
        lambda: provers_of(quantised, cameras_for(splats, reconstruction.views), settings.backend)
    )
    files, figures = [], {}
    for number, name in enumerate(chosen):
        if report.stop_requested.is_set():
            raise Interrupted("stopped before a file")
        path = folder / f"{settings.name}.{name}"
        held = replace(splats_to_write(FORMATS[name], quantised), place=place)
        made_from = digest_of(held, quantised.splats, quantised.plain)
        found = take_file(name, path, made_from, report)
        if found is None:
            report.progress(number, len(chosen), f"writing .{name}")
            found = _write(path, held, reconstruction, prover_of(), report)
        found["made_from"] = made_from
        figures[name] = found
        files.append(ExportedFile(name, path.name, found["size_bytes"]))
        report.progress(number + 1, len(chosen), f".{name}", verify_db=found["verify_db"])
    _warn_of_size(files, quantised.limit, report)
    meshes = _write_meshes(splats, reconstruction, settings, folder, report)
    figures |= meshes
    files += [
        ExportedFile(name, f"{settings.name}.{name}", found["size_bytes"])
        for name, found in meshes.items()
    ]
    report_backend(report, settings.backend)
    report.metric("files", len(files))
    report.metric("splats", len(splats))
    report.metric("dropped", dropped)
    report.metric("formats", figures)
    _write_index(folder, files)
    return ExportedAssets(folder, tuple(files))


def _write(
    path: Path,
    held: Splats,
    reconstruction: Reconstruction,
    prover_of: Callable[[Splats], Prover],
    report: Report,
) -> dict[str, Any]:
    """Write a file and prove it; returns its figures. held: what it should hold. Raises SplatError
    "export-verify-failed"."""
    formats.write(path, held, units=reconstruction.units, views=reconstruction.views)
    taken = format_of(path).size_bytes(path)
    return {
        "size_bytes": taken,
        "bytes_per_splat": round(taken / max(1, len(held)), 2),
        # pictures are compared with all SH coefficients, values with what the file should hold
        **_prove(prover_of(held), path, report),
    }


def _write_meshes(
    splats: Splats,
    reconstruction: Reconstruction,
    settings: ExportSettings,
    folder: Path,
    report: Report,
) -> dict[str, dict[str, Any]]:
    """Write the requested meshes, and prove each; returns figures by format. Metric: mesh, see
    `CollisionMesh`. Raises SplatError "export-verify-failed"."""
    rows = mesh_formats(settings.formats)
    made_from = digest_of(splats)
    paths = {row.ending: folder / f"{settings.name}.{row.ending}" for row in rows}
    taken = {name: take_file(name, path, made_from, report) for name, path in paths.items()}
    found = {name: figures for name, figures in taken.items() if figures is not None}
    if report.earlier and found:
        report.metric("mesh", report.earlier.metrics["mesh"])
    if len(found) == len(paths):
        return found
    made = make_collision_mesh(
        splats, reconstruction, settings.mesh_triangles, settings.backend, report
    )
    report.metric("mesh", made.figures)
    for name, path in paths.items():
        codec = CODECS_OF_MESHES[name]
        codec.write(path, made.mesh, reconstruction.units)
        if fault := codec.fault_of(path, made.mesh):
            raise _failed(path, fault, "mesh")
        found[name] = {"size_bytes": path.stat().st_size, "made_from": made_from}
    return found


def _warn_of_missing(count: int, dropped: int, report: Report) -> None:
    if dropped:
        report.warn(
            "export-splats-dropped",
            f"Left out, because of values that no viewer can draw: {counted(dropped, 'splat')}. "
            "If they are many, train again with another seed.",
        )
    if not count:
        report.warn(
            "export-empty", "There is not one splat to export; look at the earlier stages' figures."
        )


def _warn_of_size(files: list[ExportedFile], limit: SizeLimit | None, report: Report) -> None:
    """Warn of a file that takes more than the splats were pruned for: pruning measures it before
    quantising has chosen its values."""
    for file in files:
        if limit is None or file.format != limit.format or file.size_bytes <= limit.max_bytes:
            continue
        smaller_mb = 0.99 * limit.max_bytes**2 / file.size_bytes / 1e6  # 1 % below the limit
        digits = 2 - math.floor(math.log10(smaller_mb))
        smaller_mb = math.floor(smaller_mb * 10**digits) / 10**digits
        fewer = " or a larger `splat quantise --sog-loss-db`," * FORMATS[file.format].has_bit_depths
        report.warn(
            "export-max-mb",
            f"{file.path} takes {size(file.size_bytes)}, more than --max-mb "
            f"{limit.max_bytes / 1e6:g} of `splat prune` allows. `splat prune --max-mb "
            f"{smaller_mb:g}`,{fewer} and then `splat export` make it smaller.",
        )


def _write_index(folder: Path, files: list[ExportedFile]) -> None:
    entries = [asdict(file) for file in files]
    (folder / _INDEX).write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")


def _prove(prover: Prover, path: Path, report: Report) -> dict[str, Any]:
    """The file's figures; warns of what it lost. Raises SplatError "export-verify-failed"."""
    proof = prover.prove(path)
    if proof.fault:
        raise _failed(path, proof.fault, "splats")
    for code, text in losses_of(path, prover.splats, proof).items():
        report.warn(f"export-{format_of(path).ending.replace('.', '-')}-{code}", text)
    return proof.figures


def _failed(path: Path, reason: str, held: str) -> SplatError:
    return QualityError(
        "export-verify-failed",
        given=f"{path.name} came out wrong: {reason}.",
        wanted=f"A file that another program reads as the same {held}.",
        hint="Leave this format out with --format, and report this with the run's manifest.",
    )


def load(folder: Path) -> ExportedAssets:
    """The files of a finished folder. Raises SplatError if its index is damaged."""
    with reading(folder / _INDEX, stage_output("export-folder-damaged")):
        entries = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
        files = tuple(
            ExportedFile(str(e["format"]), str(e["path"]), int(e["size_bytes"])) for e in entries
        )
    return ExportedAssets(folder, files)
