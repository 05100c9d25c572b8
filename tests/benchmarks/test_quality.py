"""The captures, the verdicts and the sizes of the quality benchmark."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.cameras.camera_formats import read_cameras
from stages.evaluate.evaluation import SIZES, EvaluationView
from stages.evaluate.image_metrics import IDENTICAL_DB
from stages.raster.draw import raster_settings_of, render
from stages.sfm.settings import SfmSettings
from stages.tradeoff.intervals import BETTER, INCONCLUSIVE
from tests.benchmarks import captures, quality, sizes
from tests.benchmarks.captures import SOURCES, Source
from tests.benchmarks.verdicts import Cell, difference_over, read, verdicts, write
from tests.scenes import camera, cloud

SENSOR = ["2759.5 0 1520.7", "0 2764.2 1006.8", "0 0 1", "0 0 0"]


def test_every_capture_of_a_mode_is_the_sample_or_has_a_source() -> None:
    for mode in quality.MODES.values():
        assert mode.captures.keys() - {quality.SAMPLE} <= SOURCES.keys()
    assert len(quality.MODES["full"].captures) >= 10


def test_a_capture_is_copied_from_a_clone_with_a_part_of_its_pictures(tmp_path: Path) -> None:
    clone = tmp_path / "clone"
    for name in ("a/images", "a/masks", "b"):
        (clone / name).mkdir(parents=True)
        for number in range(7):
            (clone / name / f"{number}.jpg").write_text(f"{name} {number}")
    (clone / "a" / "poses.npy").write_text("poses")
    git = ["git", "-C", str(clone), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for words in (["init", "-q"], ["add", "-A"], ["commit", "-q", "-m", "a"]):
        subprocess.run([*git, *words], check=True)
    into = tmp_path / "into"
    captures.copy_from(clone, Source("x/y", "a", ("images", "masks", "poses.npy"), 3), into)
    found = sorted(path.relative_to(into).as_posix() for path in into.rglob("*.*"))
    pictures = [f"{part}/{n}.jpg" for part in ("images", "masks") for n in (0, 3, 6)]
    assert found == [*pictures, "poses.npy"]
    subprocess.run([*git, "rm", "-q", "-r", "b"], check=True)
    subprocess.run([*git, "commit", "-q", "-m", "b"], check=True)
    captures.copy_from(clone, Source("x/y", "b", ("*.jpg",), commit="HEAD~1"), tmp_path / "b")
    assert len(list((tmp_path / "b" / "images").iterdir())) == 7


def test_true_cameras_see_points_where_their_file_says(tmp_path: Path) -> None:
    """p = K R^T (x - c) for the rotation R and the position c of the file."""
    (tmp_path / "images").mkdir()
    (tmp_path / "gt_dense_cameras").mkdir()
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    place = np.array([1.0, -2.0, 0.5])
    lines = [*SENSOR, *(" ".join(map(str, row)) for row in (*turn, place)), "3072 2048"]
    for number in range(3):
        Image.new("RGB", (6, 4)).save(tmp_path / "images" / f"{number}.jpg")
        (tmp_path / "gt_dense_cameras" / f"{number}.jpg.camera").write_text("\n".join(lines))
    captures.write_true_cameras(tmp_path)
    written = tmp_path / "transforms.json"
    assert quality.with_its_cameras(tmp_path / "images") == SfmSettings(cameras=written)
    seen = read_cameras(written).views[0].camera
    ahead = place + turn @ (0.2, -0.1, 4.0)
    np.testing.assert_allclose(
        seen.project(ahead[None])[0][0],
        [2759.5 * 0.05 + 1520.7, -2764.2 * 0.025 + 1006.8],
        rtol=1e-6,
    )


def test_cameras_are_searched_where_none_lie_with_the_photographs(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    assert quality.with_its_cameras(tmp_path / "images") == SfmSettings()


def test_a_part_of_the_photographs_is_the_first_and_each_so_many_th(tmp_path: Path) -> None:
    for number in range(9):
        (tmp_path / f"{number}.jpg").write_text("")
    found = quality.one_in(4, tmp_path, tmp_path / "into")
    assert [path.name for path in sorted(found.iterdir())] == ["0.jpg", "4.jpg", "8.jpg"]


def cell(capture: str, seed: int, gain_db: float, views: int = 4) -> Cell:
    rows = [{"name": str(i), "psnr_db": 25.0 + i + 0.01 * seed + gain_db} for i in range(views)]
    scores = dict.fromkeys(SIZES, rows)
    return Cell(capture, "preview", seed, 100, 480, 1000, 1.0, 1.0, scores)


def cells(*gains_db: float) -> list[Cell]:
    return [cell(f"c{n}", seed, gain) for n, gain in enumerate(gains_db) for seed in range(3)]


@pytest.mark.parametrize(
    ("gains_db", "verdict"),
    [
        ((0.5, 0.6, 0.4, 0.5, 0.55), "better, +0.51 dB"),
        ((-0.5, -0.6, -0.4, -0.5, -0.55), "worse, -0.51 dB"),
        ((2.0, -0.3, -0.2, -0.3, -0.4), "no significant difference, +0.16 dB"),
    ],
)
def test_a_verdict_is_by_captures_and_not_only_within_each(
    gains_db: tuple[float, ...], verdict: str
) -> None:
    lines = list(verdicts(cells(*gains_db), cells(*[0.0] * 5)))
    assert len(lines) == 5 * 3 + 3
    assert lines[0].startswith(f"c0 preview, full size: {'better' if gains_db[0] > 0 else 'worse'}")
    assert lines[-3].startswith(f"5 captures, preview, full size: {verdict}")


def test_seeds_that_disagree_widen_the_interval_though_photographs_agree() -> None:
    agreeing = difference_over(np.full((12, 3), 0.3))
    disagreeing = difference_over(np.tile([0.0, 0.3, 0.6], (12, 1)))
    assert agreeing.verdict == BETTER
    assert disagreeing.mean == pytest.approx(agreeing.mean)
    assert disagreeing.verdict == INCONCLUSIVE


def test_one_capture_gives_no_interval_over_captures() -> None:
    assert list(verdicts(cells(1.0), cells(0.0)))[-1].endswith("(one only)")


def test_what_was_measured_otherwise_is_not_compared() -> None:
    before = cells(0.0)
    for changed in ({"side": 640}, {"steps": 200}, {"seed": 9}, {"capture": "other"}):
        assert not list(verdicts([replace(one, **changed) for one in cells(1.0)], before))
    fewer = [replace(one, scores={"full": one.scores["full"]}) for one in before]
    assert len(list(verdicts(cells(1.0), fewer))) == 2


def test_cells_are_stored_and_read(tmp_path: Path) -> None:
    write(tmp_path / "a.json", cells(0.1, 0.2))
    assert read(tmp_path / "a.json") == cells(0.1, 0.2)


def test_the_stored_figures_can_be_read() -> None:
    for path in sorted(Path(quality.__file__).parent.glob("quality*.json")):
        assert {one.capture for one in read(path)} >= {quality.SAMPLE}


def test_an_asset_is_drawn_at_each_size_with_or_without_compensation() -> None:
    """What was photographed by compensation is drawn best by it, at every size."""
    splats, where = cloud(300, 640, 480), camera(640, 480)
    settings = raster_settings_of(splats)
    for drawing, compensates in (("plain", False), ("antialiased", True)):
        image = render(splats, where, replace(settings, antialias=compensates)).image
        view = EvaluationView("a", where, np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8))
        found = {name: sizes.psnr_at(splats, [view], (160, 640), name) for name in sizes.DRAWINGS}
        other = "plain" if compensates else "antialiased"
        (psnr_db,) = found[drawing][640]
        assert 50 < psnr_db <= IDENTICAL_DB
        assert found[drawing][640] > found[other][640]
        assert list(found[drawing]) == [160, 640]
