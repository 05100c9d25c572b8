"""Warnings about a capture that say what a photographer should change, with stable codes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from stages.base.errors import SplatError
from stages.base.text import counted, listed
from stages.ingest.sources import RAW_ADVICE, Findings
from stages.scene import Photo

Warn = Callable[[str, str], None]

FEWEST_WITHOUT_WARNING, FEWEST_PANORAMAS = 20, 12
BLURRED_BELOW = 0.6  # of the capture's median; a blur of 1.5 px at 1600 px gives about 0.55
SOFT_BELOW = 2.5  # median sharpness; of pictures enlarged four times or blurred by 3 px it is less
EV_RANGE_STOPS = 1.0
DARK_BELOW = -6.5  # log2 of linear luminance: about 30 of 255
SMALL_BELOW_PX = 640
_NAMED = 8
_HINTS = 2  # in an error about many files


TEXTS = {  # by code, in the order of the warnings; {names} of files or photographs
    "ingest-raw-not-read": f"Raw files are not read: {{names}}. {RAW_ADVICE}",
    "ingest-format-not-read": "These formats are not read: {names}. "
    "Save the pictures as JPEG, PNG or TIFF if they belong to the capture.",
    "ingest-beside-frames": "Pictures beside the frames of a 3D Scanner App scan, such as the "
    "texture of its mesh, are not used: {names}. Move those that are photographs of the scene to "
    "another folder of the capture.",
    "ingest-hdr": "High dynamic range is not used and colours may look pale: {names}. "
    "Switch HDR off in the camera, or export as SDR.",
    "ingest-colour-profile": "The colour profile is damaged, so sRGB was assumed: {names}. "
    "Export these photographs again if their colours look wrong.",
    "ingest-panorama-unclear": "These pictures look like 360-degree panoramas, and most of their "
    "shape do not, so they are taken as photographs: {names}. Panoramas belong in a capture of "
    "their own.",
    "ingest-gps-contradicts": "Exif and XMP state places more than 50 m apart: {names}. The GPS of "
    "these photographs is not used. Write one of the two anew, or remove it.",
    "ingest-transparency": "Transparent parts are treated as empty space: {names}. "
    "With --mask-means ignore they are treated as unknown.",
    "ingest-masks-cut-out": "Masks keep one object in nearly every photograph, so what is outside "
    "is treated as empty space: {names}. With --mask-means ignore it is treated as unknown.",
    "ingest-mask-scaled": "Masks of another size than their photographs were scaled: {names}. "
    "Masks as large as the photographs have sharper edges.",
    "ingest-mask-unused": "Masks that belong to no photograph by their names are not used: "
    "{names}.",
    "ingest-mask-missing": "Some photographs have no mask: {names}. There everything counts.",
    "ingest-mask-turn-unknown": "The Exif orientation turns these photographs, and the sizes of "
    "masks or depth maps do not tell whether these are turned too: {names}. They are taken as "
    "upright. Check them, and turn those that lie as the stored pixels do.",
    "ingest-rig-mask-unused": "The capture has no 360-degree pictures, so this mask is not used: "
    "{names}.",
    "ingest-depth-unused": "Depth maps that belong to no photograph by their names are not used: "
    "{names}.",
    "ingest-depth-beside": "Depth maps beside their photographs are not used: {names}. Give the "
    "photographs' folder as --depth to use them, too.",
    "ingest-blurred": "Blurred, compared with the others: {names}. "
    "Take these again or remove them; more light or a shorter exposure helps.",
    "ingest-small": f"Smaller than {SMALL_BELOW_PX} pixels: {{names}}. "
    "Use the camera's original files and no smaller --max-side; 1600 pixels and more are best.",
    "ingest-dark": "Very dark: {names}. Use more light, or a tripod and a longer exposure.",
}


def unused_files(files: Findings) -> dict[str, Sequence[str]]:
    """Names of the files that ingest does not use, by the code of their warning."""
    return {
        "ingest-raw-not-read": files.raws,
        "ingest-format-not-read": files.other_pictures,
        "ingest-beside-frames": files.beside_frames,
        "ingest-mask-unused": files.stray_masks,
        "ingest-depth-unused": files.stray_depths,
        "ingest-depth-beside": files.unused_depths,
    }


def about_names(names: Mapping[str, Sequence[str]], warn: Warn) -> None:
    """Warn with the text of each code for which there are names."""
    for code, text in TEXTS.items():
        if named := names.get(code):
            warn(code, text.format(names=listed(named)))


LEFT_OUT = {  # by code: what becomes of the first files that cannot be used, and of the others
    "ingest-left-out": ("is left out", "left out, for similar reasons"),
    "ingest-depth-left-out": ("is used without its depth map", "without their depth maps"),
}


def about_left_out(code: str, unusable: Sequence[tuple[str, str, str]], warn: Warn) -> None:
    """Warn with a code of `LEFT_OUT`. unusable: (name, why, what to do) of each photograph or depth
    map that cannot be used."""
    first, others = LEFT_OUT[code]
    for name, why, hint in unusable[:_NAMED]:
        warn(code, f"{name} {first}: {why}. {hint}.")
    if rest := [name for name, *_ in unusable[_NAMED:]]:
        warn(code, f"Also {others}: {listed(rest)}.")


def about_capture(photos: Sequence[Photo], warn: Warn) -> list[str]:
    """Warns about the capture as a whole; returns the names of blurred photographs. Of a panorama
    `photos` holds one face, whose size is not the panorama's."""
    panoramas = sum(photo.face is not None for photo in photos)
    if len(photos) < FEWEST_WITHOUT_WARNING and panoramas < FEWEST_PANORAMAS:
        what = "usable photograph"
        wanted = (
            "An object or a room needs 20 to 50: take more, in small steps around the scene, with "
            "60-80 % overlap."
        )
        if all(_is_frame(photo) for photo in photos):
            what = "different frame"
            wanted = "An object or a room needs 20 to 50: film on while you walk around the scene."
        if panoramas == len(photos):
            what = "usable 360-degree picture"
            wanted = f"A room needs about {FEWEST_PANORAMAS}: take more, each a step from the last."
        warn("ingest-few-photographs", f"The capture holds {counted(len(photos), what)}. {wanted}")
    median = float(np.median([photo.sharpness for photo in photos]))
    blurred = [photo.name for photo in photos if photo.sharpness < BLURRED_BELOW * median]
    if median < SOFT_BELOW:
        warn(
            "ingest-soft",
            "Most photographs are blurred or have been enlarged: they hold little fine detail. "
            "Use the camera's original files, hold it still and check the focus.",
        )
    frames = {photo.name for photo in photos if _is_frame(photo)}  # nobody can take them again
    sides = [(max(p.width, p.height), p.name) for p in photos if p.face is None]
    about_names(
        {
            "ingest-blurred": [name for name in blurred if name not in frames],
            "ingest-small": [name for side, name in sides if side < SMALL_BELOW_PX],
            "ingest-dark": [p.name for p in photos if p.log2_luminance < DARK_BELOW],
        },
        warn,
    )
    _about_light(photos, warn)
    _about_cameras(photos, warn)
    return blurred


