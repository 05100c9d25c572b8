"""`python .ci/lowest.py`: every dependency at the lowest version that pyproject.toml promises.

A constraints file for pip, on standard output. torch is left out: its older builds for the CPU
alone are in no index that pip asks by itself, and those for GPUs take 3 GB. Its lowest version is
the one of machines with a GPU (docs/experiments/gpu.md).
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path


def main() -> None:
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    for wanted in (*project["dependencies"], *project["optional-dependencies"]["test"]):
        name, floor = re.match(r"([\w.-]+)[>=]=([\w.]+)(?:,<[\w.]+)?(?:;|$)", wanted).groups()
        if name != "torch":
            print(f"{name}=={floor}")


if __name__ == "__main__":
    main()
