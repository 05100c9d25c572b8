"""Applies masks and transparency to a photograph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.errors import SplatError
from stages.base.text import listed
from stages.ingest.decode import FORMATS, MAX_MEGAPIXELS, UPRIGHT, Decoded
from stages.ingest.masks import FOLDER
from stages.scene import IGNORE, TRANSPARENT, Photo, evenly_spaced
from stages.scene.capture import PHOTOS_FOLDER

AUTO = "auto"
MAX_ASPECT_DIFFERENCE = 0.03  # relative; more: a mask of another photograph
MIN_SHARE = 1e-3  # of a photograph; less inside its mask counts as nothing
# Masks cut out an object if, in so many of them, what is kept is at most so much of the picture and
# of its border, and nearly all of it is connected. One that is the same in all pictures is of the
# lens: this much of what any mask keeps is then kept by all.
CUTS_OUT, OBJECT, OBJECT_AT_BORDER, OBJECT_CONNECTED, OF_LENS = 0.9, 0.5, 0.25, 0.9, 0.95
_LOOKED_AT, _SIDE = 48, 128  # masks, evenly spaced, at this size


@dataclass(frozen=True)
class MaskedPhoto:
    """A photograph and the part of it that counts.

    Args:
        decoded: over black where it is transparent.
        mask: [H, W], 0 outside; None where everything counts.
        outside: what is outside, as in `scene.Photo`.
        scaled: whether a mask file had another size than the photograph.
    """

    decoded: Decoded
    mask: NDArray[np.uint8] | None = None
    outside: str = ""
    scaled: bool = False

    @property
    def share(self) -> float:
        """The share of the photograph that is inside."""
        return 1.0 if self.mask is None else float(np.mean(self.mask > 127))

    @classmethod
    def of(
        cls,
        decoded: Decoded,
        name: str,
        file: Path | None,
        invert: bool,
        means: str,
        as_stored: bool = False,
    ) -> MaskedPhoto:
        """Apply the photograph's alpha channel and a mask file.

        Args:
            decoded: the photograph.
            name: its name, for messages.
            file: the mask, white inside; None without one.
            invert: the mask is black inside.
            means: IGNORE, TRANSPARENT, or AUTO: outside a mask file is ignored, and outside alpha
                alone is transparent.
            as_stored: see `turned_with`.

        Raises:
            SplatError: "mask-unfit".
        """
        if file is None and decoded.alpha is None:
            return cls(decoded)
        mask, scaled = decoded.alpha, False
        if file is not None:
            kept, scaled = _read(file, name, invert, decoded, as_stored)
            solid = np.uint8(255) if mask is None else mask
            mask = np.where(kept, solid, np.uint8(0))
        assert mask is not None
        outside = means if means != AUTO else TRANSPARENT if file is None else IGNORE
        if outside == TRANSPARENT and file is not None:
            black = np.where(mask[..., None] > 0, decoded.pixels, np.uint8(0))
            decoded = replace(decoded, pixels=black, unchanged_jpeg=None)
        return cls(decoded, mask, outside, scaled)

    def without(self, file: Path, name: str) -> MaskedPhoto:
        """The photograph without the parts where the mask in `file` is black. Raises SplatError
        "mask-unfit"."""
        kept, scaled = _read(file, name, False, self.decoded)
        mask = np.where(kept, np.uint8(255) if self.mask is None else self.mask, np.uint8(0))
        return MaskedPhoto(self.decoded, mask, IGNORE, self.scaled or scaled)

    def file(self, image: str) -> str:
        """Where the mask of the normalised picture `image` goes; "" without one."""
        return f"{FOLDER}/{image.removeprefix(PHOTOS_FOLDER)}.png" if self.outside else ""


def cuts_out_object(masks: Sequence[Path], invert: bool) -> bool:
    """Whether the masks of a capture keep one object that stands free in nearly every photograph,
    and not the circle of a lens.

    No view says anything about the space around such an object: splats there would be seen from
    everywhere, as fog.

    Args:
        masks: files, one for each photograph; unreadable ones do not count.
        invert: they are black inside.
    """
    kept = []
    for path in evenly_spaced(masks, _LOOKED_AT):
        try:
            inside = _bright(_opened(path, path.name))
        except SplatError:
            continue
        small = cv2.resize(inside.astype(np.float32), (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
        kept.append((small > 0.5) ^ invert)
    if not kept or np.mean([_is_object(one) for one in kept]) < CUTS_OUT:
        return False
    return bool(np.all(kept, axis=0).sum() < OF_LENS * np.any(kept, axis=0).sum())


def _is_object(kept: NDArray[np.bool_]) -> bool:
    """Whether what a mask [S, S] keeps is an object that stands free."""
    border = np.concatenate([kept[0], kept[-1], kept[1:-1, 0], kept[1:-1, -1]])
    if not 0 < kept.mean() <= OBJECT or border.mean() > OBJECT_AT_BORDER:
        return False
    areas = cv2.connectedComponentsWithStats(kept.astype(np.uint8))[2][1:, cv2.CC_STAT_AREA]
    return bool(areas.max() >= OBJECT_CONNECTED * areas.sum())


def check_shares(photos: Sequence[Photo], shares: Sequence[float], files: bool) -> None:
    """Check that masks leave something and remove something.

    Args:
        photos: all of the capture.
        shares: of each photograph that is inside its mask.
        files: whether there are mask files.

    Raises:
        SplatError: "mask-empty" if a mask leaves nothing, "mask-full" if no mask removes anything.
    """
    empty = [p.name for p, share in zip(photos, shares, strict=True) if share < MIN_SHARE]
    if empty:
        raise SplatError(
            "mask-empty",
            given=f"Masks leave nothing of {listed(empty)}.",
            wanted="White where a photograph counts, black elsewhere.",
            hint="Remove these photographs; or add --invert-masks if their masks are black inside.",
        )
    masked = [share for photo, share in zip(photos, shares, strict=True) if photo.mask]
    if files and masked and min(masked) == 1.0:
        names = [photo.name for photo in photos if photo.mask]
        raise SplatError(
            "mask-full",
            given=f"Masks remove nothing from any photograph: {listed(names)}.",
            wanted="White where a photograph counts, black elsewhere.",
            hint="Check the masks, or remove them.",
        )


def _read(
    path: Path, name: str, invert: bool, decoded: Decoded, as_stored: bool = False
) -> tuple[NDArray[np.bool_], bool]:
    """([H, W] what the mask keeps, whether it had another size than the photograph's file). Raises
    SplatError "mask-unfit"."""
    image, sizes = turned_with(_opened(path, name), decoded, as_stored)
    if sizes:
        raise _unfit(path, name, f"it is {sizes}")
    kept = _bright(image) ^ invert
    height, width = decoded.pixels.shape[:2]
    resized = cv2.resize(
        kept.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST_EXACT
    )
    return np.asarray(resized > 0), image.size != decoded.upright


def turned_with(
    image: Image.Image, decoded: Decoded, as_stored: bool = False
) -> tuple[Image.Image, str]:
    """(a mask or a depth map, turned upright with its photograph if it has the orientation of the
    stored file; "", or both sizes in words if their proportions still differ). as_stored: whether
    it has that orientation if its proportions do not tell."""
    upright, stored, orientation = decoded.upright, decoded.stored, decoded.exif.orientation
    fits = same_aspect(image.size, stored)
    if same_aspect(image.size, upright) and not (as_stored and fits):
        return image, ""
    if fits:
        return image.transpose(UPRIGHT[orientation]) if orientation != 1 else image, ""
    return image, f"{image.width} x {image.height}, the photograph {upright[0]} x {upright[1]}"


def size_of(path: Path) -> tuple[int, int] | None:
    """(width, height) of a mask; None if it cannot be read."""
    try:
        with Image.open(path, formats=[kind for kind in FORMATS if kind in Image.OPEN]) as image:
            return image.size
    except Exception:  # decoders raise whatever the damage leads to
        return None


def _opened(path: Path, name: str) -> Image.Image:
    readable = [kind for kind in FORMATS if kind in Image.OPEN]
    try:
        with Image.open(path, formats=readable) as image:
            if image.width * image.height <= MAX_MEGAPIXELS * 1_000_000:
                image.load()
                return image.copy()
    except Exception as error:  # decoders raise whatever the damage leads to
        denied = isinstance(error, PermissionError)
        why = "permission to read it is denied" if denied else "it is damaged, or not a picture"
        raise _unfit(path, name, why) from error
    raise _unfit(path, name, f"it has more than {MAX_MEGAPIXELS} megapixels")


def _bright(image: Image.Image) -> NDArray[np.bool_]:
    """[H, W] where a mask is brighter than half of its brightest pixel."""
    values = _values(image)
    return values > 0.5 * max(float(values.max()), 1.0)


def _values(image: Image.Image) -> NDArray[np.float32]:
    """[H, W] brightness, or alpha if it varies and the colour does not."""
    if image.mode in ("P", "PA") or "transparency" in image.info:
        image = image.convert("RGBA")
    if image.mode in ("RGBA", "LA"):
        alpha = np.asarray(image.getchannel("A"), np.float32)
        colour = np.asarray(image.convert("RGBA").convert("L"), np.float32)
        is_alpha = np.ptp(colour) == 0 and np.ptp(alpha) > 0
        return alpha if is_alpha else np.minimum(colour, alpha)
    grey = image if image.mode in ("1", "L") or image.mode[0] in "IF" else image.convert("L")
    return np.asarray(grey, np.float32)


def same_aspect(size: tuple[int, int], wanted: tuple[int, int]) -> bool:
    """Whether both have the same aspect ratio, to a few hundredths."""
    return abs(size[0] * wanted[1] / (size[1] * wanted[0]) - 1.0) < MAX_ASPECT_DIFFERENCE


def _unfit(path: Path, name: str, why: str) -> SplatError:
    return SplatError(
        "mask-unfit",
        given=f"{path}, the mask of {name}, cannot be used: {why}.",
        wanted="A grey picture with its photograph's proportions, white where that counts.",
        hint="If they are masks of another capture, remove them, or name a folder with --masks.",
    )
