"""Photographs -> Capture: every usable photograph as upright 8-bit sRGB, with what EXIF knows.

Reads JPEG, PNG, TIFF, WebP, HEIC, AVIF and BMP from a folder and its sub-folders, which are only
ever read, and takes sharp frames out of videos. Says in warnings what a photographer should change.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base import threads
from stages.base.errors import Interrupted, SplatError
from stages.base.stage import Report, Stage
from stages.base.text import counted

if TYPE_CHECKING:
    from stages.photos.decode import Decoded, PixelBudget
    from stages.photos.find import Findings, Source
    from stages.photos.quality import Measures
    from stages.scene import Capture, Photo

FEWEST_PHOTOGRAPHS = 3
_PIXELS_AT_ONCE = 250_000_000  # over all threads; about 4 bytes each while they are decoded


@dataclass(frozen=True)
class IngestSettings:
    """Settings of reading photographs."""

    max_side: int = field(
        default=1600,
        metadata={
            "panel": "Quality and time",
            "help": "Longer side of the photographs used for structure from motion and, at most, "
            "for training (px).",
            "min": 64,
            "max": 32_768,
        },
    )
    masks: Path | None = field(
        default=None,
        metadata={
            "panel": "Light and masks",
            "help": "Folder of masks, white where a photograph counts, named as the photographs "
            "are: a.png, a.jpg.png or a_mask.png for a.jpg. A folder called masks in or beside the "
            "photographs' is found without.",
            "affects_output": False,  # its content does, which is an input
        },
    )
    invert_masks: bool = field(
        default=False,
        metadata={
            "panel": "Light and masks",
            "help": "Masks are black where a photograph counts, not white.",
        },
    )
    mask_means: str = field(
        default="auto",
        metadata={
            "panel": "Light and masks",
            "help": "What is outside a mask: ignore (something that does not count), transparent "
            "(nothing, as around an object cut out) or auto (nothing where pictures themselves are "
            "transparent, ignored where masks are files).",
            "choices": ("auto", "ignore", "transparent"),
        },
    )
    frames: int = field(
        default=0,
        metadata={
            "panel": "Input",
            "help": "Frames to take from each video, at most; 0 takes as many as its motion asks "
            "for.",
            "min": 0,
            "max": 100_000,
        },
    )


@dataclass(frozen=True)
class _Taken:
    """A photograph that was read, or `unusable`: why it was not. inside: the share of it that its
    mask keeps."""

    photo: Photo | None = None
    measures: Measures | None = None
    unusable: str = ""
    alpha: bool = False
    inside: float = 1.0
    mask_scaled: bool = False
    hdr: bool = False
    bad_profile: bool = False


def run(
    inputs: Mapping[str, Any], settings: IngestSettings, folder: Path, report: Report
) -> Capture:
    """Read the photographs in the folder inputs["photos"]; see the module's docstring.

    Leaves in `folder`: photos/ (the normalised pictures), masks/ (where there are any) and
    capture.json (`load` reads it). Raises SplatError for a folder without at least 3 usable
    photographs and for masks that do not fit them, and Interrupted.
    """
    from stages.photos import advice, capture_file, find, masking, masks
    from stages.photos.quality import near_duplicates
    from stages.scene import Capture

    root = Path(inputs["photos"])
    apart = masks.mask_folder(root, settings.masks)
    found = find.find(root, apart)
    masks.check_pairing(found, apart, settings.masks)
    folder.mkdir(parents=True, exist_ok=True)
    taken = _take_all(found, settings, folder, report)
    names = [source.name for source in found.sources]
    for source in found.videos:
        frames = _frames_of(source, settings, folder, report)
        names += [one.photo.name if one.photo else source.name for one in frames]
        taken += frames
    reasons = [(n, t.unusable) for n, t in zip(names, taken, strict=True) if t.photo is None]
    advice.about_files(found, report.warn)
    advice.about_left_out(reasons, report.warn)
    photos = tuple(t.photo for t in taken if t.photo is not None)
    if len(photos) < FEWEST_PHOTOGRAPHS:
        raise _too_few(root, len(photos), reasons)
    advice.about_conversions(
        [n for n, t in zip(names, taken, strict=True) if t.hdr],
        [n for n, t in zip(names, taken, strict=True) if t.bad_profile],
        report.warn,
    )
    inside = [t.inside for t in taken if t.photo is not None]
    masking.check_shares(photos, inside, bool(found.masks))
    advice.about_masks(
        photos,
        [n for n, t in zip(names, taken, strict=True) if t.alpha],
        [n for n, t in zip(names, taken, strict=True) if t.mask_scaled],
        found.stray_masks,
        report.warn,
    )
    duplicates = near_duplicates([t.measures.thumbnail for t in taken if t.measures is not None])
    photos = _with_twins(photos, duplicates)
    _report_capture(photos, duplicates, report)
    report.metric("left_out", len(reasons))
    report.metric("files_ignored", found.others)
    capture = Capture(folder, photos)
    capture_file.save_capture(capture)
    return capture


def load(folder: Path) -> Capture:
    """The capture of a finished folder; pictures are not opened."""
    from stages.photos.capture_file import load_capture

    return load_capture(folder)


def _take_all(
    found: Findings, settings: IngestSettings, folder: Path, report: Report
) -> list[_Taken]:
    """Each source read, measured and written, in order, a few at a time."""
    from stages.photos.decode import PixelBudget, readers_set_up

    budget = PixelBudget(_PIXELS_AT_ONCE)
    taken: list[_Taken] = []
    total = len(found.sources)
    report.progress(0, total, "reading photographs")
    with readers_set_up(), ThreadPoolExecutor(threads.count()) as pool:
        futures: list[Future[_Taken]] = [
            pool.submit(_take, source, found.masks.get(source.name), settings, folder, budget)
            for source in found.sources
        ]
        try:
            for done, (source, future) in enumerate(zip(found.sources, futures, strict=True), 1):
                taken.append(future.result())
                report.progress(done, total, source.name)
                if report.stop_requested.is_set() and done < total:
                    raise Interrupted(f"stopped after {done} of {total} photographs")
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    return taken


def _take(
    source: Source, mask: Path | None, settings: IngestSettings, folder: Path, budget: PixelBudget
) -> _Taken:
    """Read one photograph and its mask, and keep it."""
    from stages.photos.decode import Unusable, decode

    try:
        decoded = decode(source.path, settings.max_side, budget)
    except Unusable as finding:
        return _Taken(unusable=str(finding))
    return _kept(source.name, source.image, decoded, settings, folder, mask)


def _frames_of(
    source: Source, settings: IngestSettings, folder: Path, report: Report
) -> list[_Taken]:
    """The chosen frames of a video, kept as photographs of one camera."""
    from stages.photos import video_frames
    from stages.photos.decode import Unusable

    try:
        chosen = video_frames.photographs(source, settings.frames, settings.max_side, report)
        return [
            _kept(
                f"{source.name}/{number}",
                f"{source.image}/{number}",
                decoded,
                settings,
                folder,
                film=source.name,
            )
            for number, decoded in chosen
        ]
    except Unusable as finding:
        return [_Taken(unusable=str(finding))]


def _kept(
    name: str,
    image: str,
    decoded: Decoded,
    settings: IngestSettings,
    folder: Path,
    mask: Path | None = None,
    film: str = "",
) -> _Taken:
    """Write a normalised picture and its mask, and measure it. film: the video that it comes
    from."""
    from stages.photos.masking import MaskedPhoto
    from stages.photos.quality import measure
    from stages.photos.write import write_mask, write_picture
    from stages.scene import Photo

    masked = MaskedPhoto.of(decoded, name, mask, settings.invert_masks, settings.mask_means)
    decoded = masked.decoded
    target = folder / image
    target.parent.mkdir(parents=True, exist_ok=True)
    write_picture(target, decoded)
    if masked.mask is not None:
        write_mask(folder / masked.file(image), masked.mask)
    measures = measure(decoded.pixels, masked.mask)
    height, width = decoded.pixels.shape[:2]
    exif = decoded.exif
    focal = exif.focal_px(decoded.stored, width, height)
    photo = Photo(
        name=name,
        image=image,
        width=width,
        height=height,
        focal_px=round(focal, 3) if focal is not None else None,
        camera=_film_key(film, width, height) if film else exif.camera_key(width, height),
        sharpness=measures.sharpness,
        log2_luminance=measures.log2_luminance,
        exposure_ev=round(exif.exposure_ev, 3) if exif.exposure_ev is not None else None,
        gps=exif.gps,
        mask=masked.file(image),
        outside=masked.outside,
    )
    return _Taken(
        photo,
        measures,
        alpha=decoded.alpha is not None,
        inside=masked.share,
        mask_scaled=masked.scaled,
        hdr=decoded.hdr,
        bad_profile=decoded.bad_profile,
    )


def _film_key(film: str, width: int, height: int) -> str:
    """As `Exif.camera_key`: a film has a lens of its own, and is no other make of camera."""
    return f"video, {width}x{height} {film.replace(',', ' ')}"


def _with_twins(photos: tuple[Photo, ...], groups: list[tuple[int, ...]]) -> tuple[Photo, ...]:
    """The photographs, each of a group of near-duplicates knowing the group's first."""
    first = {index: photos[group[0]].name for group in groups for index in group}
    return tuple(replace(photo, duplicate_of=first.get(i, "")) for i, photo in enumerate(photos))


