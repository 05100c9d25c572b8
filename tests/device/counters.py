"""Hardware counters of blending, its gradient and projection, by Nsight Compute, as text."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from tests.device.results import asked

KERNELS = "blend_kernel|blend_gradient_kernel|project_kernel|splat_gradient_kernel|sum_kernel"
SECTIONS = (
    *("SpeedOfLight", "Occupancy", "LaunchStats", "WarpStateStats", "MemoryWorkloadAnalysis"),
    *("ComputeWorkloadAnalysis", "SchedulerStats", "InstructionStats"),
)
READ = (
    *("Duration", "Compute (SM) Throughput", "Memory Throughput", "Registers Per Thread"),
    *("Achieved Occupancy", "Executed Ipc Active", "L2 Hit Rate", "L1/TEX Hit Rate"),
)


def main() -> None:
    options, results = asked(__doc__)
    again = str(options.result.with_name("counted.json"))
    words = [sys.executable, "-m", "tests.device.steps", "--once", "1", "--result", again]
    if options.toy:
        words.append("--toy")
    else:
        sections = [word for name in SECTIONS for word in ("--section", name)]
        asked_for = ["--kernel-name", f"regex:{KERNELS}", "--launch-skip", "5", "--launch-count"]
        words = [*("ncu", "--clock-control", "none"), *sections, *asked_for, "6", *words]
    if not options.toy and shutil.which("ncu") is None:
        results.row("counters", "SKIPPED: no ncu")
        return
    done = subprocess.run(words, capture_output=True, text=True, timeout=85)
    if out := os.environ.get("SPLAT_DEVICE_OUT"):
        (Path(out) / "counters.txt").write_text(done.stdout + done.stderr)
    results.row("exit status", str(done.returncode))
    kernel = ""
    for line in done.stdout.splitlines():
        if found := re.match(r"\s+(\w+_kernel)", line):
            kernel = found[1]
        for name in READ:
            if line.strip().startswith(name):
                results.row(f"{kernel}: {name}"[:46], " ".join(line.split()[len(name.split()) :]))


if __name__ == "__main__":
    main()
