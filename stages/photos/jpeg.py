"""Whether a JPEG is whole. Decoders fill what is missing with grey and do not say so."""

from __future__ import annotations

import re

# In a scan's data every FF is followed by 00 (stuffing) or D0-D7 (restart), or it is fill (FF FF).
_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)
_START, _END, _SCAN, _TEM = 0xD8, 0xD9, 0xDA, 0x01


def ends_properly(data: bytes) -> bool:
    """True if the first image in `data` has its end-of-image marker (ITU-T T.81, annex B).

    Walks over the segments, so that an end marker within a thumbnail or a comment does not count.
    """
    if data[:2] != b"\xff\xd8":
        return False
    position = 2
    while position + 1 < len(data):
        if data[position] != 0xFF:
            return False
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker == _END:
            return True
        if marker == _TEM or _START > marker >= 0xD0:
            position += 2
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == _SCAN:
            found = _MARKER_IN_SCAN.search(data, position)
            if found is None:
                return False
            position = found.end() - 2
    return False
