"""Video against the truth: `python -m tests.benchmarks.film FOLDER`.

Films the sample scene on a walk around the table, held by hand, 300 frames in H.264, a fifth of
them blurred in bursts; takes frames and finds cameras as `splat` does; compares their poses with
the truth and with what the sample's photographs give. The film, which takes a quarter of an hour,
is kept in FOLDER.
"""

from __future__ import annotations

import argparse
import json
from functools import cache
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from sample_captures.make import ARC_DEGREES, HERE, LENS, TARGET, look_at, scene
from sample_captures.render import Array, hit, linear_to_srgb, srgb_to_linear, surface
from stages.base.stage import Report
from stages.ingest import stage as ingest
from stages.ingest.settings import IngestSettings
from stages.scene import Reconstruction
from stages.sfm import stage as sfm
from stages.sfm.settings import SfmSettings
from tests.sfm.truth import centres, similarity

FRAMES, FPS, CRF = 300, 30, 20
BLURRED_SHARE, BURST = 0.2, 5  # of the frames; frames in a row
BLUR_PX = (7, 15)
_SUB_SAMPLES = ((0.25, 0.25), (0.75, 0.75))  # within a pixel


def walk(frames: int = FRAMES) -> NDArray[np.float64]:
    """[F, 4, 4] world_to_camera: once along the sample's arc, up and down, trembling a little."""
    rng = np.random.default_rng(5)
    tremble = cv2.GaussianBlur(rng.normal(size=(frames, 6)), (1, 31), 4.0) * 0.02
    poses = []
    for i in range(frames):
        angle = np.radians(-90 + ARC_DEGREES * (i / (frames - 1) - 0.5))
        rise = np.sin(2 * np.pi * 2.5 * i / frames)
        distance = 1.35 - 0.07 * rise
        eye = np.array([distance * np.cos(angle), -0.6 - 0.26 * rise, distance * np.sin(angle)])
        poses.append(look_at(eye + tremble[i, :3], np.array(TARGET) + tremble[i, 3:]))
    return np.array(poses)


def picture(pose: NDArray[np.float64]) -> NDArray[np.uint8]:
    """[H, W, 3] the scene's own colours, evenly lit: shadows would take ten times as long."""
    eye = (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32)
    total = np.zeros((3, LENS.width * LENS.height), np.float32)
    for dx, dy in _SUB_SAMPLES:
        total += srgb_to_linear(_colours(eye, LENS.rays(pose, dx, dy))) / len(_SUB_SAMPLES)
    shown = linear_to_srgb(total).T.reshape(LENS.height, LENS.width, 3)
    return np.round(shown * 255).astype(np.uint8)


def _colours(eye: Array, rays: Array) -> Array:
    distances = np.stack([hit(shape, eye[:, None], rays) for shape in scene()])
    nearest, reach = distances.argmin(0), distances.min(0)
    colours = np.zeros_like(rays)
    for index, shape in enumerate(scene()):
        rows = np.nonzero(nearest == index)[0]
        if len(rows):
            colours[:, rows] = surface(shape, eye[:, None] + rays[:, rows] * reach[rows])[1]
    return colours


@cache
def blurs(frames: int = FRAMES) -> dict[int, NDArray[np.float32]]:
    """Kernel by frame: a fifth of the frames, in bursts, smeared along a line."""
    rng = np.random.default_rng(3)
    kernels: dict[int, NDArray[np.float32]] = {}
    while len(kernels) < BLURRED_SHARE * frames:
        start, angle = rng.integers(0, frames - BURST), rng.uniform(0, np.pi)
        for i in range(start, start + rng.integers(1, BURST + 1)):
            length = rng.uniform(*BLUR_PX)
            kernel = np.zeros((17, 17), np.float32)
            along = np.array([np.cos(angle), np.sin(angle)]) * length / 2
            a, b = (((8 + sign * along) * 16).astype(int).tolist() for sign in (-1, 1))
            cv2.line(kernel, a, b, 1.0, 1, cv2.LINE_AA, 4)
            kernels[int(i)] = kernel / kernel.sum()
    return kernels


def make_film(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = LENS.width, LENS.height, "yuv420p"
        stream.options = {"crf": str(CRF)}
        stream.codec_context.colorspace = 1
        for number, pose in enumerate(walk()):
            shown = picture(pose)
            if number in blurs():
                shown = np.asarray(cv2.filter2D(shown, -1, blurs()[number]), np.uint8)
            frame = av.VideoFrame.from_ndarray(shown, format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))
            print(f"{number + 1} of {FRAMES} frames", end="\r", flush=True)
        container.mux(stream.encode(None))


def reconstructed(photos: Path, out: Path) -> tuple[Reconstruction, Report]:
    report = Report()
    capture = ingest.run({"photos": photos}, IngestSettings(), out / "1-ingest", report)
    found = sfm.run({"ingest": capture}, SfmSettings(), out / "2-sfm", Report())
    return found, report


def errors(found: Reconstruction, true: NDArray[np.float64]) -> dict[str, float]:
    """Of the cameras of `found`, in order, against world_to_camera `true` [V, 4, 4] in metres."""
    poses = np.array([view.camera.world_to_camera for view in found.views])
    rotation, scale, shift = similarity(centres(poses), centres(true))
    apart = np.linalg.norm(scale * centres(poses) @ rotation.T + shift - centres(true), axis=1)
    turns = np.einsum("vij,jk,vlk->vil", true[:, :3, :3], rotation, poses[:, :3, :3])
    cosine = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return {
        "mm_mean": round(1e3 * float(apart.mean()), 3),
        "mm_most": round(1e3 * float(apart.max()), 3),
        "degrees_mean": round(float(degrees.mean()), 4),
        "degrees_most": round(float(degrees.max()), 4),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    film = folder / "walk.mp4"
    if not film.exists():
        make_film(folder / "partial.mp4")
        (folder / "partial.mp4").rename(film)
    found, report = reconstructed(film, folder / "film")
    facts = report.metrics["videos"][0]
    chosen = [one["number"] for one in facts["chosen"]]
    print(f"{len(chosen)} frames chosen, {len(found.views)} placed")
    print(f"blurred among the chosen: {[n for n in chosen if n in blurs()]}")
    numbers = [int(Path(view.name).stem) for view in found.views]
    print("film       ", errors(found, walk()[numbers]))
    photographs, _ = reconstructed(HERE / "still_life" / "images", folder / "photographs")
    truth = json.loads((HERE / "still_life" / "truth.json").read_text(encoding="utf-8"))
    true = {p["name"]: np.array(p["world_to_camera"]) for p in truth["photos"]}
    print("photographs", errors(photographs, np.array([true[v.name] for v in photographs.views])))


if __name__ == "__main__":
    main()
