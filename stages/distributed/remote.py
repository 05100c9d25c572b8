"""Captures and run folders at URLs, through fsspec, for workers that share no disk.

A worker downloads the photographs and the run folder, works on its own disk, and uploads finished
stages and the checkpoints of training. A stage's manifest is uploaded last and removed first, so
that a partly uploaded stage does not count as finished.
"""

from __future__ import annotations

import errno
import importlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

from stages.base.atomic import make_folder
from stages.base.disk import disk_full
from stages.base.distribution import install_command
from stages.base.errors import Family, SplatError
from stages.base.stage import Numbers, Stage
from stages.run.listener import Listener
from stages.run.lock import locked
from stages.run.manifest import MANIFEST, Manifest
from stages.run.request import REQUEST
from stages.run.runfile import RUN_FILE
from stages.run.workspace import USAGE
from stages.train import cap, checkpoint

Location: TypeAlias = Path | str  # a path, or a URL
_BESIDE_CHECKPOINT = (cap.FILE_NAME, USAGE)  # what a resumed run reads besides
_FAMILIES = {
    "url-unknown": Family.USAGE,
    "url-not-installed": Family.USAGE,
    "url-not-found": Family.INPUT,
    "url-not-permitted": Family.RESOURCES,
    "url-failed": Family.RESOURCES,
}


def parse_location(text: str) -> Location:
    """A URL as it is, anything else as a path."""
    return text if "://" in text else Path(text)


def expand_locations(texts: Iterable[str]) -> list[Location]:
    """The locations; a URL with * in it is replaced by all that match it. Raises SplatError."""
    every: list[Location] = []
    for location in map(parse_location, texts):
        every += RemoteFolder.at(location).matches() if isinstance(location, str) else [location]
    return every


def capture_name(location: Location) -> str:
    """The name of the folder, or of the video without its suffix. Raises SplatError."""
    if isinstance(location, str):
        folder = RemoteFolder.at(location)
        path = PurePosixPath(folder.root)
        return path.stem if folder.is_file() else path.name
    local = location.absolute() if location.name not in ("", "..") else location.resolve()
    return local.stem if local.is_file() else local.name


def joined(location: Location, name: str) -> Location:
    """The location of `name` in a folder."""
    return f"{location.rstrip('/')}/{name}" if isinstance(location, str) else location / name


def is_seen(location: str) -> bool:
    """Whether this process sees a path, or reaches the file system of a URL."""
    if "://" not in location:
        return os.path.exists(location)
    try:
        RemoteFolder.at(location).names()
    except SplatError:
        return False
    return True


@contextmanager
def prepare_output(location: Location) -> Iterator[Path]:
    """The folder, made if it is new, and locked. For a URL, which cannot be locked, an empty
    temporary folder for copies. Raises SplatError."""
    if isinstance(location, str):
        with tempfile.TemporaryDirectory(prefix="splat-") as name:
            yield Path(name)
    else:
        make_folder(location)
        with locked(location):
            yield location


def fetch_records(location: Location, name: str, folder: Path) -> None:
    """Copy the settings and the manifests of the run `name` into `folder`, if the location is a
    URL. Raises SplatError."""
    if isinstance(location, str):
        run = RemoteFolder.at(location) / name
        wanted = [f for f in run.names() if f == RUN_FILE or f.endswith(f"/{MANIFEST}")]
        run.fetch(wanted, folder / name)


@dataclass(frozen=True)
class RemoteFolder:
    """A folder at a URL. system: fsspec's file system. root: the folder's path in it."""

    url: str
    system: Any
    root: str

    @classmethod
    def at(cls, url: str) -> RemoteFolder:
        """The folder at a URL. Raises SplatError: url-unknown, url-not-installed."""
        try:
            system, root = importlib.import_module("fsspec").core.url_to_fs(url)
        except ImportError as error:
            ours = error.name == "fsspec"
            why = "fsspec, which reads it, is not installed" if ours else str(error)
            hint = install_command("cluster") if ours else "Install it wherever runs are done."
            raise _error("url-not-installed", url, why, hint) from error
        except ValueError as error:
            hint = "Name a protocol that fsspec knows, such as s3://, gs:// or sftp://."
            raise _error("url-unknown", url, str(error), hint) from error
        return cls(url.rstrip("/"), system, root.rstrip("/"))

    def __truediv__(self, name: str) -> RemoteFolder:
        return replace(self, url=f"{self.url}/{name}", root=f"{self.root}/{name}")

    def is_file(self) -> bool:
        with self._as_splat_errors():
            return bool(self.system.isfile(self.root))

    def matches(self) -> list[Location]:
        """The sorted URLs that match the pattern. Raises SplatError."""
        if "*" not in self.root:
            return [self.url]
        with self._as_splat_errors():
            paths = sorted(self.system.glob(self.root))
        if not paths:
            raise _missing(self.url)
        return [self.system.unstrip_protocol(path) for path in paths]

    def names(self) -> list[str]:
        """The relative posix paths of all files in it; [""] for a file, [] if it does not exist.
        Raises SplatError."""
        with self._as_splat_errors():
            self.system.invalidate_cache()
            if not self.system.exists(self.root):
                return []
            paths = [str(path) for path in self.system.find(self.root)]
        names = sorted(path[len(self.root) :].lstrip("/") for path in paths)
        return [name for name in names if ".." not in PurePosixPath(name).parts]

    def fetch(self, names: Iterable[str], target: Path) -> None:
        """Copy these of its files into `target`. Raises SplatError, OSError."""
        for name in names:
            file = target / name
            file.parent.mkdir(parents=True, exist_ok=True)
            with self._as_splat_errors():
                self.system.get_file(f"{self.root}/{name}" if name else self.root, str(file))

    def put(self, source: Path, names: Iterable[str]) -> None:
        """Copy these files of `source` into it, in this order. Raises SplatError."""
        for name in names:
            target = f"{self.root}/{name}"
            with self._as_splat_errors():
                self.system.makedirs(target.rpartition("/")[0], exist_ok=True)
                self.system.put_file(str(source / name), target)

    def remove(self) -> None:
        """Remove the folder if it exists, its manifest first. Raises SplatError."""
        names = self.names()
        with self._as_splat_errors():
            if MANIFEST in names:
                self.system.rm_file(f"{self.root}/{MANIFEST}")
            if names:
                self.system.rm(self.root, recursive=True)

    @contextmanager
    def _as_splat_errors(self) -> Iterator[None]:
        """Turn every exception of the file system into a SplatError."""
        try:
            yield
        except FileNotFoundError as error:
            raise _missing(self.url) from error
        except PermissionError as error:
            raise self._not_permitted() from error
        except Exception as error:
            if "credentials" in str(error).lower():  # of the store's own library
                raise self._not_permitted() from error
            if isinstance(error, OSError) and error.errno == errno.ENOSPC:
                raise disk_full("copying", Path(tempfile.gettempdir())) from error
            what = f"{type(error).__name__}: {error}".splitlines()[0].rstrip(".")
            hint = "Give the same command again: what is finished is kept."
            raise _error("url-failed", self.url, what, hint) from error

    def _not_permitted(self) -> SplatError:
        hint = "Check your rights there, and that credentials are set where the worker runs."
        return _error("url-not-permitted", self.url, "It may not be used", hint)


