"""The options of `splat render`: which pictures are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from stages.base.errors import SplatError, UsageError
from stages.base.settings import setting

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
_option = partial(setting, panel="Options")


@dataclass(frozen=True)
class RenderOptions:
    """What is drawn, besides the splats; None where an option is not given."""

    camera: str | None = _option(
        None, "A photograph's name or number; by default the first, or one in front."
    )
    path: str | None = _option(
        None,
        "For films and frames: orbit (the default), capture (past the photographs' cameras), or a "
        "camera file (transforms.json, COLMAP folder).",
    )
    frames: int | None = _option(None, "How many frames along the path.", 1, 100_000)
    seconds: float | None = _option(
        None, "How long the film lasts; by default as long as its path needs.", 0.01, 3600
    )
    fps: float = _option(30.0, "Frames a second.", 1, 240)
    width: int | None = _option(None, "Width of the picture (pixels).", 1, 16384)
    depth: bool = _option(False, "Depth too, of pictures and frames: .depth.tiff of 32-bit floats.")

    def kind(self, out: Path) -> str:
        """picture, film or folder, by the name of `out`. Raises SplatError for options that do not
        go together."""
        suffix = "" if out.is_dir() else out.suffix.lower()
        if suffix in PICTURES:
            path = {"--path": self.path, "--frames": self.frames, "--seconds": self.seconds}
            given = [name for name, value in path.items() if value is not None]
            if given:
                raise _clash(f"{given[0]} makes many pictures, and {out} holds one.", "film.mp4")
            return "picture"
        if self.camera is not None and suffix in ("", ".mp4"):
            raise _clash(f"--camera makes one picture, and {out} is for many.", "view.png")
        if self.frames is not None and self.seconds is not None:
            raise UsageError(
                "render-length",
                given=f"--frames {self.frames} and --seconds {self.seconds:g}.",
                wanted="One of them: the other follows from --fps.",
                hint="Leave one of them away.",
            )
        if suffix == ".mp4" and self.depth:
            raise UsageError(
                "render-depth",
                given=f"--depth writes a .depth.tiff for each picture, and {out} is a film.",
                wanted="A picture, or a folder of frames.",
                hint="For example --out frames",
            )
        if suffix == ".mp4":
            return "film"
        if out.is_dir() or (not suffix and not out.exists()):
            return "folder"
        raise UsageError(
            "render-picture-type",
            given=f"{out} cannot hold a rendering.",
            wanted=f"A name that ends in one of {' '.join((*PICTURES, '.mp4'))}, or a folder's.",
            hint="For example --out view.png, --out film.mp4 or --out frames",
        )


def _clash(given: str, example: str) -> SplatError:
    return UsageError(
        "render-one-or-many",
        given=given,
        wanted="One picture of one camera, or many along a path.",
        hint=f"For example --out {example}",
    )
