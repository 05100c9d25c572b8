"""The table of splat formats: one row for each format, and what follows from the rows.

Reading it imports nothing, because settings and help are made from it. The functions of each format
are in `stages.formats.codecs`, its checks in `stages.proof.checks`, by the same endings.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from stages.base.errors import UsageError

AUTO, PLAIN, ANTIALIASED = DRAWINGS = "auto", "plain", "antialiased"


@dataclass(frozen=True)
class Format:
    """One splat format.

    Attributes:
        ending: what a file's name ends in, without the dot; also the value of `--format`.
        loses: what of the splats changes, as the end of "the format ..."; "" if every value comes
            back as float32.
        sh_degree: the highest SH degree that is kept.
        y_up: whether the file's axes are y up, turned 180 degrees about x from ours.
        holds_origin: whether a file holds the origin of a georeferenced scene; else it is written
            beside, see `stages.formats.offset`.
        sidecar: the suffix of a file beside it that belongs to it; "" if there is none.
        takes_views: whether the file also holds cameras.
        has_bit_depths: whether splats are rounded to chosen bit depths before they are written,
            because the format compresses repeated values.
        needs_finetuning: whether rounding is so coarse that splats are fine-tuned to it.
        drawn_antialiased: whether programs that the format is for draw it with opacity
            compensation.
        says_drawing: whether a file says that its splats are to be drawn so.
        streamed: whether the asset has levels of detail. Its file name is `ending` alone, its
            chunks lie in folders beside it, and a folder holds one such asset.
        on_globe: whether programs put it where it lies on the earth.
        written: whether it is written, too; others are read.
    """

    ending: str
    loses: str = ""
    sh_degree: int = 3
    y_up: bool = False
    holds_origin: bool = True
    sidecar: str = ""
    takes_views: bool = False
    has_bit_depths: bool = False
    needs_finetuning: bool = False
    drawn_antialiased: bool = False
    says_drawing: bool = True
    streamed: bool = False
    on_globe: bool = False
    written: bool = True

    def matches(self, name: str) -> bool:
        """Whether a file of this lower-case name is of this format."""
        return name == self.ending if self.streamed else name.endswith("." + self.ending)

    def holds_antialiased(self, drawing: str) -> bool:
        """Whether a file of the format holds splats for opacity compensation, under a choice among
        `DRAWINGS`."""
        return drawing == ANTIALIASED or (drawing == AUTO and self.drawn_antialiased)

    def file_name(self, stem: str) -> str:
        """The name of a file of this format."""
        return self.ending if self.streamed else f"{stem}.{self.ending}"

    def files(self, path: Path) -> list[Path]:
        """`path` and the files beside it that belong to it. Raises SplatError "splats-unreadable"
        if the asset has parts and does not name them."""
        page = path.with_suffix(self.sidecar) if self.sidecar else path
        beside = [path, page] if page != path and page.is_file() else [path]
        if self.streamed:
            from stages.formats.codecs import CODECS  # they load NumPy, the table does without

            parts = CODECS[self.ending].parts
            assert parts is not None
            return [*beside, *sorted(set(parts(path).values()) - set(beside))]
        return beside

    def size_bytes(self, path: Path) -> int:
        """The size of all files of the asset at `path`."""
        return sum(file.stat().st_size for file in self.files(path))


_MESH = re.compile(r"\.mesh\.(glb|ply)$")  # of the names of meshes

TABLE = (
    Format("ply"),
    Format(
        "splat",
        loses="has 8-bit colours that do not change with the view",
        sh_degree=0,
        needs_finetuning=True,
        says_drawing=False,
        holds_origin=False,
    ),
    Format("glb", y_up=True),
    Format("gltf", y_up=True, sidecar=".bin"),
    Format("usda", y_up=True),
    Format("usdc", y_up=True),
    Format("usdz", y_up=True),
    Format("quantised.glb", loses="has rotations, sizes and opacities of 16 bits", y_up=True),
    Format(
        "spz.glb",
        loses="has sizes in steps of 6 %, 8-bit colours and view-dependent colour of 4 and 5 bits",
        needs_finetuning=True,
        drawn_antialiased=True,
        y_up=True,
    ),
    Format(
        "compressed.ply",
        loses="has positions and sizes of 10 and 11 bits, and 8-bit colours",
        needs_finetuning=True,
    ),
    Format(
        "spz",
        holds_origin=False,
        loses="has sizes in steps of 6 %, 8-bit colours and view-dependent colour of 4 and 5 bits",
        needs_finetuning=True,
        drawn_antialiased=True,
        y_up=True,
    ),
    Format(
        "v4.spz",
        holds_origin=False,
        loses="has sizes in steps of 6 %, 8-bit colours and view-dependent colour of 4 and 5 bits",
        needs_finetuning=True,
        drawn_antialiased=True,
        y_up=True,
    ),
    Format(
        "sog",
        has_bit_depths=True,
        loses="has 256 sizes and colours, and a palette of view-dependent colours",
        needs_finetuning=True,
    ),
    Format(
        "lod-meta.json",
        loses="has 256 sizes and colours, and a palette of view-dependent colours",
        sidecar=".html",
        takes_views=True,
        streamed=True,
    ),
    Format(
        "tileset.json",
        loses="has sizes in steps of 6 %, 8-bit colours and view-dependent colour of 4 and 5 bits",
        drawn_antialiased=True,
        y_up=True,
        streamed=True,
        on_globe=True,
    ),
    Format("html", takes_views=True, drawn_antialiased=True),
    Format("ksplat", loses="has 8-bit colours", written=False, says_drawing=False),
)
BY_ENDING = {row.ending: row for row in TABLE}
# what is written as one file each
FORMATS = {row.ending: row for row in TABLE if row.written and not row.streamed}


def format_of(path: Path) -> Format:
    """The splat format that the ending of the name stands for; the longest ending wins.

    Raises SplatError "format-unknown", and "format-mesh" for the name of a mesh.
    """
    name = Path(path).name.lower()
    if mesh := _MESH.search(name):
        raise UsageError(
            "format-mesh",
            given=f"{path} is the name of a mesh: .mesh.{mesh[1]} holds triangles, no splats.",
            wanted="A file of splats: a mesh is made with the cameras of a run.",
            hint=f"In the run's folder: splat export --format mesh.{mesh[1]}",
        )
    rows = [row for row in TABLE if row.matches(name)]
    if not rows:
        raise UsageError(
            "format-unknown",
            given=f"{path} has the suffix {Path(path).suffix!r}.",
            wanted=f"One of {', '.join('.' + known for known in FORMATS)}.",
            hint="Choose a name with one of these suffixes.",
        )
    return max(rows, key=lambda row: len(row.ending))