def _missing(url: str) -> SplatError:
    hint = "Check the URL, and that credentials are set: some stores hide what one may not see."
    return _error("url-not-found", url, "Nothing is there", hint)


def _error(code: str, url: str, what: str, hint: str) -> SplatError:
    wanted = "A URL that fsspec can read, and write to where runs go."
    return SplatError(
        code, given=f"{url}: {what}.", wanted=wanted, hint=hint, family=_FAMILIES[code]
    )


@contextmanager
def local_copies(
    run_folder: Location, photos: Location | None
) -> Iterator[tuple[Path, Path | None, Listener]]:
    """(run folder, photographs, listener of the run). Paths stay as they are. What is at a URL is
    copied into a temporary folder in TMPDIR, and the listener uploads what the run makes; a
    SplatError in the block then names the URL. Raises SplatError."""
    if not isinstance(run_folder, str) and not isinstance(photos, str):
        yield run_folder, photos, Listener()
        return
    with tempfile.TemporaryDirectory(prefix="splat-") as name:
        local, upload = run_folder, Listener()
        local_photos = _fetched(photos, Path(name) / "photographs")
        if isinstance(local, str):
            remote, local = RemoteFolder.at(local), Path(name) / "run"
            remote.fetch(remote.names(), local)
            upload = UploadListener(local, remote)
        try:
            yield local, local_photos, upload
        except SplatError as error:
            if error.code == "disk-full":  # of the temporary folder
                raise
            given = error.given.replace(str(local), str(run_folder))
            error.given = given.replace(str(local_photos), str(photos))
            raise


def _fetched(photos: Location | None, target: Path) -> Path | None:
    """The local path of the photographs; those at a URL are copied into `target` under their own
    name. Raises SplatError."""
    if not isinstance(photos, str):
        return photos
    remote = RemoteFolder.at(photos)
    names = remote.names()
    if not names:
        raise _missing(remote.url)
    local = target / PurePosixPath(remote.root).name
    remote.fetch(names, local)
    return local


class UploadListener(Listener):
    """Uploads finished stages and the newest checkpoint of training, whose own checksum tells
    whether it arrived whole; without it, a resumed run begins training again. The cap and the
    usage are uploaded before it: a checkpoint without its cap would go on under the cap of another
    worker, and give other bytes."""

    def __init__(self, run_folder: Path, remote: RemoteFolder) -> None:
        self._local, self._remote = run_folder, remote
        self._partial, self._saved_ns = "", 0

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        self._remote.put(self._local, [RUN_FILE])
        self._partial = f".{number}-{stage.name}.partial"
        if not resumed:  # a checkpoint of another request must not lie beside this one
            (self._remote / self._partial).remove()
            self._remote.put(self._local, [f"{self._partial}/{REQUEST}"])

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        folder = self._local / self._partial
        with suppress(OSError, SplatError):  # without a checkpoint, a resumed run repeats more
            saved_ns = (folder / checkpoint.FILE_NAME).stat().st_mtime_ns
            if saved_ns != self._saved_ns:
                self._saved_ns = saved_ns
                beside = [name for name in _BESIDE_CHECKPOINT if (folder / name).exists()]
                names = [*beside, checkpoint.FILE_NAME]
                self._remote.put(self._local, [f"{self._partial}/{name}" for name in names])

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        label = f"{number}-{stage.name}"
        target = self._remote / label
        target.remove()
        target.put(self._local / label, [*sorted(manifest.outputs), MANIFEST])
        (self._remote / self._partial).remove()
