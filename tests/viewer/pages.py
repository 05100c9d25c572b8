"""Pages taken apart, and what they are made for."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from typing import Any

import numpy as np

from stages.scene import View, look_at
from tests import scenes

HOSTILE = 'a</script><script>alert(1)</script>"&<!--'


class Elements(HTMLParser):
    """All start tags, and the text of scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append((dict(attrs), ""))

    def handle_data(self, data: str) -> None:
        if self.tags and self.tags[-1][0] == "script" and self.scripts:
            attrs, text = self.scripts[-1]
            self.scripts[-1] = (attrs, text + data)

    def scene(self) -> Any:
        return next(json.loads(text) for attrs, text in self.scripts if attrs.get("id") == "scene")


def views(count: int = 9) -> tuple[View, ...]:
    made = []
    for i in range(count):
        matrix = look_at(np.array([np.sin(i), -1.0, -4.0]), np.zeros(3))
        made.append(View(f"{i}.jpg", f"images/{i}.jpg", scenes.camera(matrix=matrix)))
    return tuple(made)
