"""What is wrong with a JPEG that decoders accept without a word: they fill what is missing with
grey, and walk over the whole picture for each of any number of scans."""

from __future__ import annotations

import re

# In a scan's data every FF is followed by 00 (stuffing) or D0-D7 (restart), or it is fill (FF FF).
_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)
_TRUNCATED = "the file is truncated"
_MOST_SCANS = 100  # a progressive JPEG has about ten
_START, _END, _SCAN, _TEM = 0xD8, 0xD9, 0xDA, 0x01


def fault_of(data: bytes) -> str:
    """Why the first image in `data` is refused: it lacks its end-of-image marker (ITU-T T.81, annex
    B), or has very many scans. "" if it is well.

    Walks over the segments, so that an end marker within a thumbnail or a comment does not count.
    """
    if data[:2] != b"\xff\xd8":
        return _TRUNCATED
    position, scans = 2, 0
    while position + 1 < len(data):
        if data[position] != 0xFF:
            return _TRUNCATED
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker == _END:
            return ""
        if marker == _TEM or _START > marker >= 0xD0:
            position += 2
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == _SCAN:
            found = _MARKER_IN_SCAN.search(data, position)
            scans += 1
            if scans > _MOST_SCANS:
                return f"it has more than {_MOST_SCANS} scans"
            if found is None:
                return _TRUNCATED
            position = found.end() - 2
    return _TRUNCATED
