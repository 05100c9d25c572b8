"""What the machine is: versions, card, bandwidth, programs, what `splat doctor` says."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version

from tests.device.results import Results, asked

PACKAGES = ("torch", "triton", "numpy", "numba", "pillow", "scipy", "gsplat", "pytest")
MODULES = ("pillow_heif", "flip_evaluator", "typer", "plyfile", "pygltflib", "fast_simplification")
PROGRAMS = ("gcc", "clang", "nvcc", "ninja", "ncu", "compute-sanitizer")


def main() -> None:
    _, results = asked(__doc__)
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = ""
    results.put("versions", found)
    results.row("python", f"{platform.python_version()}, {os.cpu_count()} cores")
    results.row("packages", ", ".join(f"{k} {v or '-'}" for k, v in found.items()))
    absent = [name for name in MODULES if importlib.util.find_spec(name) is None]
    absent += [name for name in PROGRAMS if shutil.which(name) is None]
    results.row("missing", ", ".join(absent) or "nothing")
    with results.attempt("card"):
        card(results)
    with results.attempt("doctor"):
        words = [sys.executable, "-m", "splatcli", "doctor"]
        done = subprocess.run(words, capture_output=True, text=True, timeout=40)
        results.put("doctor", done.stdout + done.stderr)
        print(done.stdout, done.stderr)
    if shutil.which("nvidia-smi"):
        done = subprocess.run(["nvidia-smi", "-q"], capture_output=True, text=True, timeout=20)
        results.put("nvidia-smi", done.stdout[:20_000])


def card(results: Results) -> None:
    import torch

    from stages.raster.gpu import device

    results.row("device", device.missing() or device.describe())
    if not torch.cuda.is_available():
        return
    results.put("properties", str(torch.cuda.get_device_properties(0)))
    results.put("architectures", torch.cuda.get_arch_list())
    block = torch.empty(2**30, dtype=torch.uint8, device="cuda").random_()
    other = torch.empty_like(block)
    other.copy_(block)
    torch.cuda.synchronize()
    began = time.perf_counter()
    for _ in range(20):
        other.copy_(block)
    torch.cuda.synchronize()
    taken = time.perf_counter() - began
    results.row("copying on the device", f"{20 * 2 * 2**30 / taken / 1e12:.2f} TB/s")
    results.put("copy_bytes_a_second", 20 * 2 * 2**30 / taken)


if __name__ == "__main__":
    main()
