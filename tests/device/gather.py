"""Packs what a machine without a network lacks: python -m tests.device.gather [--run NAME=FOLDER].

Into .device/, which git ignores: wheels for Python 3.12 on Linux, and the sample's run folder with
its first three stages, which need libraries that the machine does not have. --run adds the first
three stages of another run folder, for runs 3 and 4. With the files that git tracks it must stay
below 64 MiB; `tests.device.run` unpacks the wheels.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

from tests import processes

BUNDLE = processes.ROOT / ".device"
WHEELS = (
    *("pillow_heif", "flip_evaluator", "pygltflib", "plyfile", "dataclasses_json", "marshmallow<4"),
    *(
        "mypy_extensions",
        "typing_inspect",
        "fast_simplification",
        "zstandard",
        "gsplat",
        "filelock",
    ),
)
WHOLE = ("typer",)  # with all that it requires, in versions that fit each other
STAGES = ("1-ingest", "2-sfm", "3-seed")
MOST_BYTES = 64 * 2**20
PLATFORMS = ("2_28", "2_27", "2_26", "2_24", "2_17", "2_12", "2_5")


def wheels(folder: Path) -> None:
    """Download them."""
    shutil.rmtree(folder, ignore_errors=True)
    older = ("manylinux2014", "manylinux2010", "manylinux1")
    names = [f"manylinux_{n}_x86_64" for n in PLATFORMS] + [f"{n}_x86_64" for n in older]
    for name in (*WHEELS, *WHOLE):
        words = ["-m", "pip", "download", "-q", "--only-binary=:all:", "-d", str(folder)]
        words += [] if name in WHOLE else ["--no-deps"]
        words += ["--python-version", "3.12", "--implementation", "cp", "--abi", "cp312"]
        words += ["--abi", "abi3", "--abi", "none"]
        words += [word for platform in names for word in ("--platform", platform)]
        done = subprocess.run([sys.executable, *words, name])
        if done.returncode:
            print(f"no wheel of {name}")


def sample(folder: Path) -> None:
    """The sample's run folder, up to its seeds."""
    shutil.rmtree(folder, ignore_errors=True)
    photographs = processes.ROOT / "sample_captures" / "still_life" / "images"
    subprocess.run(processes.splat("ingest", str(photographs), "--out", str(folder)), check=True)
    for stage in ("sfm", "seed"):
        subprocess.run(processes.splat(stage, str(folder)), check=True)


def copied(given: Path, folder: Path) -> None:
    """The first stages of a run folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in STAGES:
        shutil.copytree(given / name, folder / name)
    shutil.copy(given / "run.json", folder)


def size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", action="append", default=[], help="NAME=FOLDER, in addition")
    parser.add_argument("--keep-wheels", action="store_true", help="do not download again")
    asked = parser.parse_args()
    if not asked.keep_wheels:
        wheels(BUNDLE / "wheels")
    sample(BUNDLE / "runs" / "sample")
    for words in asked.run:
        name, _, folder = words.partition("=")
        copied(Path(folder), BUNDLE / "runs" / name)
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(words, cwd=processes.ROOT, capture_output=True, check=True).stdout
    tree = sum(
        path.stat().st_size
        for name in listed.decode().split("\0")
        if name and (path := processes.ROOT / name).is_file()
    )
    packed = size(BUNDLE)
    print(f"{packed / 2**20:.1f} MiB in {BUNDLE}, {tree / 2**20:.1f} MiB in the checkout")
    if packed + tree > MOST_BYTES:
        sys.exit(f"more than {MOST_BYTES / 2**20:.0f} MiB")


if __name__ == "__main__":
    main()
