"""What holds for every test: the installed package is tested, side by side, and nothing for ever.

Tests run on all cores, a file in one process, each process with as many threads as on a machine of
two cores.
"""

from __future__ import annotations

import filecmp
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from filelock import FileLock

if TYPE_CHECKING:
    from tests.viewer.browser import Browser

ROOT = Path(__file__).resolve().parents[1]

# The checkout comes last, for `tests` alone: what is installed is what users have. Processes that
# tests start must not take their working folder for a place to import from either.
sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != ROOT] + [str(ROOT)]
os.environ["PYTHONSAFEPATH"] = "1"
os.environ.pop("PYTHONPATH", None)
os.environ.setdefault("SPLAT_THREADS", "2")
# Where there is no GPU its kernels are interpreted.
if not any(Path(device).exists() for device in ("/dev/nvidia0", "/dev/kfd")):
    os.environ.setdefault("TRITON_INTERPRET", "1")
# A job in the background ignores Ctrl-C, and one under nohup the end of its terminal; so would all
# that it starts.
for _name, _usual in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
    if hasattr(signal, _name) and signal.getsignal(getattr(signal, _name)) is signal.SIG_IGN:
        signal.signal(getattr(signal, _name), _usual)


def pytest_configure(config: pytest.Config) -> None:
    if fault := _fault_of_installation():
        raise pytest.UsageError(f'{fault}: rm -rf build && pip install ".[test]"')


def _fault_of_installation() -> str | None:
    """Why these tests would not test this checkout as it is installed."""
    try:
        origin = json.loads(distribution("splatcli").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        return "splatcli is not installed"
    import stages

    home = Path(stages.__file__).parents[1]
    if origin.get("dir_info", {}).get("editable"):
        return None if home == ROOT else f"splatcli is installed from {home}, not from {ROOT}"
    if home == ROOT:
        return "what is installed as splatcli is not complete"
    for top in ("stages", "splatcli"):
        for path in (home / top).rglob("*.py"):
            source = ROOT / path.relative_to(home)
            if not source.is_file() or not filecmp.cmp(path, source, shallow=False):
                return f"{path} is not what {source} is"
    return None


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Compiles the kernels before tests begin side by side, each of which would compile them and
    be the slower for it. If that fails, tests will tell."""
    from tests import processes

    first = session.config.getoption("numprocesses", None) and not _is_worker(session.config)
    if first and not session.config.option.collectonly:
        subprocess.run(processes.module("tests.compile_kernels"), check=False)


def _is_worker(config: pytest.Config) -> bool:
    return hasattr(config, "workerinput")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest first: a file is one process's, and must not be left to the end."""
    for item in items:
        if "sample_run" in getattr(item, "fixturenames", ()):  # made, or waited for
            item.add_marker(pytest.mark.timeout(900))
    items.sort(key=_patience_s, reverse=True)


def _patience_s(item: pytest.Item) -> float:
    limit = item.get_closest_marker("timeout")
    if limit is not None:
        return float(limit.args[0])
    return 60.0 if item.get_closest_marker("slow") else 0.0


def shared_folder(factory: pytest.TempPathFactory) -> Path:
    """A temporary folder that all processes of this session know."""
    own = factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@pytest.fixture(scope="session")
def sample_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one run/ of the whole pipeline on the sample capture, for all who only read it;
    Who wants to change something copies it."""
    from tests import sample

    folder = shared_folder(tmp_path_factory) / "sample"
    with FileLock(folder.with_suffix(".lock")):
        if not (folder / sample.TOLD).exists():
            sample.make(folder)
    return folder


@pytest.fixture(scope="session")
def one_browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    from tests.packages import UnavailableError
    from tests.viewer.browser import Browser, chromium
    from tests.viewer.screenshots import SIZE

    try:
        program = chromium()
    except UnavailableError as reason:
        pytest.skip(str(reason))
    opened = Browser(program, tmp_path_factory.mktemp("profile"), SIZE)
    yield opened
    opened.close()


@pytest.fixture
def browser(one_browser: Browser) -> Browser:
    """A page as large as the pictures of tests/viewer/screenshots.py."""
    from tests.viewer.screenshots import SIZE

    one_browser.resize(SIZE)
    one_browser.requests.clear()
    one_browser.said.clear()
    return one_browser
