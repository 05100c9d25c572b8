"""Commands and code of the documentation, really run on a small finished run."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from stages import formats
from tests import sample
from tests.docs_commands import splat_commands
from tests.docs_tables import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

# Without photographs of one's own, a browser or many minutes.
RUN = ("status", "info", "render", "export", "convert", "edit", "verify", "cameras")
OF_ANOTHER_PROGRAM = "smaller"  # the run of README's commands that begin with other splats
_IN_README = splat_commands([ROOT / "README.md"])
README = [w for w in _IN_README if w[1] in RUN and OF_ANOTHER_PROGRAM not in w]
GUIDE = (
    "splat quantise run --sog-loss-db 0.1",
    "splat prune run --rounds 0",
    "splat export run --format mesh --mesh-triangles 50000",
    "splat edit run scene/lod-meta.json",
    "splat cameras run transforms.json",
    "splat tradeoff run",
    "splat render --path transforms.json --out frames",
)


def test_readme_has_commands_to_run() -> None:
    assert len(README) >= 7


def test_commands_of_readme_and_guide_run(sample_run: Path, tmp_path: Path) -> None:
    """In one folder, one after the other, as a reader does them."""
    folder = sample.copied(sample_run, tmp_path)
    in_guide = splat_commands(sorted((ROOT / "docs" / "guide").glob("*.md")))
    chosen = [line.split() for line in GUIDE]
    assert all(words in in_guide for words in chosen)
    for words in [*README, *chosen]:
        done = sample.splat(*words[1:], folder=folder)
        assert done.returncode == 0, f"{words}\n{done.stdout[-1000:]}{done.stderr[-2000:]}"


def test_readme_commands_for_splats_of_another_program_run(
    sample_run: Path, tmp_path: Path
) -> None:
    """Its file, the photographs that it trained on, and their COLMAP model, as it names them."""
    run = sample_run / "run"
    shutil.copytree(run / "2-sfm" / "colmap" / "images", tmp_path / "photos")
    shutil.copytree(run / "2-sfm" / "colmap" / "sparse", tmp_path / "sparse")
    shutil.copy(run / "7-export" / "scene.ply", tmp_path / "point_cloud.ply")
    commands = [words for words in _IN_README if OF_ANOTHER_PROGRAM in words]
    assert [words[1] for words in commands] == ["process", "prune", "export"]
    for words in commands:
        done = sample.splat(*words[1:], folder=tmp_path)
        assert done.returncode == 0, f"{words}\n{done.stdout[-1000:]}{done.stderr[-2000:]}"
    delivered = tmp_path / OF_ANOTHER_PROGRAM / "7-export" / "scene.glb"
    assert len(formats.read(delivered)) < len(formats.read(tmp_path / "point_cloud.ply"))


def test_files_of_a_run_are_those_of_the_architecture_page(sample_run: Path) -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = text.split("## Stages and run folders", 1)[1].split("\n## ", 1)[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    named = set()
    for row in rows:
        folder = ""
        for name in re.findall(r"`([^`]+)`", row):
            folder = name.rpartition("/")[0] if re.match(r"\d-\w+/[\w.]", name) else folder
            named.add(
                name.rstrip("/") if "/" in name.rstrip("/") else f"{folder}/{name}".strip("/")
            )
    named = {name.rstrip("/") for name in named}
    found = {path.relative_to(sample_run / "run") for path in (sample_run / "run").glob("?-*/*")}
    for path in sorted(found):
        known = path.name == "manifest.json" or path.name.startswith("scene.")
        assert known or path.as_posix() in named, f"{path} is not on the page"
    for name in named - {
        "blocks",
        "6-quantise/flat_dc.npy",
        "N-STAGE/manifest.json",
        "7-export/scene.*",
        *(f"4-train/transients{ending}" for ending in ("", ".png", ".txt")),
    }:
        assert (sample_run / "run" / name).exists(), f"{name} is not in a run folder"


def test_python_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With fewer and smaller steps than it says."""
    page = (ROOT / "docs" / "guide" / "python.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.S)
    small = 'preset="preview", max_side=320, train_side=120, steps=200, max_splats=3000'
    assert 'preset="preview"' in code
    shutil.copytree(sample.PHOTOS, tmp_path / "photos")
    monkeypatch.chdir(tmp_path)
    made: dict[str, Any] = {}
    exec(code.replace('preset="preview"', f'{small}, formats=("ply",)'), made)
    scene, drawn, opaque = made["scene"], made["drawn"], made["opaque"]
    assert (tmp_path / "view.png").stat().st_size > 1000
    assert 100 < len(opaque) < len(scene.splats)
    assert (opaque.opacities > 0.1).all()
    assert len(formats.read(tmp_path / "opaque.ply")) == len(opaque)
    assert [file.format for file in scene.assets.files] == ["ply"]
    assert scene.metrics["train"]["psnr_db"] > 15
    assert (drawn.image.shape, drawn.depth.shape) == ((480, 640, 3), (480, 640))
    assert drawn.alpha.mean() > 0.5
    said = capsys.readouterr().out
    assert re.search(r"^Scene\('run', \d+ views, [\d,]+ splats\) Splats\(", said, re.M)
    assert re.search(r"^train training .*psnr_db", said, re.M)