def _report_capture(
    photos: tuple[Photo, ...], duplicates: list[tuple[int, ...]], report: Report
) -> None:
    import numpy as np

    from stages.photos import advice

    blurred = advice.about_capture(photos, duplicates, report.warn)
    known = [photo.exposure_ev for photo in photos if photo.exposure_ev is not None]
    report.metric("photographs", len(photos))
    report.metric("with_focal_length", sum(photo.focal_px is not None for photo in photos))
    report.metric("masked", sum(bool(photo.mask) for photo in photos))
    report.metric("cameras", len({photo.camera for photo in photos}))
    report.metric("blurred", len(blurred))
    report.metric("near_duplicates", sum(len(group) - 1 for group in duplicates))
    report.metric("exposure_range_stops", round(max(known) - min(known), 2) if known else None)
    medians = np.median([[p.sharpness, p.log2_luminance] for p in photos], axis=0)
    report.metric("median_sharpness", round(float(medians[0]), 3))
    report.metric("median_log2_luminance", round(float(medians[1]), 3))


def _too_few(root: Path, usable: int, reasons: list[tuple[str, str]]) -> SplatError:
    if root.is_file() and reasons:
        return SplatError(
            "ingest-video-unusable",
            given=f"{root} cannot be used: {reasons[0][1]}.",
            wanted="A video with pictures that decode.",
            hint="Copy it from the camera again, or export it anew as H.264 or HEVC.",
        )
    given = f"{root} holds {counted(usable, 'usable photograph')}."
    if reasons:
        few = "; ".join(f"{name}: {why}" for name, why in reasons[:3])
        more = f"; and {len(reasons) - 3} more" if len(reasons) > 3 else ""
        given = f"{given[:-1]}; {len(reasons)} could not be read ({few}{more})."
    return SplatError(
        "ingest-too-few-photographs",
        given=given,
        wanted=f"At least {FEWEST_PHOTOGRAPHS}; 20 to 50 do an object or a room well.",
        hint="Take photographs in small steps around the scene, with 60-80 % overlap.",
    )


STAGE = Stage(name="ingest", version=5, reads=(), settings_type=IngestSettings, run=run, load=load)
