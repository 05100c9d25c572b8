"""The table of formats: one row for each that is written, and what follows from the rows."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from stages.base.errors import Family, SplatError


@dataclass(frozen=True)
class Format:
    """One row. Functions are named as "module:function" and imported when they are first wanted:
    so rows may name rooms above this one, and reading the table costs nothing.

    ending: what a file's name ends in, without the dot; also what `--format` takes.
    opens_in, keeps: for README's table. loses: what of the splats is not the same any more, as the
    end of "the format ..."; "" if everything comes back as float32. sh_degree: the highest kept.
    y_up: whether its axes are y up, turned 180 degrees about x from ours. sidecar: the suffix of a
    file beside it that belongs to it. wants_views: whether the writer takes cameras too.
    needs_finetuning: whether it rounds so much that splats should learn to live with it.
    streamed: of detail, which streams: the name is `ending` alone, its chunks lie in folders beside
    it, and a folder holds one such asset; `splat edit` writes it.

    Of splats:
    writer (path, splats, *, units, and views if it wants them) -> how many could not be drawn;
    reader (path) -> Splats, y down; raises SplatError "splats-unreadable";
    second_reader (path) -> Splats in the file's axes, sharing no code with the writer; may raise
    anything; anatomy (path) -> Anatomy; order (splats) -> [N] the row that each row of the file
    comes from, if it sorts them; coarse (splats, bits) -> Splats in fewer bits, if the format packs
    what repeats; validator (path) -> list of complaints, if another program has
    one.

    Of a mesh (no reader): writer (path, mesh, units); second_reader (path) -> (vertices [V, 3],
    faces [F, 3]) in the world's axes.
    """

    ending: str
    opens_in: str
    keeps: str
    writer: str
    second_reader: str
    reader: str = ""
    anatomy: str = ""
    order: str = ""
    quantiser: str = ""
    validator: str = ""
    loses: str = ""
    sh_degree: int = 3
    y_up: bool = False
    sidecar: str = ""
    wants_views: bool = False
    needs_finetuning: bool = False
    streamed: bool = False

    @property
    def is_mesh(self) -> bool:
        return not self.reader

    def matches(self, name: str) -> bool:
        """Whether a file of this name, in small letters, is of this format."""
        return name == self.ending if self.streamed else name.endswith("." + self.ending)

    def name(self, stem: str) -> str:
        """What a file of this format is called."""
        return self.ending if self.streamed else f"{stem}.{self.ending}"

    def files(self, path: Path) -> list[Path]:
        """`path` and what lies beside it and belongs to it."""
        page = path.with_suffix(self.sidecar) if self.sidecar else path
        beside = [path, page] if page != path and page.is_file() else [path]
        if self.streamed:
            every = sorted(path.parent.glob("*_*/*"))
            return [*beside, *(file for file in every if CHUNK.match(file.parent.name))]
        return beside

    def size_bytes(self, path: Path) -> int:
        return sum(file.stat().st_size for file in self.files(path))


@dataclass(frozen=True)
class ByteBreakdown:
    """Where the bytes of a file are. parts: by attribute. unpacked: whether they are counted before
    the compression that packs them all together. unknown: why there are no parts."""

    parts: dict[str, int]
    unpacked: bool = False
    unknown: str = ""


CHUNK = re.compile(r"[0-9]+_[0-9]+$")  # folders of a streamed asset: level, number

_GLB = Format(
    "glb",
    opens_in="viewers with KHR_gaussian_splatting; others show points",
    keeps="everything",
    writer="stages.formats.gltf:write",
    reader="stages.formats.gltf_read:read",
    second_reader="stages.proof.independent_readers:gltf",
    anatomy="stages.proof.byte_breakdown:gltf",
    y_up=True,
)
_USD = Format(
    "usda",
    opens_in="USD tools with particle fields (OpenUSD 26.03 or newer)",
    keeps="everything",
    writer="stages.formats.usd:write",
    reader="stages.formats.usd_read:read",
    second_reader="stages.proof.independent_readers:usd",
    anatomy="stages.proof.byte_breakdown:usd",
    validator="stages.proof.usd_validators:complaints",
    y_up=True,
)
_MESH = Format(
    "mesh.ply",
    opens_in="game engines, mesh tools",
    keeps="no splats: triangles to collide with, see below",
    writer="stages.surface.ply:write",
    second_reader="stages.surface.checks:read_ply",
)
TABLE = (
    Format(
        "ply",
        opens_in="nearly everything that knows splats",
        keeps="everything, float32",
        writer="stages.formats.ply:write",
        reader="stages.formats.ply:read",
        second_reader="stages.proof.independent_readers:ply",
        anatomy="stages.proof.byte_breakdown:ply",
    ),
    Format(
        "splat",
        opens_in="web viewers",
        keeps="8-bit colour and rotation; the mean of the colours that photographs see",
        writer="stages.formats.splat32:write",
        reader="stages.formats.splat32:read",
        second_reader="stages.proof.independent_readers:splat",
        anatomy="stages.proof.byte_breakdown:splat",
        order="stages.formats.splat32:order",
        loses="has 8-bit colours that do not change with the view",
        sh_degree=0,
        needs_finetuning=True,
    ),
    _GLB,
    replace(_GLB, ending="gltf", sidecar=".bin"),
    _USD,
    replace(_USD, ending="usdc"),
    replace(_USD, ending="usdz"),
    replace(
        _GLB,
        ending="quantised.glb",
        opens_in="as `glb`; three.js blends splats of each degree of view dependence by themselves",
        keeps="sizes, rotations and opacities in 16 bits",
        writer="stages.formats.gltf_quantised:write",
        order="stages.formats.gltf_quantised:order",
        loses="has rotations, sizes and opacities of 16 bits",
    ),
    Format(
        "compressed.ply",
        opens_in="PlayCanvas, SuperSplat, Spark",
        keeps="positions and sizes to 1/1000 of those of 256 neighbours, 8-bit colour",
        writer="stages.formats.compressed_ply:write",
        reader="stages.formats.compressed_ply:read",
        second_reader="stages.proof.independent_packed:compressed_ply",
        anatomy="stages.proof.byte_breakdown:ply",
        order="stages.scene.morton:morton_order",
        loses="has positions and sizes of 10 and 11 bits, and 8-bit colours",
        needs_finetuning=True,
    ),
    Format(
        "spz",
        opens_in="Spark, Open3D, three.js",
        keeps="sizes to 3 %, 8-bit colour, 4 to 5 bits of view-dependent colour",
        writer="stages.formats.spz:write",
        reader="stages.formats.spz_read:read",
        second_reader="stages.proof.independent_packed:spz",
        anatomy="stages.proof.byte_breakdown:spz",
        loses="has sizes in steps of 6 %, 8-bit colours and view-dependent colour of 4 and 5 bits",
        needs_finetuning=True,
        y_up=True,
    ),
    Format(
        "sog",
        opens_in="PlayCanvas, SuperSplat, Spark",
        keeps="16-bit positions, 256 sizes and colours, a palette of view-dependent colours",
        writer="stages.formats.sog:write",
        reader="stages.formats.sog_read:read",
        second_reader="stages.proof.independent_packed:sog",
        anatomy="stages.proof.byte_breakdown:sog",
        order="stages.scene.morton:morton_order",
        quantiser="stages.formats.quantisation:quantise_for_sog",
        loses="has 256 sizes and colours, and a palette of view-dependent colours",
        needs_finetuning=True,
    ),
    Format(
        "lod-meta.json",
        opens_in="PlayCanvas, SuperSplat, which load what is near first",
        keeps="as `sog`, in chunks and levels of detail; written by `splat edit`",
        writer="stages.editing.levels:write",
        reader="stages.formats.streamed_sog:read",
        second_reader="stages.proof.independent_packed:streamed_sog",
        anatomy="stages.proof.byte_breakdown:streamed_sog",
        order="stages.formats.streamed_sog:order",
        loses="has 256 sizes and colours, and a palette of view-dependent colours",
        sidecar=".html",
        wants_views=True,
        streamed=True,
    ),
    Format(
        "html",
        opens_in="any browser, from disk, without a network",
        keeps="everything; the viewer and the cameras too",
        writer="stages.formats.html:write",
        reader="stages.formats.html:read",
        second_reader="stages.proof.independent_readers:html",
        anatomy="stages.proof.byte_breakdown:html",
        wants_views=True,
    ),
    replace(
        _MESH,
        ending="mesh.glb",
        writer="stages.surface.gltf:write",
        second_reader="stages.surface.checks:read_glb",
        y_up=True,
    ),
    _MESH,
)
# By ending: all of them, the formats of one file of splats, and those of meshes.
BY_ENDING = {row.ending: row for row in TABLE}
FORMATS = {row.ending: row for row in TABLE if not row.is_mesh and not row.streamed}
MESHES = {row.ending: row for row in TABLE if row.is_mesh}


def format_of(path: Path) -> Format:
    """The format of splats that the end of the name says.

    Raises SplatError "format-unknown", and "format-mesh" for the name of a mesh.
    """
    name = Path(path).name.lower()
    rows = [row for row in TABLE if row.matches(name)]
    if not rows:
        raise SplatError(
            "format-unknown",
            given=f"{path} has the suffix {Path(path).suffix!r}.",
            wanted=f"One of {', '.join('.' + known for known in FORMATS)}.",
            hint="Choose a name with one of these suffixes.",
            family=Family.USAGE,
        )
    found = max(rows, key=lambda row: len(row.ending))
    if found.is_mesh:
        raise SplatError(
            "format-mesh",
            given=f"{path} is the name of a mesh: .{found.ending} holds {found.keeps}.",
            wanted="A file of splats: a mesh is made with the cameras of a run.",
            hint=f"In the run's folder: splat export --format {found.ending}",
            family=Family.USAGE,
        )
    return found
