"""The captures that quality is measured on: `python -m tests.benchmarks.captures FOLDER [CLONES]`.

Says which of them FOLDER lacks and where they are published. With a folder of clones, named as the
repositories are, it copies what is missing from them. Nothing of them belongs into this repository.
"""

from __future__ import annotations

import argparse
import io
import json
import subprocess
import tarfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast

import numpy as np

from stages.cameras.nerfstudio import OPENGL_FROM_OURS

PICTURES = ("images", "masks")
_SUFFIXES = (".jpg", ".jpeg", ".png")
_STRECHA = "Benchmarking_Camera_Calibration_2008"
_TRUE_CAMERAS = "gt_dense_cameras"


@dataclass(frozen=True)
class Source:
    """Where a capture is published.

    Args:
        repository: on GitHub.
        folder: of the capture there.
        parts: files and folders of it that are copied. A pattern such as *.JPG stands for all
            files so named, which are copied into `images`.
        every: of the pictures of a folder, in the order of their names, the first and each so
            many-th after it.
        commit: where the newest one does not have it.
    """

    repository: str
    folder: str
    parts: tuple[str, ...] = ("images",)
    every: int = 1
    commit: str = "HEAD"

    @property
    def text(self) -> str:
        """Where it is, in words."""
        some = f", one picture in {self.every}" if self.every > 1 else ""
        where = f"{self.folder}: " if self.folder else ""
        where = where if self.commit == "HEAD" else f"commit {self.commit[:7]}, {where}"
        return f"https://github.com/{self.repository}, {where}{', '.join(self.parts)}{some}"


_LLFF = ("images", "poses_bounds.npy")
_NERF_SYNTHETIC = ("train", "test", "transforms_train.json", "transforms_test.json")
SOURCES = {
    "banana": Source("pierotofy/dataset_banana", ""),
    "plush": Source("noname0310/snowmiku2023plush-splat", "", ("input",)),
    "lego": Source("luo-ziyuan/CopyRNeRF-code", "data/nerf_synthetic/lego", _NERF_SYNTHETIC),
    "mic": Source(
        "skywolf829/GSTK",
        "data/mic",
        _NERF_SYNTHETIC,
        commit="cc9ace63c30d9bdbf9931b01786537316619821b",
    ),
    "chair": Source("rounak890/nerf_data", "", _NERF_SYNTHETIC),
    "fern": Source("luo-ziyuan/CopyRNeRF-code", "data/nerf_llff_data/fern", _LLFF),
    "horns": Source("Bussler/CustomNeRF", "data/horns", _LLFF),
    "kitchen": Source("facebookresearch/vggsfm", "examples/kitchen"),
    **{
        name: Source(
            "openMVG/SfM_quality_evaluation", f"{_STRECHA}/{name}", ("images", _TRUE_CAMERAS)
        )
        for name in ("fountain-P11", "Herz-Jesus-P25")
    },
    "bonsai": Source("EricXu23/Bonsaidownload", "", ("*.JPG",)),
    "table": Source("Scodive/Data", ""),
    "statue-of-liberty": Source("vork/StatueOfLiberty-Photogrammetry", "", PICTURES, every=3),
    # walks with a background: an object in a room, a room, buildings, a statue, a flight
    "kumamon": Source("ConsideringName/upload-files", ""),
    "plant": Source("lvllvl/NeRF", "data/raw", ("*.jpeg",), every=2),
    "lockers": Source("mamechun/gs_data", "", ("input",)),
    "south-building": Source("sbradley374/gaussian-splat-test", ""),
    "castle-P19": Source(
        "openMVG/SfM_quality_evaluation", f"{_STRECHA}/castle-P19", ("images", _TRUE_CAMERAS)
    ),
    "stitch": Source("jianzhengjie/Gaussian-Splatting-", "data/sparse/0"),
    "figure": Source("5697526/NeRF-TensoRF", ""),
    "copier": Source("rage147-OwO/instant-ngp", "aaa", every=2),
    "gum": Source("akristoffersen/Scene2Mesh", "real_scene_data/gum", ("train/*",), every=6),
    "alexander": Source("vork/alexanderTheGreat", ""),
    "office": Source("antoniocarevic/diplomski123", ""),
    "corridor": Source("PavanGavit/test", "", ("frames/*",), every=2),
    "tractor": Source(
        "Uddhav786/Enhancing-3D-Scene-Reconstruction-with-NeRF-and-NVIDIA-s-Instant-NGP", ""
    ),
    "city": Source("Zeus-Xu/NeRF-3DGS", ""),
}
# These took no part in any choice. They are run once for a table, and reported as they come out.
RUN_ONCE = (
    *("stitch", "figure", "copier", "gum", "alexander", "office", "corridor", "tractor", "city"),
)


