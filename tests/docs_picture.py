"""The picture of the packages: docs/packages.svg, drawn from the imports.

python -m tests.docs_picture writes it; tests/test_docs.py fails when it is stale. A package is
below everything that it imports. An arrow leads from a package to one that imports it, and is left
out where other arrows lead the same way, and for the packages of `EVERYWHERE`.
"""

from __future__ import annotations

import ast
import textwrap
from html import escape
from pathlib import Path

from tests.layers import LAYERS, MODULES, STAGES, imports_of, package_of

ROOT = Path(__file__).parent.parent
PICTURE = ROOT / "docs" / "packages.svg"
# Bars across the picture: nearly every package imports the first two, the last imports nearly all.
EVERYWHERE, LAST = ("stages.base", "stages.scene"), "splatcli"
# A package is in the middle column, as the stages are, unless it is named here.
LEFT = ("raster", "evaluate", "mesh", "tradeoff")
RIGHT = ("page", "formats", "proof", "editing", "viewer")
WIDTH, HEIGHT = 284, 74  # of a box, in pixels
BAR_HEIGHT = 48
COLUMN, ROW = 370, 108  # from one box to the next
MARGIN, GAP = 22, 8  # around the picture; between lines that run side by side
ACROSS = 2 * COLUMN + WIDTH
COLOURS = (
    *("#1f77b4", "#c2368f", "#2e8b57", "#b22222", "#6a51a3", "#7a4b1e", "#008b8b", "#b8860b"),
    *("#4d4d4d", "#e8702a"),
)

Graph = dict[str, set[str]]


def imports() -> Graph:
    """The packages that each package imports, in the order of the layers."""
    graph: Graph = {package: set() for layer in LAYERS for package in layer if package != "stages"}
    for name, path in MODULES.items():
        own = package_of(name)
        if own in graph:
            reached = imports_of(name, path.read_text(encoding="utf-8"), "running")
            graph[own] |= {package_of(module) for module in reached} & graph.keys() - {own}
    return graph


def reached_from(graph: Graph, package: str) -> set[str]:
    """Everything that a package imports, directly or not."""
    return graph[package].union(*(reached_from(graph, other) for other in graph[package]))


def arrows() -> list[tuple[str, str]]:
    """(imported, importer) of each arrow that is drawn."""
    drawn = {package: others - {*EVERYWHERE} for package, others in imports().items()}
    return [
        (other, package)
        for package, others in drawn.items()
        for other in sorted(others)
        if not any(other in reached_from(drawn, between) for between in others - {other})
    ]


def column_of(package: str) -> int:
    name = package.removeprefix("stages.")
    return 0 if name in LEFT else 2 if name in RIGHT else 1


def rows() -> dict[str, int]:
    """Row of each package, from the top. Layers share a row where their columns are free and
    neither imports from the other."""
    graph, row = imports(), -1
    found: dict[str, int] = {}
    for layer in LAYERS:
        left = set(layer) & graph.keys()
        while left:
            group = {package for package in left if not graph[package] & left}
            left -= group
            above = [package for package in found if found[package] == row]
            meets = any(column_of(a) == column_of(b) or a in graph[b] for a in above for b in group)
            bar = {*EVERYWHERE, LAST} & {*above, *group}
            row += 1 if meets or bar or not above else 0
            found |= dict.fromkeys(sorted(group), row)
    return found


