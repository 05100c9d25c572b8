"""What the tests of this folder need from elsewhere; without it they are skipped and counted."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.packages import UnavailableError, installed


@pytest.fixture(scope="session")
def packages() -> Path:
    """node_modules with the readers of package.json."""
    try:
        return installed(Path(__file__).parent)
    except UnavailableError as reason:
        pytest.skip(str(reason))