def photographs_of(capture: Path) -> Path:
    """The folder of photographs in the folder of a capture."""
    found = (capture / name for name in ("images", "input"))
    return next((folder for folder in found if folder.is_dir()), capture)


def copy_from(clone: Path, source: Source, into: Path) -> None:
    """Copy a capture from a clone, bare or not. Raises CalledProcessError where it is not there."""
    tree = f"{source.commit}:{source.folder}" if source.folder else source.commit
    words = ["git", "-C", str(clone), "archive", tree, *source.parts]
    gathered = any("*" in part for part in source.parts)
    packed = subprocess.run(words, capture_output=True, check=True).stdout
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        files = [member for member in archive.getmembers() if member.isfile()]
        for member in chosen(files, source.every):
            path = into / (f"images/{Path(member.name).name}" if gathered else member.name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(cast(IO[bytes], archive.extractfile(member)).read())
    if _TRUE_CAMERAS in source.parts:
        write_true_cameras(into)


def chosen(files: Iterable[tarfile.TarInfo], every: int) -> list[tarfile.TarInfo]:
    """All files but pictures that are left out."""
    groups: dict[tuple[str, bool], list[tarfile.TarInfo]] = {}
    for file in sorted(files, key=lambda file: file.name):
        is_picture = Path(file.name).suffix.lower() in _SUFFIXES
        groups.setdefault((file.name.rpartition("/")[0], is_picture), []).append(file)
    return [
        file
        for (_, pictures), inside in groups.items()
        for file in inside[:: every if pictures else 1]
    ]


def write_true_cameras(capture: Path) -> None:
    """Strecha's `NAME.camera` as a transforms.json: the lens matrix, a line of zeros, camera to
    world rotation, position, and the size of the picture."""
    frames = []
    for path in sorted((capture / _TRUE_CAMERAS).glob("*.camera")):
        numbers = np.array(path.read_text(encoding="utf-8").split(), np.float64)
        lens, rotation = numbers[:9].reshape(3, 3), numbers[12:21].reshape(3, 3)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation @ OPENGL_FROM_OURS, numbers[21:24]
        width, height = (int(side) for side in numbers[24:26])
        sides = {"w": width, "h": height, "cx": lens[0, 2], "cy": lens[1, 2]}
        focal = {"fl_x": lens[0, 0], "fl_y": lens[1, 1]}
        name = f"images/{path.stem}"
        frames.append({"file_path": name, "transform_matrix": pose.tolist(), **sides, **focal})
    written = json.dumps({"camera_model": "PINHOLE", "frames": frames})
    (capture / "transforms.json").write_text(written, encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("clones", type=Path, nargs="?")
    given = parser.parse_args()
    for name, source in SOURCES.items():
        clone = given.clones and given.clones / source.repository.rpartition("/")[2]
        if (given.folder / name).is_dir():
            state = "there"
        elif clone and clone.is_dir():
            copy_from(clone, source, given.folder / name)
            state = "copied"
        else:
            state = f"missing: {source.text}"
        print(f"{name}: {state}")


if __name__ == "__main__":
    main()
