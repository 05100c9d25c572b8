"""Stage 1: photographs -> Capture: upright 8-bit sRGB pictures, and what EXIF says about them.

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
from stages.ingest.panorama import SPHERE, hint_for, look_decides, panorama
from stages.ingest.quality import Measures, measure, near_duplicates
from stages.ingest.settings import IngestSettings
from stages.ingest.sources import DepthFile, Findings, Source
from stages.ingest.turns import with_turns
from stages.ingest.write import write_depth, write_photo
from stages.scene import TRANSPARENT, Capture, Photo

FEWEST_PHOTOGRAPHS = 3
_PIXELS_AT_ONCE = 250_000_000  # over all threads; about 4 bytes each while they are decoded


@dataclass(frozen=True)
class _Ingested:
    """A file or a frame: the photographs made of it, or why it cannot be used.

    Args:
        name: of the file, or of the frame.
        photos: the photograph, or the faces of a panorama; () for a file that cannot be used.
        measures: of the picture.
        error: why the file cannot be used.
        inside: share of the picture that its mask keeps.
        remarks: codes of `advice.TEXTS` that apply to it.
        bad_depth: why its depth map cannot be used.
        looks: whether it looks like a panorama, if nothing else says whether it is one.
    """

    name: str
    photos: tuple[Photo, ...] = ()
    measures: Measures | None = None
    error: Unusable | None = None
    inside: float = 1.0
    remarks: tuple[str, ...] = ()
    bad_depth: Unusable | None = None
    looks: bool | None = None


@dataclass(frozen=True)
class _Picture:
    """A picture to write.

    Args:
        name: of the file, or of the frame.
        image: as in `Photo`.
        decoded: its pixels.
        mask: file of its mask.
        mask_as_stored: see `Findings.masks_as_stored`.
        video: that it is a frame of; "" for a photograph.
        sphere: whether it shows the whole sphere.
    """

    name: str
    image: str
    decoded: Decoded
    mask: Path | None = None
    mask_as_stored: bool = False
    video: str = ""
    sphere: bool = False


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
    found, turn_unknown = with_turns(found)
    cut_out = _masks_cut_out(found, settings)
    if cut_out:
        settings = replace(settings, mask_means=TRANSPARENT)
    folder.mkdir(parents=True, exist_ok=True)
    ingested = _ingest_photographs(found, settings, folder, report)
    for source in found.videos:
        ingested += _ingest_video(source, settings, folder, report)
    unusable = [(one.name, str(one.error), one.error.hint) for one in ingested if one.error]
    copied = "Copy the files themselves"
    unusable += [(name, why, copied) for name, why in found.not_files.items()]
    advice.about_left_out("ingest-left-out", unusable, report.warn)
    bad = [(one.name, str(one.bad_depth), one.bad_depth.hint) for one in ingested if one.bad_depth]
    advice.about_left_out("ingest-depth-left-out", bad, report.warn)
    usable = [one for one in ingested if one.photos]
    if len(usable) < FEWEST_PHOTOGRAPHS:
        raise advice.too_few(root, len(usable), FEWEST_PHOTOGRAPHS, unusable)
    pictures = tuple(replace(one.photos[0], name=one.name) for one in usable)
    files = bool(found.masks or settings.rig_mask)
    masking.check_shares(pictures, [one.inside for one in usable], files)
    remarks = _remarks(usable, pictures, settings, cut_out) | advice.unused_files(found)
    advice.about_names(remarks | {"ingest-mask-turn-unknown": turn_unknown}, report.warn)
    duplicates = near_duplicates([one.measures.thumbnail for one in usable if one.measures])
    first = {usable[i].name: usable[group[0]].name for group in duplicates for i in group}
    photos = (photo for one in usable for photo in one.photos)
    photos = (replace(photo, duplicate_of=first.get(photo.source, "")) for photo in photos)
    _report_capture(pictures, report)
    report.metric("near_duplicates", sum(len(group) - 1 for group in duplicates))
    report.metric("left_out", len(unusable))
    report.metric("files_ignored", found.others)
    capture = Capture(folder, tuple(photos))
    capture_file.save_capture(capture)
    return capture


def load(folder: Path) -> Capture:
    """The capture of a finished folder; pictures are not opened."""
    return load_capture(folder)


def _remarks(
    usable: Sequence[_Ingested],
    pictures: Sequence[Photo],
    settings: IngestSettings,
    cut_out: bool,
) -> dict[str, Sequence[str]]:
    """Names of the pictures that each warning is about. cut_out: whether mask files do that."""
    names = [picture.name for picture in pictures]
    bare = [picture.name for picture in pictures if not picture.mask]
    unused = settings.rig_mask is not None and not any(picture.face for picture in pictures)
    return {code: [one.name for one in usable if code in one.remarks] for code in advice.TEXTS} | {
        "ingest-masks-cut-out": names if cut_out else (),
        "ingest-mask-missing": bare if len(bare) < len(names) else (),
        "ingest-rig-mask-unused": [str(settings.rig_mask)] if unused else (),
    }


def _masks_cut_out(files: Findings, settings: IngestSettings) -> bool:
    """Whether mask files cut out an object, and --mask-means does not say otherwise.

    All photographs must have masks; one without a mask would show everything around the object.
    """
    masks = [files.masks[one.name] for one in files.sources if one.name in files.masks]
    decided = settings.mask_means != AUTO or bool(files.videos)
    return (
        not decided
        and len(masks) == len(files.sources)
        and cuts_out_object(masks, settings.invert_masks)
    )


def _ingest_photographs(
    files: Findings, settings: IngestSettings, folder: Path, report: Report
) -> list[_Ingested]:
    """All photographs, in order.

    An object before a plain wall can look like a panorama. So pictures that look like one are taken
    for panoramas unless more of their shape do not.
    """
    ingested = _read_photographs(files.sources, None, files, settings, folder, report)
    waiting = [i for i, one in enumerate(ingested) if one.looks]
    if waiting:
        spheres = len(waiting) >= sum(one.looks is False for one in ingested)
        sources = [files.sources[i] for i in waiting]
        read = _read_photographs(sources, spheres, files, settings, folder, report)
        for i, one in zip(waiting, read, strict=True):
            remarks = one.remarks if spheres else (*one.remarks, "ingest-panorama-unclear")
            ingested[i] = replace(one, remarks=remarks)
    return ingested


def _read_photographs(
    sources: Sequence[Source],
    spheres: bool | None,
    files: Findings,
    settings: IngestSettings,
    folder: Path,
    report: Report,
) -> list[_Ingested]:
    """Photographs, in order; a few are read at once. spheres: see `_ingest_photograph`."""
    budget = PixelBudget(_PIXELS_AT_ONCE)
    ingested: list[_Ingested] = []
    total = len(sources)
    report.progress(0, total, "reading photographs")
    with readers_set_up(), ThreadPoolExecutor(threads.count()) as pool:
        futures: list[Future[_Ingested]] = [
            pool.submit(_ingest_photograph, source, spheres, files, settings, folder, budget)
            for source in sources
        ]
        try:
            for done, (source, future) in enumerate(zip(sources, futures, strict=True), 1):
                ingested.append(future.result())
                report.progress(done, total, source.name)
                if report.stop_requested.is_set() and done < total:
                    raise Interrupted(f"stopped after {done} of {total} photographs")
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    return ingested


def _ingest_photograph(
    source: Source,
    spheres: bool | None,
    files: Findings,
    settings: IngestSettings,
    folder: Path,
    budget: PixelBudget,
) -> _Ingested:
    """spheres: whether a picture that only looks like a panorama is one; None to leave it for
    later, with `_Ingested.looks`."""
    looks = None
    try:
        decoded = decode(source.path, settings.max_side, budget)
        about = decoded.pixels, decoded.stored, decoded.exif.projection
        kind = panorama(*about)
        if look_decides(*about):
            looks = kind == SPHERE
            if looks and spheres is None:
                return _Ingested(source.name, looks=True)
            kind = "" if looks and not spheres else kind
        if kind == SPHERE:
            decoded = decode(source.path, int(faces.WIDTHS * settings.max_side), budget)
        elif kind:
            raise Unusable(f"it is {kind}", hint_for(kind))
        mask = files.masks.get(source.name)
        picture = _Picture(
            source.name,
            source.image,
            decoded,
            mask,
            mask_as_stored=files.masks_as_stored,
            sphere=kind == SPHERE,
        )
        done = replace(_write(picture, settings, folder), looks=looks)
    except Unusable as error:
        return _Ingested(source.name, error=error)
    depth = files.depths.get(source.name)
    if depth is None:
        return done
    return _with_depth(done, depth, decoded, files.depths_as_stored, folder)


def _with_depth(
    done: _Ingested, file: DepthFile, decoded: Decoded, as_stored: bool, folder: Path
) -> _Ingested:
    """Write the depth map of a photograph; returns the photograph with it, or with the reason why
    the map cannot be used. as_stored: see `Findings.depths_as_stored`."""
    photo = done.photos[0]
    place = f"{FOLDERS[0]}/{photo.picture}.npy"
    try:
        if photo.face is not None:
            raise Unusable("it is a 360-degree picture", "Give maps of photographs only")
        write_depth(folder / place, read_depth(file, decoded, as_stored))
    except Unusable as error:
        return replace(done, bad_depth=error)
    return replace(done, photos=(replace(photo, depth=place),))


def _ingest_video(
    source: Source, settings: IngestSettings, folder: Path, report: Report
) -> list[_Ingested]:
    """The chosen frames of a video, as photographs of one camera."""
    try:
        kind, chosen = video_frames.photographs(source, settings.frames, settings.max_side, report)
        name, image, sphere = source.name, source.image, kind == SPHERE
        pictures = (
            _Picture(f"{name}/{number}", f"{image}/{number}", decoded, video=name, sphere=sphere)
            for number, decoded in chosen
        )
        return [_write(picture, settings, folder) for picture in pictures]
    except Unusable as error:
        return [_Ingested(source.name, error=error)]


def _write(picture: _Picture, settings: IngestSettings, folder: Path) -> _Ingested:
    """Write a normalised picture and its mask, or the faces of a panorama, and measure it. Raises
    Unusable if a mask leaves no face. folder: of the stage's output."""
    name = picture.name
    masked = MaskedPhoto.of(
        picture.decoded,
        name,
        picture.mask,
        settings.invert_masks,
        settings.mask_means,
        picture.mask_as_stored,
    )
    if picture.sphere and settings.rig_mask is not None:
        masked = masked.without(settings.rig_mask, name)
    decoded = masked.decoded
    measures = measure(decoded.pixels, masked.mask)
    photo = _photo(picture, masked, measures)
    parts = face_photos(photo, masked) if picture.sphere else ((photo, masked),)
    photos = tuple(write_photo(part, masked_part, folder) for part, masked_part in parts)
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


