"""The table and the plot of scenes with published figures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from tests import sample
from tests.benchmarks import published
from tests.benchmarks.published import PUBLISHED, Measured


def measured(scene: str, steps: int, psnr_db: float) -> Measured:
    return Measured(scene, steps, 800, psnr_db, 0.98, 90_000, 1.5, psnr_db - 1, steps / 10, 4000.0)


def test_runs_stand_beside_what_others_published_of_the_same_scene(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    runs = [measured("mic", 30_000, 36.5), measured("mic", 2_000, 33.0)]
    published.print_table(runs)
    printed = capsys.readouterr().out
    for other in PUBLISHED:
        assert (f"{other.psnr_db:.2f}" in printed) == (other.scene == "mic")
    assert "30,000 steps" in printed
    published.plot(tmp_path / "plot.png", runs)
    with Image.open(tmp_path / "plot.png") as plot:
        assert plot.width > 2 * plot.height


def test_no_method_is_listed_twice_for_a_scene() -> None:
    assert len({(other.method, other.scene) for other in PUBLISHED}) == len(PUBLISHED)


@pytest.mark.slow
def test_a_run_is_measured_as_its_own_manifests_say(tmp_path: Path) -> None:
    words = sample.process_words("--format", "sog", "--steps", "60", max_splats=2000)
    sample.events(sample.splat(*words, "--json", folder=tmp_path))
    found = published.measure(tmp_path / "run")
    trained = json.loads((tmp_path / "run" / "4-train" / "manifest.json").read_text())
    assert found.scene == "run"
    assert found.steps == 60
    assert found.training_s == trained["cpu_seconds"] < found.all_s
    assert abs(found.psnr_db - trained["metrics"]["psnr_db"]) < 1  # another size
    assert 0 < found.megabytes < 1
