"""How child processes ended, in words."""

from __future__ import annotations

import pytest

from stages.base.parent import how_it_ended


@pytest.mark.parametrize(
    ("status", "text"),
    [
        (3, "status 3"),
        (-6, "signal 6 (SIGABRT)"),
        (-9, "signal 9 (SIGKILL), probably because memory ran out,"),
        (-11, "signal 11 (SIGSEGV), probably because memory ran out,"),
    ],
)
def test_signal_is_named_with_its_likely_cause(status: int, text: str) -> None:
    assert how_it_ended(status) == text
