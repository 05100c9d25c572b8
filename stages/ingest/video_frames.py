"""Photographs from a video. It is read twice: to measure all frames, and to keep those selected."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.base.text import counted
from stages.ingest import faces
from stages.ingest.decode import Decoded, Unusable
from stages.ingest.exif import Exif
from stages.ingest.frame_selection import (
    BLURRED_BELOW,
    MAX_FRAMES,
    MAX_GAP,
    MEASURED_SIDE_PX,
    STEP,
    FrameMeter,
    MeasuredFrame,
    SelectedFrame,
    select_frames,
)
from stages.ingest.panorama import SPHERE, hint_for, panorama
from stages.ingest.sources import Source
from stages.ingest.video import Video

_EXAMINED = 15  # every such frame is examined for being a panorama


def photographs(
    source: Source, wanted: int, max_side: int, report: Report
) -> tuple[str, Iterator[tuple[str, Decoded]]]:
    """(`panorama.SPHERE` or "", (name within the video, picture) of the selected frames, at most
    `wanted`; 0 selects by motion). The report's metric "videos" says which were selected and why.

    Raises Unusable for a file without frames that decode, and of fisheye pictures, and Interrupted.
    """
    video = Video(source.path)
    seen, colours, kind = _measured(video, source.name, report)
    if kind not in ("", SPHERE):
        raise Unusable(f"it is {kind}", hint_for(kind))
    chosen = select_frames(seen, wanted)
    facts = _facts(source.name, video, seen, chosen, colours)
    report.metric("videos", [*report.metrics.get("videos", []), facts])
    _warn(source.name, video, seen, chosen, colours, wanted == 0, report)
    numbers = [one.number for one in chosen]
    side = int(faces.WIDTHS * max_side) if kind else max_side

    def taken() -> Iterator[tuple[str, Decoded]]:
        for frame in video.frames():
            if frame.number in numbers:
                _tick(report, frame.number, len(seen), f"taking frames of {source.name}")
                yield f"{frame.number:06d}.jpg", Decoded(frame.srgb(side), frame.size, Exif())
            if frame.number >= numbers[-1]:
                return

    return kind, taken()


def _measured(video: Video, name: str, report: Report) -> tuple[list[MeasuredFrame], str, str]:
    """(measurements of every frame, how its colours are converted to sRGB, which kind of panorama
    most frames are)."""
    meter, seen, colours, kinds = FrameMeter(), [], "", Counter[str]()
    total = video.about_frames()
    for frame in video.frames():
        _tick(report, frame.number, max(total, frame.number + 1), f"measuring frames of {name}")
        colours = frame.colours.conversion
        grey = frame.grey(MEASURED_SIDE_PX)
        seen.append(meter.measure(grey, frame.seconds))
        if frame.number % _EXAMINED == 0:
            kinds[panorama(grey[..., None], frame.size, "")] += 1
    return seen, colours, kinds.most_common(1)[0][0]


def _tick(report: Report, done: int, total: int, label: str) -> None:
    if report.stop_requested.is_set():
        raise Interrupted(f"stopped at frame {done} of about {total}")
    report.progress(done, total, label)


def _facts(
    name: str, video: Video, seen: list[MeasuredFrame], chosen: list[SelectedFrame], colours: str
) -> dict[str, Any]:
    """For the manifest: which frames were selected, and why."""
    return {
        "name": name,
        "frames": len(seen),
        "seconds": round(seen[-1].seconds, 3),
        "damaged_packets": video.damaged,
        "missing_seconds": round(video.missing_s, 1),
        "colours": colours,
        "chosen_by": f"the sharpest in each stretch of equal motion; a frame with less than "
        f"{BLURRED_BELOW} of its neighbours' sharpness is blurred, and used only where the "
        f"picture would otherwise move by more than {MAX_GAP} of its longer side",
        "chosen": [vars(one) for one in chosen],
    }


def _warn(
    name: str,
    video: Video,
    seen: list[MeasuredFrame],
    chosen: list[SelectedFrame],
    colours: str,
    automatic: bool,
    report: Report,
) -> None:
    if video.missing_s or video.damaged:
        lost = f", {video.missing_s:.0f} s at its end are missing" if video.missing_s else ""
        report.warn(
            "ingest-video-damaged",
            f"{name} is damaged{lost}: {counted(len(seen), 'frame')} could be read, as far as "
            f"{seen[-1].seconds:.1f} s. Copy it from the camera again.",
        )
    if "BT.2100" in colours:
        report.warn("ingest-video-hdr", f"{name} is of high dynamic range: {colours}.")
    blurred = [one for one in chosen if one.sharpness < BLURRED_BELOW]
    if blurred:
        at = ", ".join(f"{one.seconds:.1f} s" for one in blurred[:8])
        report.warn(
            "ingest-video-blurred",
            f"{name} has no sharp frame near {at}. Move more slowly, with more light.",
        )
    moved = sum(one.moved for one in chosen)
    if automatic and moved > 2 * STEP * MAX_FRAMES:
        report.warn(
            "ingest-video-long",
            f"{name} moves so far that its {len(chosen)} frames are {moved / len(chosen):.2f} of a "
            "picture apart. --frames takes more.",
        )
