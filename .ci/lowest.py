"""`python .ci/lowest.py`: every dependency at the lowest version that pyproject.toml promises.

A constraints file for pip, on standard output.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path


def main() -> None:
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    for wanted in (*project["dependencies"], *project["optional-dependencies"]["test"]):
        name, floor = re.match(r"([\w.-]+)[>=]=([\w.]+)(?:,<[\w.]+)?(?:;|$)", wanted).groups()
        print(f"{name}=={floor}")


if __name__ == "__main__":
    main()
