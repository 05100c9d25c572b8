"""XML of other programs, which may come from anywhere."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from stages.base.bad_files import BadFileError
from stages.base.text import reason_of
from stages.cameras.camera_file import content_of


def parsed(path: Path) -> Element:
    """The root element. Raises BadFileError, also for entities, which may expand to gigabytes."""
    data = content_of(path)
    ascii_part = data.replace(b"\0", b"")  # of UTF-16 too, in either byte order
    if b"<!DOCTYPE" in ascii_part or b"<!ENTITY" in ascii_part:
        raise BadFileError("it declares entities, which no such file needs")
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise BadFileError(f"it is damaged ({reason_of(error)})") from error