def _is_frame(photo: Photo) -> bool:
    """Whether it is a frame of a video."""
    return photo.camera.startswith("video, ")


def _about_light(photos: Sequence[Photo], warn: Warn) -> None:
    known = [photo.exposure_ev for photo in photos if photo.exposure_ev is not None]
    if len(known) > 1 and max(known) - min(known) > EV_RANGE_STOPS:
        warn(
            "ingest-exposure-not-locked",
            f"The camera changed its exposure by {max(known) - min(known):.1f} stops. Lock "
            "exposure and white balance before the first photograph; otherwise the scene gets "
            "patches of different brightness.",
        )


def _about_cameras(photos: Sequence[Photo], warn: Warn) -> None:
    """The parts of Photo.camera are "name, 4.4 mm, 26 mm equivalent, 1600x1200"."""
    names = Counter(photo.camera.split(", ")[0] for photo in photos)
    lenses = Counter(", ".join(photo.camera.split(", ")[1:-1]) for photo in photos)
    sizes = Counter(
        (max(photo.width, photo.height), min(photo.width, photo.height)) for photo in photos
    )
    if len(names) > 1:
        warn(
            "ingest-mixed-cameras",
            f"Several cameras took these photographs ({_counted(names)}). "
            "One camera for the whole capture gives even colours.",
        )
    elif len(lenses) > 1:
        warn(
            "ingest-mixed-zooms",
            f"The focal length changes ({_counted(lenses)}). Do not zoom within a capture.",
        )
    if len(sizes) > 1 and len(names) == 1:
        text = _counted(Counter({f"{w} x {h}": count for (w, h), count in sizes.items()}))
        warn(
            "ingest-mixed-sizes",
            f"Photographs have different proportions or sizes ({text}). "
            "Use the camera's original files, not cropped or resized ones.",
        )


def _counted(kinds: Counter[str]) -> str:
    parts = [f"{count} x {kind or 'unknown'}" for kind, count in kinds.most_common(4)]
    return ", ".join(parts) + (", ..." if len(kinds) > 4 else "")


def too_few(
    root: Path, usable: int, fewest: int, unusable: Sequence[tuple[str, str, str]]
) -> SplatError:
    """The error of a capture in `root` with too few usable photographs. fewest: how many it needs.
    unusable: as in `about_left_out`."""
    if root.is_file() and unusable:
        return SplatError(
            "ingest-video-unusable",
            given=f"{root} cannot be used: {unusable[0][1]}.",
            wanted="A video with pictures that decode.",
            hint=f"{unusable[0][2]}.",
        )
    given = f"{root} holds {counted(usable, 'usable photograph')}."
    if unusable:
        few = "; ".join(f"{name}: {why}" for name, why, _ in unusable[:3])
        more = f"; and {len(unusable) - 3} more" if len(unusable) > 3 else ""
        given = f"{given[:-1]}; {len(unusable)} could not be used ({few}{more})."
    hint = "Take photographs in small steps around the scene, with 60-80 % overlap."
    if unusable and usable + len(unusable) >= fewest:  # there would be enough
        usual = Counter(what_to_do for *_, what_to_do in unusable).most_common(_HINTS)
        hint = " ".join(f"{what_to_do}." for what_to_do, _ in usual)
    return SplatError(
        "ingest-too-few-photographs",
        given=given,
        wanted=f"At least {fewest}; an object or a room needs 20 to 50.",
        hint=hint,
    )
