"""Stage 1: photographs -> Capture, each as upright 8-bit sRGB with what EXIF says of it.

Reads JPEG, PNG, TIFF, WebP, HEIC, AVIF and BMP from a folder and its sub-folders, in which nothing
is written, and takes sharp frames from videos. Warnings say what a photographer should change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stages.base import threads
from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.ingest import advice, capture_file, depth_files, faces, masking, video_frames
from stages.ingest.capture_file import load_capture
from stages.ingest.decode import Decoded, PixelBudget, Unusable, decode, readers_set_up
from stages.ingest.depth_files import FOLDERS, read_depth
from stages.ingest.faces import face_photos
from stages.ingest.find import find
from stages.ingest.masking import AUTO, MaskedPhoto, cuts_out_object
from stages.ingest.masks import check_pairing, check_rig_mask, mask_folder
from stages.ingest.panorama import SPHERE, hint_for, panorama
from stages.ingest.quality import Measures, measure, near_duplicates
from stages.ingest.settings import IngestSettings
from stages.ingest.sources import DepthFile, Findings, Source
from stages.ingest.write import write_depth, write_photo
from stages.scene import TRANSPARENT, Capture, Photo

FEWEST_PHOTOGRAPHS = 3
_PIXELS_AT_ONCE = 250_000_000  # over all threads; about 4 bytes each while they are decoded


@dataclass(frozen=True)
class _Ingested:
    """A photograph that was read and written, or why it cannot be used.

    Args:
        name: of the file, or of the frame.
        photos: the photograph, or the faces of a panorama; () for a file that cannot be used.
        measures: of the picture.
        error: why the file cannot be used.
        inside: share of the picture that its mask keeps.
        remarks: codes of `advice.TEXTS` that apply to it.
        bad_depth: why its depth map cannot be used.
    """

    name: str
    photos: tuple[Photo, ...] = ()
    measures: Measures | None = None
    error: Unusable | None = None
    inside: float = 1.0
    remarks: tuple[str, ...] = ()
    bad_depth: Unusable | None = None


def run(
    inputs: Mapping[str, Any], settings: IngestSettings, folder: Path, report: Report
) -> Capture:
    """Read the photographs in the folder inputs["photos"].

    Writes to `folder`: photos/ (the normalised pictures), masks/ and depth/ (where there are any)
    and capture.json (`load` reads it).

    Raises:
        SplatError: there are fewer than 3 usable photographs, or masks or --depth do not fit them.
        Interrupted: the user stopped it.
    """
    root = Path(inputs["photos"])
    check_rig_mask(settings.rig_mask)
    apart = mask_folder(root, settings.masks)
    found = find(root, apart, depth_files.depth_source(root, settings.depth))
    check_pairing(found, apart, settings.masks)
    depth_files.check_paired(found, settings.depth)
    cut_out = _masks_cut_out(found, settings)
    if cut_out:
        settings = replace(settings, mask_means=TRANSPARENT)
    folder.mkdir(parents=True, exist_ok=True)
    ingested = _ingest_photographs(found, settings, folder, report)
    for source in found.videos:
        ingested += _ingest_video(source, settings, folder, report)
    unusable = [(one.name, str(one.error), one.error.hint) for one in ingested if one.error]
    advice.about_left_out("ingest-left-out", unusable, report.warn)
    bad = [(one.name, str(one.bad_depth), one.bad_depth.hint) for one in ingested if one.bad_depth]
    advice.about_left_out("ingest-depth-left-out", bad, report.warn)
    usable = [one for one in ingested if one.photos]
    if len(usable) < FEWEST_PHOTOGRAPHS:
        raise advice.too_few(root, len(usable), FEWEST_PHOTOGRAPHS, unusable)
    pictures = tuple(replace(one.photos[0], name=one.name) for one in usable)
    photos = tuple(photo for one in usable for photo in one.photos)
    files = bool(found.masks or settings.rig_mask)
    masking.check_shares(pictures, [one.inside for one in usable], files)
    bare = [picture.name for picture in pictures if not picture.mask]
    remarks: dict[str, Sequence[str]] = {
        code: [o.name for o in ingested if code in o.remarks] for code in advice.TEXTS
    }
    remarks |= {
        "ingest-masks-cut-out": [picture.name for picture in pictures] if cut_out else (),
        "ingest-mask-missing": bare if len(bare) < len(pictures) else (),
        "ingest-rig-mask-unused": _rig_mask_unused(photos, settings),
    }
    advice.about_names(remarks | advice.unused_files(found), report.warn)
    duplicates = near_duplicates([one.measures.thumbnail for one in usable if one.measures])
    first = {usable[i].name: usable[group[0]].name for group in duplicates for i in group}
    photos = tuple(replace(photo, duplicate_of=first.get(photo.source, "")) for photo in photos)
    _report_capture(pictures, duplicates, report)
    report.metric("left_out", len(unusable))
    report.metric("files_ignored", found.others)
    capture = Capture(folder, photos)
    capture_file.save_capture(capture)
    return capture


def load(folder: Path) -> Capture:
    """The capture of a finished folder; pictures are not opened."""
    return load_capture(folder)


def _masks_cut_out(found: Findings, settings: IngestSettings) -> bool:
    """Whether mask files cut out an object, and --mask-means does not say otherwise.

    All photographs must have masks: of the others everything would be seen.
    """
    masks = [found.masks[one.name] for one in found.sources if one.name in found.masks]
    decided = settings.mask_means != AUTO or bool(found.videos)
    return (
        not decided
        and len(masks) == len(found.sources)
        and cuts_out_object(masks, settings.invert_masks)
    )


def _ingest_photographs(
    found: Findings, settings: IngestSettings, folder: Path, report: Report
) -> list[_Ingested]:
    """All photographs, in order; a few are read at once."""
    budget = PixelBudget(_PIXELS_AT_ONCE)
    ingested: list[_Ingested] = []
    total = len(found.sources)
    report.progress(0, total, "reading photographs")
    with readers_set_up(), ThreadPoolExecutor(threads.count()) as pool:
        futures: list[Future[_Ingested]] = [
            pool.submit(_ingest_photograph, source, found, settings, folder, budget)
            for source in found.sources
        ]
        try:
            for done, (source, future) in enumerate(zip(found.sources, futures, strict=True), 1):
                ingested.append(future.result())
                report.progress(done, total, source.name)
                if report.stop_requested.is_set() and done < total:
                    raise Interrupted(f"stopped after {done} of {total} photographs")
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    return ingested


def _ingest_photograph(
    source: Source, found: Findings, settings: IngestSettings, folder: Path, budget: PixelBudget
) -> _Ingested:
    try:
        decoded = decode(source.path, settings.max_side, budget)
        kind = panorama(decoded.pixels, decoded.stored, decoded.exif.projection)
        if kind == SPHERE:
            decoded = decode(source.path, int(faces.WIDTHS * settings.max_side), budget)
        elif kind:
            raise Unusable(f"it is {kind}", hint_for(kind))
        mask = found.masks.get(source.name)
        done = _write(source.name, source.image, decoded, settings, folder, mask, kind=kind)
    except Unusable as error:
        return _Ingested(source.name, error=error)
    depth = found.depths.get(source.name)
    return done if depth is None else _with_depth(done, depth, decoded, folder)


def _with_depth(done: _Ingested, file: DepthFile, decoded: Decoded, folder: Path) -> _Ingested:
    """The photograph with its depth map, which is written, or with why that cannot be used."""
    photo = done.photos[0]
    place = f"{FOLDERS[0]}/{photo.picture}.npy"
    try:
        if photo.face is not None:
            raise Unusable("it is a 360-degree picture", "Give maps of photographs only")
        write_depth(folder / place, read_depth(file, decoded))
    except Unusable as error:
        return replace(done, bad_depth=error)
    return replace(done, photos=(replace(photo, depth=place),))


def _ingest_video(
    source: Source, settings: IngestSettings, folder: Path, report: Report
) -> list[_Ingested]:
    """The chosen frames of a video, as photographs of one camera."""
    try:
        kind, chosen = video_frames.photographs(source, settings.frames, settings.max_side, report)
        return [
            _write(
                f"{source.name}/{number}",
                f"{source.image}/{number}",
                decoded,
                settings,
                folder,
                video=source.name,
                kind=kind,
            )
            for number, decoded in chosen
        ]
    except Unusable as error:
        return [_Ingested(source.name, error=error)]


def _write(
    name: str,
    image: str,
    decoded: Decoded,
    settings: IngestSettings,
    folder: Path,
    mask: Path | None = None,
    video: str = "",
    kind: str = "",
) -> _Ingested:
    """Write a normalised picture and its mask, or the faces of a panorama, and measure it. Raises
    Unusable if a mask leaves no face.

    Args:
        name: of the file, or of the frame.
        image: as in `Photo`.
        decoded: the picture.
        settings: of the stage.
        folder: of the stage's output.
        mask: file of its mask.
        video: that it is a frame of.
        kind: `panorama.SPHERE` or "".
    """
    masked = MaskedPhoto.of(decoded, name, mask, settings.invert_masks, settings.mask_means)
    if kind == SPHERE and settings.rig_mask is not None:
        masked = masked.without(settings.rig_mask, name)
    decoded = masked.decoded
    measures = measure(decoded.pixels, masked.mask)
    photo = _photo(name, image, masked, measures, video)
    parts = face_photos(photo, masked) if kind == SPHERE else ((photo, masked),)
    photos = tuple(write_photo(part, picture, folder) for part, picture in parts)
    if not photos:
        raise Unusable("masks leave nothing of it", "Check the masks")
    remarks = {
        "ingest-transparency": decoded.alpha is not None and masked.outside == TRANSPARENT,
        "ingest-mask-scaled": masked.scaled,
        "ingest-hdr": decoded.hdr,
        "ingest-colour-profile": decoded.bad_profile,
        "ingest-gps-contradicts": decoded.exif.gps.contradicts,
    }
    codes = tuple(code for code, applies in remarks.items() if applies)
    return _Ingested(name, photos, measures, inside=masked.share, remarks=codes)


def _photo(name: str, image: str, masked: MaskedPhoto, measures: Measures, video: str) -> Photo:
    """What is known of a picture. Arguments as of `_write`."""
    decoded, exif = masked.decoded, masked.decoded.exif
    height, width = decoded.pixels.shape[:2]
    focal = exif.focal_px(decoded.stored, width, height)
    return Photo(
        name=name,
        image=image,
        width=width,
        height=height,
        focal_px=round(focal, 3) if focal is not None else None,
        camera=_video_key(video, width, height) if video else exif.camera_key(width, height),
        sharpness=measures.sharpness,
        log2_luminance=measures.log2_luminance,
        exposure_ev=round(exif.exposure_ev, 3) if exif.exposure_ev is not None else None,
        gps=exif.gps.position,
        gps_height=exif.gps.height,
        gps_error_m=exif.gps.error_m,
        mask=masked.file(image),
        outside=masked.outside,
    )


def _video_key(video: str, width: int, height: int) -> str:
    """As `Exif.camera_key`: each video has a lens of its own, and no make of camera."""
    return f"video, {width}x{height} {video.replace(',', ' ')}"


def _rig_mask_unused(photos: Sequence[Photo], settings: IngestSettings) -> Sequence[str]:
    unused = settings.rig_mask is not None and not any(photo.face for photo in photos)
    return (str(settings.rig_mask),) if unused else ()


def _report_capture(
    photos: tuple[Photo, ...], duplicates: list[tuple[int, ...]], report: Report
) -> None:

    blurred = advice.about_capture(photos, duplicates, report.warn)
    report.metric("photographs", len(photos))
    report.metric("panoramas", sum(photo.face is not None for photo in photos))
    report.metric("with_focal_length", sum(photo.focal_px is not None for photo in photos))
    report.metric("masked", sum(bool(photo.mask) for photo in photos))
    if any(photo.depth for photo in photos):
        report.metric("with_depth", sum(bool(photo.depth) for photo in photos))
    report.metric("cameras", len({photo.camera for photo in photos}))
    report.metric("blurred", len(blurred))
    report.metric("near_duplicates", sum(len(group) - 1 for group in duplicates))
