"""`splat render`: a picture of a run or of a splat file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatcli import console
from splatcli.folders import find_run_folder
from stages.run import runfolder, threads
from stages.run.atomic import replacing
from stages.run.errors import Family, SplatError
from stages.run.pipeline import Pipeline

if TYPE_CHECKING:
    from stages.scene import Camera, Splats, View

_STAGES_WITH_SPLATS = ("quantise", "prune", "train", "seed")
_PICTURES = (".png", ".jpg", ".jpeg", ".webp")


def render_to(
    target: Path | None, out: Path, camera: str | None, width: int | None, backend: str
) -> None:
    """Write a picture of the splats. Raises SplatError."""
    from stages.raster.api import render

    if out.suffix.lower() not in _PICTURES:
        raise SplatError(
            "render-picture-type",
            given=f"{out} is to hold the picture.",
            wanted=f"A name that ends in one of {' '.join(_PICTURES)}.",
            hint="For example --out view.png",
            family=Family.USAGE,
        )
    splats, pipeline = load_splats(target)
    views = _views(pipeline or pipeline_around(target))
    seen = _camera_for(splats, views, camera)
    if width is not None:
        seen = seen.resized(width, max(1, round(width * seen.height / seen.width)))
    if not threads.kernels_are_compiled():
        console.note("Compiling the kernels; this is done once and takes about half a minute.")
    try:
        picture = render(splats, seen, backend=backend)
    except ValueError as error:
        raise SplatError(
            "render-backend",
            given=f"{error}.",
            wanted="A backend that this machine has.",
            hint="Leave --backend away, or see `splat doctor`.",
            family=Family.USAGE,
        ) from error
    _save(picture.image, out)
    console.note(f"{out}: {seen.width} x {seen.height}, {len(splats):,} splats")


def load_splats(target: Path | None, strict: bool = True) -> tuple[Splats, Pipeline | None]:
    """(splats, the pipeline if `target` is a run): from a file, or a run's newest stage. strict:
    whether a value that is not finite makes a file unreadable."""
    if target is not None and target.is_file():
        from stages.formats import read

        return read(target, strict=strict), None
    if target is not None and not target.exists():
        raise SplatError(
            "file-missing",
            given=f"{target} does not exist.",
            wanted="A run folder or a splat file.",
            hint="Check the path.",
        )
    pipeline = Pipeline(find_run_folder(target))
    name = newest_with_splats(pipeline)
    output = pipeline.load(name)
    return (output.splats if name == "quantise" else output), pipeline


def newest_with_splats(pipeline: Pipeline) -> str:
    """The last finished stage whose output is splats. Raises SplatError (no-splats-yet)."""
    for name in _STAGES_WITH_SPLATS:
        if pipeline.manifest(name) is not None:
            return name
    raise SplatError(
        "no-splats-yet",
        given=f"No stage of {pipeline.run_folder} has made splats yet.",
        wanted="A run in which at least `seed` has finished.",
        hint="Run `splat process` to go on.",
        family=Family.USAGE,
    )


def pipeline_around(file: Path | None) -> Pipeline | None:
    """The run whose export folder a file lies in: its cameras fit the file."""
    if file is None or not runfolder.is_run_folder(file.absolute().parent.parent):
        return None
    return Pipeline(file.absolute().parent.parent)


def views_around(file: Path | None) -> tuple[View, ...]:
    """Those of the run whose export folder a file lies in; none elsewhere."""
    return _views(pipeline_around(file))


def _views(pipeline: Pipeline | None) -> tuple[View, ...]:
    if pipeline is None or pipeline.manifest("sfm") is None:
        return ()
    return tuple(sorted(pipeline.load("sfm").views, key=lambda view: view.name))


def _camera_for(splats: Splats, views: tuple[View, ...], wanted: str | None) -> Camera:
    from stages.viewer.shots import in_front_of

    if wanted is None:
        return views[0].camera if views else in_front_of(splats)
    by_name = {view.name: view.camera for view in views}
    if wanted in by_name:
        return by_name[wanted]
    alike = [view.camera for view in views if view.name.rpartition("/")[2] == wanted]
    if len(alike) == 1:
        return alike[0]
    if wanted.isdigit() and int(wanted) < len(views):
        return views[int(wanted)].camera
    known = f"{views[0].name} ... {views[-1].name}" if views else "none: a file has no cameras"
    raise SplatError(
        "render-camera",
        given=f"There is no camera {wanted}.",
        wanted=f"A photograph's name, or a number from 0 to {max(0, len(views) - 1)} ({known}).",
        hint="Leave --camera away, or name a run folder whose photographs you want to see.",
        family=Family.USAGE,
    )


def _save(image: Any, out: Path) -> None:
    import numpy as np
    from PIL import Image

    pixels = np.rint(np.clip(np.nan_to_num(image), 0.0, 1.0) * 255.0).astype(np.uint8)
    with replacing(out) as temporary:
        Image.fromarray(pixels).save(temporary)
