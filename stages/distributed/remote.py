"""Captures and run folders at URLs, for workers that share no disk: fsspec knows how.

Whoever does a run fetches photographs and what there is of the run folder, works on a disk of its
own, and puts back what is finished and training's checkpoints. A manifest goes last, and is taken
away first: a stage that is half there is not there.
"""

from __future__ import annotations

import errno
import importlib
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from stages.base.atomic import make_folder
from stages.base.distribution import install_command
from stages.base.errors import Family, SplatError
from stages.base.stage import Numbers, Stage
from stages.distributed.tasks import Location, RunTask
from stages.run.failures import disk_full
from stages.run.listeners import Listeners
from stages.run.lock import locked
from stages.run.manifest import MANIFEST, Manifest
from stages.run.pipeline import Listener
from stages.run.request import REQUEST
from stages.run.runfile import RUN_FILE
from stages.training.checkpoint import FILE_NAME


def parse_location(text: str) -> Location:
    """What was typed, as a path unless it is a URL."""
    return text if "://" in text else Path(text)


def expand_locations(typed: Iterable[str]) -> list[Location]:
    """The places that were typed; a URL with * in it stands for all that it fits. Raises
    SplatError."""
    found: list[Location] = []
    for place in map(parse_location, typed):
        found += RemoteFolder.at(place).fitting() if isinstance(place, str) else [place]
    return found


def capture_name(place: Location) -> str:
    """Of a capture: its folder's, or its video's without the ending. Raises SplatError."""
    if isinstance(place, str):
        folder = RemoteFolder.at(place)
        last = PurePosixPath(folder.root)
        return last.stem if folder.is_file() else last.name
    whole = place.absolute()
    return whole.stem if whole.is_file() else whole.name


def joined(place: Location, name: str) -> Location:
    return f"{place.rstrip('/')}/{name}" if isinstance(place, str) else place / name


@contextmanager
def prepare_output(place: Location) -> Iterator[Path]:
    """The folder itself, made if it is new, and locked; of one at a URL, which nobody can lock, an
    empty one for copies. Raises SplatError."""
    if isinstance(place, str):
        with tempfile.TemporaryDirectory(prefix="splat-") as name:
            yield Path(name)
    else:
        make_folder(place)
        with locked(place):
            yield place


def fetch_manifests(place: Location, name: str, here: Path) -> None:
    """Copy the manifests of the run `name` to `here`, if it lies at a URL. Raises SplatError."""
    if isinstance(place, str):
        run = RemoteFolder.at(place) / name
        run.fetch([file for file in run.names() if file.endswith(f"/{MANIFEST}")], here / name)