def _photo(picture: _Picture, masked: MaskedPhoto, measures: Measures) -> Photo:
    """What is known of a picture."""
    decoded, exif = masked.decoded, masked.decoded.exif
    height, width = decoded.pixels.shape[:2]
    focal = exif.focal_px(decoded.stored, width, height)
    return Photo(
        name=picture.name,
        image=picture.image,
        width=width,
        height=height,
        focal_px=round(focal, 3) if focal is not None else None,
        camera=_camera_key(picture, masked),
        sharpness=measures.sharpness,
        log2_luminance=measures.log2_luminance,
        exposure_ev=round(exif.exposure_ev, 3) if exif.exposure_ev is not None else None,
        gps=exif.gps.position,
        gps_height=exif.gps.height,
        gps_error_m=exif.gps.error_m,
        mask=masked.file(picture.image),
        outside=masked.outside,
    )


def _camera_key(picture: _Picture, masked: MaskedPhoto) -> str:
    """`Exif.camera_key`, or one like it for a video: its frames share a lens of their own."""
    height, width = masked.decoded.pixels.shape[:2]
    if picture.video:
        return f"video, {width}x{height} {picture.video.replace(',', ' ')}"
    return masked.decoded.exif.camera_key(width, height)


def _report_capture(photos: tuple[Photo, ...], report: Report) -> None:
    blurred = advice.about_capture(photos, report.warn)
    report.metric("photographs", len(photos))
    report.metric("panoramas", sum(photo.face is not None for photo in photos))
    report.metric("with_focal_length", sum(photo.focal_px is not None for photo in photos))
    report.metric("masked", sum(bool(photo.mask) for photo in photos))
    report.metric("cameras", len({photo.camera for photo in photos}))
    report.metric("blurred", len(blurred))