class Drawing:
    """Places of boxes and lines. Lines of one package run in one colour and one channel."""

    def __init__(self) -> None:
        self.rows, self.arrows = rows(), arrows()
        sources = list(dict.fromkeys(source for source, _ in self.arrows))
        self.colour = {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(sources)}
        self.channels: dict[int, list[str]] = {}  # sources by gutter
        self.tracks: dict[int, list[str]] = {}  # sources by the gap above a row
        self.entries: dict[str, list[str]] = {}  # sources by the package that imports them
        for source, target in self.arrows:
            self.entries.setdefault(target, []).append(source)
        for entries in self.entries.values():
            entries.sort(key=self._from_left)

    def _from_left(self, source: str) -> tuple[int, int]:
        return column_of(source), self.rows[source]

    def x(self, package: str) -> int:
        return MARGIN + column_of(package) * COLUMN

    def y(self, row: int) -> int:
        bars = min(row, len(EVERYWHERE))
        return MARGIN + row * ROW - bars * (ROW - BAR_HEIGHT - 2 * GAP)

    def path(self, source: str, target: str) -> list[tuple[float, float]]:
        """Corners of the line from `source` down to `target`."""
        end_x, end_y = self._entry(source, target), self.y(self.rows[target]) - 3
        start_y = self.y(self.rows[source]) + HEIGHT
        beside = {p for p, row in self.rows.items() if column_of(p) == column_of(source)}
        between = range(self.rows[source] + 1, self.rows[target])
        free = not any(self.rows[package] in between for package in beside)
        if free and (target == LAST or column_of(source) == column_of(target)):
            return [(end_x, start_y), (end_x, end_y)]
        into_y = self._track(self.rows[target], source)
        start_x = self.x(source) + WIDTH / 2
        if not between:
            return [(start_x, start_y), (start_x, into_y), (end_x, into_y), (end_x, end_y)]
        gutter = min(column_of(source), 1) if column_of(source) != 1 else int(end_x > start_x)
        out_y, x = self._track(self.rows[source] + 1, source), self._channel(gutter, source)
        return [
            *((start_x, start_y), (start_x, out_y), (x, out_y)),
            *((x, into_y), (end_x, into_y), (end_x, end_y)),
        ]

    def _entry(self, source: str, target: str) -> float:
        """Where a line enters a box from above: lines from the left to the left of others."""
        entries = self.entries[target]
        if target == LAST:
            return self.x(source) + WIDTH * (entries.index(source) % 2 + 1) / 3
        return self.x(target) + WIDTH * (entries.index(source) + 1) / (len(entries) + 1)

    def _channel(self, gutter: int, source: str) -> float:
        lines = self.channels.setdefault(gutter, [])
        if source not in lines:
            lines.append(source)
        return MARGIN + gutter * COLUMN + WIDTH + 12 + GAP * lines.index(source)

    def _track(self, row: int, source: str) -> float:
        lines = self.tracks.setdefault(row, [])
        if source not in lines:
            lines.append(source)
        return self.y(row - 1) + HEIGHT + 6 + 5 * lines.index(source)

    def box(self, package: str) -> str:
        """A package with the first sentence of its docstring."""
        bar = package in (*EVERYWHERE, LAST)
        x, y = MARGIN if bar else self.x(package), self.y(self.rows[package])
        width, height = (ACROSS, BAR_HEIGHT) if bar else (WIDTH, HEIGHT)
        name = package.removeprefix("stages.")
        fill = "#e8f0fb" if name in STAGES else "#f6f6f6"
        lines = textwrap.wrap(summary_of(package), 150 if bar else 46)[:3]
        text = [f'<text x="{x + 10}" y="{y + 19}" class="name">{escape(name)}</text>']
        for number, line in enumerate(lines):
            at = y + 36 + 15 * number
            text.append(f'<text x="{x + 10}" y="{at}" class="says">{escape(line)}</text>')
        size = f'width="{width}" height="{height}"'
        return "\n".join(
            [f'<rect x="{x}" y="{y}" {size} rx="5" fill="{fill}" stroke="#555"/>', *text]
        )

    def line(self, source: str, target: str) -> str:
        corners = " ".join(f"{x:g},{y:g}" for x, y in self.path(source, target))
        name = list(self.colour).index(source) % len(COLOURS)
        style = f'stroke="{self.colour[source]}" marker-end="url(#head{name})"'
        return f'<polyline points="{corners}" {style}/>'

    def svg(self) -> str:
        width, height = ACROSS + 2 * MARGIN, self.y(self.rows[LAST]) + BAR_HEIGHT + MARGIN
        heads = "".join(
            f'<marker id="head{i}" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="6" '
            f'markerHeight="6" orient="auto"><path d="M0 0 8 4 0 8z" fill="{colour}"/></marker>'
            for i, colour in enumerate(COLOURS)
        )
        return "\n".join(
            [
                f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">',
                "<title>The packages of splat and what they import</title>",
                "<style>text{font-family:sans-serif;fill:#222}.name{font-size:15px;"
                "font-weight:bold}.says{font-size:11px}polyline{fill:none;stroke-width:1.8;"
                "stroke-linejoin:round}</style>",
                f"<defs>{heads}</defs>",
                f'<rect width="{width}" height="{height}" fill="#fff"/>',
                *(self.line(*arrow) for arrow in self.arrows),
                *(self.box(package) for package in self.rows),
                "</svg>\n",
            ]
        )


def summary_of(package: str) -> str:
    """The first paragraph of a package's docstring."""
    path = ROOT.joinpath(*package.split("."), "__init__.py")
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(text.split("\n\n")[0].split()).replace("`", "").replace("->", "to")


if __name__ == "__main__":
    PICTURE.write_text(Drawing().svg(), encoding="utf-8")
