"""The page: one document with the viewer, our scripts and the data of the scene.

All but the splats and photographs of `splat view` is inside the document, and its content security
policy forbids other sources, so it works from disk and without a network.
"""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np

from stages.page.cameras import PageCamera, as_plain
from stages.scene import Splats

SCENE_START = '<script type="application/json" id="scene">'
CHUNK_START = '<script type="text/plain" class="splats">'
CHUNK_END = "</script>\n"
PAGE_END = "</body>\n</html>\n"
_SCRIPTS = ("lens.js", "levels.js", "content.js", "panel.js", "access.js", "select.js", "main.js")
_LIVE_SCRIPTS = ("orbit.js", "panel.js", "live.js")
_MIDDLE_PERCENT, _WIDER = (1, 99), 0.1
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src 'self' data: blob:; connect-src 'self' data: blob:"
)


def scene_data(
    title: str,
    splats: Splats,
    shots: Sequence[PageCamera],
    *,
    units: str,
    source: str,
    content: str = "",
    levels: Sequence[float] = (),
) -> dict[str, Any]:
    """The data of the page as JSON values.

    Args:
        title: of the page.
        splats: for their number and bounds.
        shots: the cameras.
        units: "metres" or "arbitrary".
        source: the file that `splat edit` would read.
        content: the address of the splats' .ply or of a lod-meta.json; "" if the document holds
            the splats.
        levels: width of the splats of each level of detail of a streamed asset.
    """
    return {
        "title": _in_utf8(title),
        "source": _in_utf8(source),
        "count": len(splats),
        "units": units,
        "antialias": splats.draw_settings.antialias,
        "content": content,
        "levels": list(levels),
        "bounds": _bounds(splats),
        "shots": [as_plain(shot, splats.means) for shot in shots],
    }


def _in_utf8(name: str) -> str:
    """The name of a file with escapes for bytes that are not UTF-8, which no page can hold."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _bounds(splats: Splats) -> dict[str, list[float]]:
    """The box that a selection starts from: it holds the central splats, because a few lie far
    away."""
    if not len(splats):
        return {"min": [0.0] * 3, "max": [0.0] * 3}
    low, high = np.percentile(splats.means, _MIDDLE_PERCENT, axis=0)
    wider = _WIDER * (high - low)
    return {"min": (low - wider).tolist(), "max": (high + wider).tolist()}


def head(scene: dict[str, Any]) -> str:
    """The document up to where splats may follow, in chunks between CHUNK_START and CHUNK_END."""
    return _head(scene, _asset("vendor", "supersplat-viewer.min.css"))


def live(scene: dict[str, Any]) -> str:
    """The page of live training: the trainer sends pictures, so it needs no viewer."""
    return _head(scene, _asset("parts", "live.css")) + _script(_LIVE_SCRIPTS) + PAGE_END


def _head(scene: dict[str, Any], style: str) -> str:
    # "<" is escaped so that no name can end the script element that holds it.
    data = json.dumps(scene, ensure_ascii=True, allow_nan=False).replace("<", "\\u003c")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{html.escape(_in_utf8(scene['title']))}</title>\n"
        f"<style>\n{style}\n{_asset('parts', 'page.css')}</style>\n</head>\n<body>\n"
        f"{_asset('parts', 'body.html')}<script>\n{_asset('parts', 'failure.js')}</script>\n"
        f"{SCENE_START}{data}{CHUNK_END}"
    )


def tail() -> str:
    """The scripts and the end of the document."""
    licence = _asset("vendor", "LICENSE").replace("--", "- -")
    return (
        f"<!-- SuperSplat Viewer and PlayCanvas engine:\n{licence}-->\n"
        f"<script>{_asset('vendor', 'supersplat-viewer.min.js')}</script>\n"
        f"{_script(_SCRIPTS)}{PAGE_END}"
    )


def _script(names: Sequence[str]) -> str:
    ours = "".join(_asset("parts", name) for name in names)
    return f"<script>\n(() => {{\n{ours}}})();\n</script>\n"


def _asset(*parts: str) -> str:
    return resources.files("stages.page").joinpath(*parts).read_text(encoding="utf-8")
