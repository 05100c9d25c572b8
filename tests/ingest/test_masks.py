"""Which mask belongs to which photograph, and what it leaves of it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.ingest import stage as ingest
from stages.ingest.find import find
from stages.ingest.masks import masks_beside, pair_masks
from stages.ingest.settings import IngestSettings
from stages.scene import Capture
from stages.scene.pictures import load_depth, load_image
from tests.ingest.made_files import exif, folder_of, save, textured

HALF = np.repeat(np.array([0, 255], np.uint8), 32)[:, None] * np.ones(
    (1, 96), np.uint8
)  # white below


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return folder_of(tmp_path / "photos")


def names(photos: Path) -> list[str]:
    return sorted(path.name for path in photos.glob("*.jpg"))


def masked(folder: Path, photos: Path, mask: np.ndarray = HALF, form: str = "{stem}.png") -> Path:
    folder.mkdir(exist_ok=True)
    for name in names(photos):
        save(folder / form.format(name=name, stem=Path(name).stem), mask)
    return folder


def taken(photos: Path, **settings: object) -> tuple[Capture, dict[str, str]]:
    report = Report()
    out = photos.parent / "out"
    capture = ingest.run({"photos": photos}, IngestSettings(**settings), out, report)  # type: ignore[arg-type]
    return capture, dict(report.warnings)


def mask_of(capture: Capture, number: int = 0) -> np.ndarray:
    return np.asarray(Image.open(capture.folder / capture.photos[number].mask))


@pytest.mark.parametrize("form", ["{stem}.png", "{name}.png", "{stem}_mask.png", "{stem}.tif"])
def test_masks_are_found_by_the_names_that_other_programs_give_them(
    photos: Path, tmp_path: Path, form: str
) -> None:
    folder = masked(tmp_path / "elsewhere", photos, form=form)
    capture, _ = taken(photos, masks=folder)
    assert len(capture.photos) == len(names(photos))
    for number, photo in enumerate(capture.photos):
        assert photo.outside == "ignore"
        np.testing.assert_array_equal(mask_of(capture, number), HALF)


@pytest.mark.parametrize("where", ["photos/masks", "masks"])
def test_a_folder_called_masks_in_or_beside_the_photographs_is_used(
    photos: Path, tmp_path: Path, where: str
) -> None:
    masked(tmp_path / where, photos)
    capture, _ = taken(photos)
    assert [photo.name for photo in capture.photos] == names(photos)
    assert all(photo.mask for photo in capture.photos)


def test_masks_may_lie_among_their_photographs() -> None:
    found = masks_beside(["a.jpg", "a_mask.png", "b.jpg", "b.jpg.png", "c.jpg", "c.png"])
    assert found == {"a_mask.png": "a.jpg", "b.jpg.png": "b.jpg"}


def test_a_mask_is_for_the_photograph_whose_name_has_its_case() -> None:
    found = masks_beside(["X.JPG", "x.jpg", "x.jpg.png"])
    assert found == {"x.jpg.png": "x.jpg"}
    assert masks_beside(["X.JPG", "x.jpg.png"]) == {"x.jpg.png": "X.JPG"}
    for names in (["X.JPG", "x.jpg"], ["x.jpg", "X.JPG"]):
        assert pair_masks(names, {"x.jpg.png": Path("x")}) == {"x.jpg": Path("x")}
        both = {"x.jpg.png": Path("x"), "X.JPG.png": Path("X")}
        assert pair_masks(names, both) == {"x.jpg": Path("x"), "X.JPG": Path("X")}
    assert pair_masks(["X.JPG"], {"x.jpg.png": Path("x")}) == {"X.JPG": Path("x")}


def test_sub_folders_tell_masks_apart_and_may_be_left_out_where_names_do() -> None:
    deep = {name: Path(name) for name in ("one/a.png", "two/a.png")}
    found = pair_masks(["one/a.jpg", "two/a.jpg"], deep)
    assert found == {"one/a.jpg": Path("one/a.png"), "two/a.jpg": Path("two/a.png")}
    flat = {name: Path(name) for name in ("a.png", "b.png")}
    found = pair_masks(["one/a.jpg", "two/b.jpg"], flat)
    assert found == {"one/a.jpg": Path("a.png"), "two/b.jpg": Path("b.png")}
    assert not pair_masks(["one/a.jpg", "two/a.jpg"], flat)


def test_photographs_of_a_folder_called_masks_are_photographs(tmp_path: Path) -> None:
    folder_of(tmp_path / "photos" / "masks")
    assert len(find(tmp_path / "photos").sources) == 3


def test_what_is_ignored_leaves_the_picture_alone(photos: Path, tmp_path: Path) -> None:
    capture, _ = taken(photos, masks=masked(tmp_path / "m", photos))
    for photo in capture.photos:
        assert (capture.folder / photo.image).read_bytes() == (photos / photo.name).read_bytes()


def test_what_is_cut_out_stands_before_black(photos: Path, tmp_path: Path) -> None:
    folder = masked(tmp_path / "m", photos)
    capture, _ = taken(photos, masks=folder, mask_means="transparent")
    photo = capture.photos[0]
    picture = load_image(capture.folder / photo.image, photo.width, photo.height)
    assert photo.outside == "transparent"
    assert picture[:28].max() < 0.05 < picture[36:].mean()


def test_black_may_be_what_counts(photos: Path, tmp_path: Path) -> None:
    capture, _ = taken(photos, masks=masked(tmp_path / "m", photos), invert_masks=True)
    np.testing.assert_array_equal(mask_of(capture), 255 - HALF)


def discs(photos: Path, folder: Path, *columns: int) -> Path:
    """Masks of photographs of 64 x 96 pixels that keep a disc at the given columns."""
    folder.mkdir(exist_ok=True)
    for name, column in zip(names(photos), columns, strict=True):
        mask = cv2.circle(np.zeros((64, 96), np.uint8), (column, 32), 16, 255, -1)
        save(folder / f"{Path(name).stem}.png", mask)
    return folder


def test_masks_that_cut_out_an_object_mean_empty_unless_said_otherwise(
    photos: Path, tmp_path: Path
) -> None:
    folder = discs(photos, tmp_path / "m", 40, 48, 56)
    capture, warnings = taken(photos, masks=folder)
    assert {photo.outside for photo in capture.photos} == {"transparent"}
    assert "--mask-means ignore" in warnings["ingest-masks-cut-out"]
    capture, warnings = taken(photos, masks=folder, mask_means="ignore")
    assert {photo.outside for photo in capture.photos} == {"ignore"}
    assert "ingest-masks-cut-out" not in warnings


@pytest.mark.parametrize(
    ("columns", "invert"),
    [
        ((48, 48, 48), False),  # the same in all: of the lens
        ((40, 48, 56), True),  # an object is left out
    ],
)
def test_other_masks_mean_unknown(photos: Path, tmp_path: Path, columns, invert) -> None:
    folder = discs(photos, tmp_path / "m", *columns)
    capture, warnings = taken(photos, masks=folder, invert_masks=invert)
    assert {photo.outside for photo in capture.photos} == {"ignore"}
    assert "ingest-masks-cut-out" not in warnings


def test_alpha_means_empty_unless_said_otherwise(photos: Path) -> None:
    for name in names(photos):
        layered = np.dstack([textured(len(name)), HALF])
        (photos / name).unlink()
        save((photos / name).with_suffix(".png"), layered)
    for means, wanted in (("auto", "transparent"), ("ignore", "ignore")):
        capture, warnings = taken(photos, mask_means=means)
        assert {photo.outside for photo in capture.photos} == {wanted}
        assert ("ingest-transparency" in warnings) == (wanted == "transparent")
        np.testing.assert_array_equal(mask_of(capture), HALF)


def test_masks_may_lie_in_a_folder_above_the_photographs(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "capture" / "photos")
    capture, _ = taken(photos, masks=masked(tmp_path / "capture", photos))
    np.testing.assert_array_equal(mask_of(capture), HALF)


def test_a_smaller_mask_is_scaled_without_blur_and_said(photos: Path, tmp_path: Path) -> None:
    folder = masked(tmp_path / "m", photos, HALF[::2, ::2])
    capture, warnings = taken(photos, masks=folder)
    np.testing.assert_array_equal(mask_of(capture), HALF)
    assert names(photos)[0] in warnings["ingest-mask-scaled"]


def test_a_mask_is_turned_as_its_photograph_is(photos: Path, tmp_path: Path) -> None:
    name = names(photos)[0]
    save(photos / name, textured(3), exif=exif(orientation=6))
    capture, warnings = taken(photos, masks=masked(tmp_path / "m", photos))
    np.testing.assert_array_equal(mask_of(capture), np.rot90(HALF, -1))
    assert "ingest-mask-scaled" not in warnings


UPPER_LEFT = np.zeros((64, 96), np.uint8)
UPPER_LEFT[:32, :40] = 255


def stored(upright: np.ndarray, orientation: int) -> np.ndarray:
    """What a camera stores of it: the inverse of what the orientation does."""
    turned = {
        1: upright,
        2: upright[:, ::-1],
        3: np.rot90(upright, 2),
        4: upright[::-1],
        5: np.swapaxes(upright, 0, 1),
        6: np.rot90(upright),
        7: np.swapaxes(np.rot90(upright, 2), 0, 1),
        8: np.rot90(upright, -1),
    }
    return np.ascontiguousarray(turned[orientation])


def turned_capture(folder: Path, orientations: list[int], as_stored: list[bool]) -> Path:
    """Photographs of these orientations, each with a mask and a depth map, upright or as stored."""
    depth = np.linspace(1000, 3000, 64 * 96).reshape(64, 96).astype(np.uint16)
    for number, (orientation, like) in enumerate(zip(orientations, as_stored, strict=True)):
        picture = stored(textured(number), orientation)
        save(folder / f"photos/{number}.jpg", picture, exif=exif(orientation=orientation))
        for kind, upright in (("masks", UPPER_LEFT), ("depth", depth)):
            save(folder / kind / f"{number}.png", stored(upright, orientation if like else 1))
    return folder / "photos"


def maps(capture: Capture) -> list[np.ndarray]:
    depths = [load_depth(capture.folder / photo.depth) for photo in capture.photos]
    return [mask_of(capture, number) for number in range(len(capture.photos))] + depths


def test_masks_and_depth_as_stored_are_turned_alike(tmp_path: Path) -> None:
    orientations = list(range(1, 9))
    found = []
    for like in (False, True):
        photos = turned_capture(tmp_path / str(like), orientations, [like] * 8)
        capture, warnings = taken(photos)
        assert "ingest-mask-turn-unknown" not in warnings
        found.append(maps(capture))
        for number in orientations:
            np.testing.assert_array_equal(mask_of(capture, number - 1), UPPER_LEFT)
    for upright, turned in zip(*found, strict=True):
        np.testing.assert_array_equal(turned, upright)


def test_maps_whose_turn_nothing_tells_are_upright_with_a_warning(tmp_path: Path) -> None:
    capture, warnings = taken(turned_capture(tmp_path, [1, 1, 3], [False] * 3))
    np.testing.assert_array_equal(mask_of(capture, 2), UPPER_LEFT)
    assert "2.jpg" in warnings["ingest-mask-turn-unknown"]
    assert "0.jpg" not in warnings["ingest-mask-turn-unknown"]
    _, warnings = taken(turned_capture(tmp_path / "1", [1, 1, 1], [True] * 3))
    assert "ingest-mask-turn-unknown" not in warnings


def test_maps_that_contradict_each_other_go_by_their_own_proportions(tmp_path: Path) -> None:
    capture, warnings = taken(turned_capture(tmp_path, [6, 8, 3], [True, False, False]))
    for number in range(3):
        np.testing.assert_array_equal(mask_of(capture, number), UPPER_LEFT)
    assert "2.jpg" in warnings["ingest-mask-turn-unknown"]
    assert "0.jpg" not in warnings["ingest-mask-turn-unknown"]


def test_labels_of_nought_and_one_are_a_mask(photos: Path, tmp_path: Path) -> None:
    capture, _ = taken(photos, masks=masked(tmp_path / "m", photos, HALF // 255))
    np.testing.assert_array_equal(mask_of(capture), HALF)


def refused(photos: Path, **settings: object) -> SplatError:
    with pytest.raises(SplatError) as found:
        taken(photos, **settings)
    return found.value


def test_a_mask_that_leaves_nothing_names_its_photograph(photos: Path, tmp_path: Path) -> None:
    folder = masked(tmp_path / "m", photos)
    name = names(photos)[1]
    save(folder / f"{Path(name).stem}.png", np.zeros_like(HALF))
    error = refused(photos, masks=folder)
    assert (error.code, name in error.given) == ("mask-empty", True)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "LA", "P", "1"])
def test_a_mask_of_one_colour_means_the_same_in_every_mode(
    photos: Path, tmp_path: Path, mode: str
) -> None:
    folder = masked(tmp_path / "m", photos)
    first = folder / f"{Path(names(photos)[0]).stem}.png"
    Image.fromarray(np.zeros_like(HALF)).convert(mode).save(first)
    assert refused(photos, masks=folder).code == "mask-empty"
    capture, _ = taken(photos, masks=folder, invert_masks=True)
    assert not capture.photos[0].mask or mask_of(capture).all()


def test_masks_that_take_nothing_away_are_refused(photos: Path, tmp_path: Path) -> None:
    error = refused(photos, masks=masked(tmp_path / "m", photos, np.full_like(HALF, 255)))
    assert (error.code, names(photos)[0] in error.given) == ("mask-full", True)


def test_masks_of_another_capture_are_refused(photos: Path, tmp_path: Path) -> None:
    folder = masked(tmp_path / "m", photos, form="x{stem}.png")
    assert refused(photos, masks=folder).code == "masks-of-others"
    wide = masked(tmp_path / "w", photos, HALF[:20])
    assert refused(photos, masks=wide).code == "mask-unfit"
    (tmp_path / "none").mkdir()
    assert refused(photos, masks=tmp_path / "none").code == "masks-missing"
    assert refused(photos, masks=tmp_path / "no such").code == "masks-missing"


def test_a_damaged_mask_is_named(photos: Path, tmp_path: Path) -> None:
    folder = masked(tmp_path / "m", photos)
    broken = folder / f"{Path(names(photos)[0]).stem}.png"
    broken.write_bytes(broken.read_bytes()[:40])
    assert broken.name in refused(photos, masks=folder).given


def test_photographs_without_a_mask_are_named(photos: Path, tmp_path: Path) -> None:
    folder = masked(tmp_path / "m", photos)
    name = names(photos)[2]
    (folder / f"{Path(name).stem}.png").unlink()
    save(folder / "stray.png", HALF)
    capture, warnings = taken(photos, masks=folder)
    assert [bool(photo.mask) for photo in capture.photos] == [True, True, False]
    assert name in warnings["ingest-mask-missing"]
    assert "stray.png" in warnings["ingest-mask-unused"]


def test_a_mask_that_changed_makes_ingest_run_again(photos: Path, tmp_path: Path) -> None:
    from stages.run.pipeline import Pipeline

    folder = masked(tmp_path / "m", photos)
    settings = {"ingest": IngestSettings(masks=folder)}
    Pipeline(tmp_path / "run", photos).run(settings, until="ingest")
    (step, *_) = Pipeline(tmp_path / "run", photos).plan(settings)
    assert not step.will_run
    save(folder / f"{Path(names(photos)[0]).stem}.png", 255 - HALF)
    (step, *_) = Pipeline(tmp_path / "run", photos).plan(settings)
    assert "masks file" in step.reason
