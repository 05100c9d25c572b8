"""`splat train` of a run folder that travelled with its first three stages: seconds, splats, PSNR
of the held-out views, memory."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.device.results import Results, asked

# of the sample with `standard` on a CPU, by README; and what the others are compared with
TARGETS = {
    "sample": "20 s, 28.2 dB",
    "bonsai": "300 s, 32.3 dB",
    "lego": "120 s, 35.9 dB",
    "chair": "120 s, 36.0 dB",
    "mic": "120 s, 36.5 dB",
}
LONG = ("--steps", "30000", "--sh-degree", "3")
TOY = ("--steps", "4", "--train-side", "16", "--max-splats", "20")


def main() -> None:
    options, results = asked(__doc__, "--bundle", "--run", "--backend")
    name, backend = options.run or "sample", options.backend or "gpu"
    given = Path(options.bundle) / "runs" / name
    if not given.exists():
        results.row(name, f"SKIPPED: {given} is not there (tests.device.gather makes it)")
        return
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        shutil.copytree(given, run)
        train(results, run, name, backend, options.toy)


def train(results: Results, run: Path, name: str, backend: str, toy: bool) -> None:
    words = ["train", str(run), "--preset", "standard", "--backend", backend]
    words += TOY if toy else LONG if name != "sample" else ()
    began = time.monotonic()
    done = subprocess.run([sys.executable, "-m", "splatcli", *words])
    taken = time.monotonic() - began
    if out := os.environ.get("SPLAT_DEVICE_OUT"):
        with results.attempt("manifest"):
            kept = Path(out) / f"train-{name}-{backend}.json"
            shutil.copy(run / "4-train" / "manifest.json", kept)
    results.row(f"{name} on {backend}: exit status, in all", f"{done.returncode}, {taken:.1f} s")
    manifest = json.loads((run / "4-train" / "manifest.json").read_text())
    metrics = manifest["metrics"]
    results.put("metrics", metrics)
    results.put("seconds", {"command": taken, "stage": manifest.get("seconds")})
    for key, value in metrics.items():
        if any(word in key for word in ("psnr", "splats", "peak", "skipped", "ssim")):
            target = TARGETS.get(name, "") if "psnr" in key else ""
            results.row(f"{name}: {key}"[:46], str(value)[:60], target)


if __name__ == "__main__":
    main()