@dataclass(frozen=True)
class RemoteFolder:
    """A folder at a URL. system: fsspec's. root: its path there."""

    url: str
    system: Any
    root: str

    @classmethod
    def at(cls, url: str) -> RemoteFolder:
        """Raises SplatError: url-unknown, url-not-installed."""
        try:
            system, root = importlib.import_module("fsspec").core.url_to_fs(url)
        except ImportError as error:
            ours = error.name == "fsspec"
            said = "fsspec is missing, which reads it" if ours else str(error)
            hint = install_command("cluster") if ours else "Install it wherever runs are done."
            raise _error("url-not-installed", url, said, hint) from error
        except ValueError as error:
            hint = "Name a protocol that fsspec knows, such as s3://, gs:// or sftp://."
            raise _error("url-unknown", url, str(error), hint) from error
        return cls(url.rstrip("/"), system, root.rstrip("/"))

    def __truediv__(self, name: str) -> RemoteFolder:
        return replace(self, url=f"{self.url}/{name}", root=f"{self.root}/{name}")

    def is_file(self) -> bool:
        with self._told():
            return bool(self.system.isfile(self.root))

    def fitting(self) -> list[Location]:
        """URLs of what the pattern fits, in order. Raises SplatError."""
        if "*" not in self.root:
            return [self.url]
        with self._told():
            found = sorted(self.system.glob(self.root))
        if not found:
            raise _missing(self.url)
        return [self.system.unstrip_protocol(path) for path in found]

    def names(self) -> list[str]:
        """Of all files in it, relative and posix; "" of a file itself; [] if it is not there.
        Raises SplatError."""
        with self._told():
            self.system.invalidate_cache()
            if not self.system.exists(self.root):
                return []
            found = [str(path) for path in self.system.find(self.root)]
        names = sorted(path[len(self.root) :].lstrip("/") for path in found)
        return [name for name in names if ".." not in PurePosixPath(name).parts]

    def fetch(self, names: Iterable[str], target: Path) -> None:
        """Copy these of its files into `target`. Raises SplatError, OSError."""
        for name in names:
            file = target / name
            file.parent.mkdir(parents=True, exist_ok=True)
            with self._told():
                self.system.get_file(f"{self.root}/{name}" if name else self.root, str(file))

    def put(self, source: Path, names: Iterable[str]) -> None:
        """Copy these files of `source` into it, in this order. Raises SplatError."""
        for name in names:
            target = f"{self.root}/{name}"
            with self._told():
                self.system.makedirs(target.rpartition("/")[0], exist_ok=True)
                self.system.put_file(str(source / name), target)

    def remove(self) -> None:
        """With all that is in it, if it is there: a manifest first. Raises SplatError."""
        names = self.names()
        with self._told():
            if MANIFEST in names:
                self.system.rm_file(f"{self.root}/{MANIFEST}")
            if names:
                self.system.rm(self.root, recursive=True)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Whatever a file system raises, as a SplatError."""
        try:
            yield
        except FileNotFoundError as error:
            raise _missing(self.url) from error
        except PermissionError as error:
            hint = "Check your rights there, and that credentials are set where the worker runs."
            raise _error("url-not-permitted", self.url, "It may not be used", hint) from error
        except Exception as error:
            if isinstance(error, OSError) and error.errno == errno.ENOSPC:
                raise disk_full("copying", Path(tempfile.gettempdir())) from error
            said = f"{type(error).__name__}: {error}".splitlines()[0].rstrip(".")
            hint = "Give the same command again: what is finished is kept."
            raise _error("url-failed", self.url, said, hint, Family.RESOURCES) from error


def _missing(url: str) -> SplatError:
    hint = "Check the URL, and that credentials are set: some stores hide what one may not see."
    return _error("url-not-found", url, "Nothing is there", hint)


def _error(code: str, url: str, what: str, hint: str, family: Family = Family.INPUT) -> SplatError:
    wanted = "A URL that fsspec can read, and write to where runs go."
    return SplatError(code, given=f"{url}: {what}.", wanted=wanted, hint=hint, family=family)


@dataclass(frozen=True)
class RemoteRunTask:
    """`tasks.Run`, of which the photographs or the run folder are at a URL. TMPDIR says where its
    scratch folder is made."""

    run_folder: Location
    photos: Location
    settings: Mapping[str, Any]

    @property
    def folder(self) -> Path:
        far = isinstance(self.run_folder, str)
        return Path(tempfile.gettempdir()) if far else Path(self.run_folder)

    def work(self, listener: Listener | None = None) -> None:
        with tempfile.TemporaryDirectory(prefix="splat-") as name:
            photos = _fetched(self.photos, Path(name) / "photographs")
            run_folder, put_back = self.run_folder, Listener()
            if isinstance(run_folder, str):
                far, run_folder = RemoteFolder.at(run_folder), Path(name) / "run"
                far.fetch(far.names(), run_folder)
                put_back = UploadListener(run_folder, far)
            try:
                listeners = Listeners(put_back, listener or Listener())
                RunTask(run_folder, photos, self.settings).work(listeners)
            except SplatError as error:
                if error.code == "disk-full":  # the scratch folder's
                    raise
                said = error.given.replace(str(run_folder), str(self.run_folder))
                error.given = said.replace(str(photos), str(self.photos))
                raise


def task_for(
    run_folder: Location, photos: Location, settings: Mapping[str, Any]
) -> RunTask | RemoteRunTask:
    """The task, by where its folders are: paths as they are seen from anywhere."""
    if isinstance(run_folder, Path) and isinstance(photos, Path):
        return RunTask(run_folder.absolute(), photos.absolute(), settings)
    return RemoteRunTask(_anywhere(run_folder), _anywhere(photos), settings)


def _anywhere(place: Location) -> Location:
    return place.absolute() if isinstance(place, Path) else place


def _fetched(photos: Location, target: Path) -> Path:
    """Where the photographs are; those at a URL are copied into `target`, under the name that they
    have there. Raises SplatError."""
    if isinstance(photos, Path):
        return photos
    far = RemoteFolder.at(photos)
    names = far.names()
    if not names:
        raise _missing(far.url)
    place = target / PurePosixPath(far.root).name
    far.fetch(names, place)
    return place


class UploadListener(Listener):
    """Puts what a run finishes, and training's checkpoints, where its run folder really is."""

    def __init__(self, run_folder: Path, far: RemoteFolder) -> None:
        self._here, self._far = run_folder, far
        self._partial, self._saved_ns = "", 0
        self._there: dict[str, int] = {}  # when what was put there was made

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        self._far.put(self._here, [RUN_FILE])
        self._partial = f".{number}-{stage.name}.partial"
        self._there.clear()

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        folder = self._here / self._partial
        with suppress(OSError, SplatError):  # without it, more is done again
            saved_ns = (folder / FILE_NAME).stat().st_mtime_ns
            if saved_ns != self._saved_ns:
                self._saved_ns = saved_ns
                for name in (REQUEST, FILE_NAME):
                    self._put(folder, name)

    def _put(self, folder: Path, name: str) -> None:
        made_ns = (folder / name).stat().st_mtime_ns
        if self._there.get(name) != made_ns:
            (self._far / self._partial).put(folder, [name])
            self._there[name] = made_ns

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        label = f"{number}-{stage.name}"
        done = self._far / label
        done.remove()
        done.put(self._here / label, [*sorted(manifest.outputs), MANIFEST])
        (self._far / self._partial).remove()
