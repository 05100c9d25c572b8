"""Builds gsplat's kernels for three channels and this card, from the wheel in the bundle."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
import zipfile
from pathlib import Path

from tests.device.results import asked

JOBS = "10"


def folder() -> Path:
    """Where it is built: beside the cache of kernels, which all parts of a run share."""
    return Path(os.environ["TRITON_CACHE_DIR"]).parent / "gsplat"


def environment() -> dict[str, str]:
    """Of a process that imports it."""
    site = folder()
    given = {
        "PYTHONPATH": f"{site}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
        "TORCH_EXTENSIONS_DIR": str(site / "built"),
        "MAX_JOBS": JOBS,
    }
    return {**os.environ, **given}


def three_channels(cuda: Path) -> int:
    """Leave out the kernels of other numbers of channels; how many lines went."""
    gone = 0
    for path in (*cuda.rglob("*.cu"), *cuda.glob("csrc/*.cpp")):
        text = path.read_text()
        kept, count = re.subn(
            r"^\s*__(INS|LAUNCH_KERNEL)__\((?!3\)|CDIM|N\))\d+\)\s*$\n", "", text, flags=re.M
        )
        if count:
            path.write_text(kept)
            gone += count
    return gone


def main() -> None:
    options, results = asked(__doc__, "--bundle")
    wheels = list(Path(options.bundle).glob("wheels/gsplat-*.whl"))
    if not wheels:
        results.row("gsplat", "SKIPPED: no wheel in the bundle")
        return
    site = folder()
    site.mkdir(parents=True, exist_ok=True)
    zipfile.ZipFile(wheels[0]).extractall(site)
    results.row("kernels left out", str(three_channels(site / "gsplat" / "cuda")))
    if options.toy or shutil.which("nvcc") is None:
        results.row("gsplat", "not built: no nvcc asked for")
        return
    began = time.monotonic()
    code = "import gsplat.cuda._backend as b; assert b._C is not None; print(b._C)"
    import torch

    major, minor = torch.cuda.get_device_capability()
    given = {**environment(), "TORCH_CUDA_ARCH_LIST": f"{major}.{minor}", "VERBOSE": "1"}
    done = subprocess.run(["nice", sys.executable, "-c", code], env=given)
    results.row("gsplat built", f"status {done.returncode}, {time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
