"""A report as one HTML file that needs no other: text, tables, embedded pictures."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.atomic import replacing

_LARGEST_SIDE = 640  # pixels of a picture in a report
_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}
h1{font-size:1.6rem} h2{font-size:1.2rem;margin-top:2.2rem} img{max-width:100%}
table{border-collapse:collapse;font-size:.9rem} th,td{padding:.2rem .8rem;text-align:right}
th:first-child,td:first-child{text-align:left} tr:nth-child(even){background:#f4f4f4}
.row{display:flex;gap:.5rem} figure{margin:0;flex:1} figcaption{font-size:.85rem;color:#555}
"""


def paragraphs(lines: Iterable[str]) -> str:
    return "".join(f"<p>{escape(line)}</p>" for line in lines)


def heading(text: str) -> str:
    return f"<h2>{escape(text)}</h2>"


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in headings)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def png(path: Path, description: str) -> str:
    """The PNG file at `path`; description: alternative text."""
    return _image("png", path.read_bytes(), description)


def pictures(captioned: Iterable[tuple[str, NDArray[np.floating]]]) -> str:
    """(caption, picture [H, W, 3] in [0, 1]) side by side."""
    figures = (
        f"<figure>{_image('jpeg', _jpeg(image), caption)}<figcaption>{escape(caption)}</figcaption>"
        "</figure>"
        for caption, image in captioned
    )
    return f'<div class="row">{"".join(figures)}</div>'


def write_page(path: Path, title: str, parts: Iterable[str]) -> None:
    """Write a page of HTML `parts`. Raises SplatError."""
    text = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body><h1>{escape(title)}</h1>{''.join(parts)}</body></html>"
    )
    with replacing(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def _image(kind: str, data: bytes, description: str) -> str:
    inside = base64.b64encode(data).decode("ascii")
    return f'<img alt="{escape(description)}" src="data:image/{kind};base64,{inside}">'


def _jpeg(image: NDArray[np.floating]) -> bytes:
    picture = Image.fromarray(np.uint8(np.clip(image, 0, 1) * 255 + 0.5))
    picture.thumbnail((_LARGEST_SIDE, _LARGEST_SIDE))
    file = io.BytesIO()
    picture.save(file, format="JPEG", quality=88)
    return file.getvalue()
