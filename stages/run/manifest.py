"""The manifest of a finished stage.

`manifest.json` is written last: a stage is finished if and only if it exists. It holds a digest of
its own contents, so that a manifest edited by hand is detected.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from stages.base.atomic import rename, sync_folder
from stages.base.disk import not_permitted
from stages.base.errors import RunFolderError, SplatError
from stages.run.digests import FileRecords, records_from_data

SCHEMA = 2  # of manifests and `run.json`; raised when their keys or settings are renamed
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Manifest:
    """One finished stage.

    Args:
        stage, version: the stage's name and version.
        settings: all settings, as JSON data.
        inputs: digest of each input by name.
        outputs: record of each output file by name.
        output_digest: one digest over names and contents of the outputs.
        seconds: wall-clock seconds, all attempts together.
        cpu_seconds: CPU seconds of the process and its child processes, all attempts together.
        peak_memory_mib: of the process and its children while the stage ran.
        device: hardware that it ran on.
        seed: the random seed, if the stage has one.
        input_files: for inputs that are the user's own files, the record of each file, so that
            the one that changed can be named.
        libraries: versions by distribution name.
        metrics: JSON values from the stage.
        warnings: (code, sentence) pairs.
    """

    stage: str
    version: int
    settings: dict[str, Any]
    inputs: dict[str, str]
    outputs: FileRecords
    output_digest: str
    seconds: float
    cpu_seconds: float
    peak_memory_mib: float
    device: str
    seed: int | None = None
    input_files: dict[str, FileRecords] = field(default_factory=dict)
    libraries: dict[str, str] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    warnings: list[list[str]] = field(default_factory=list)

    def write(self, folder: Path) -> None:
        """Write `manifest.json` into `folder` atomically. Raises OSError."""
        write_sealed(folder / MANIFEST, asdict(self))

    @classmethod
    def read(cls, folder: Path) -> Manifest | None:
        """The manifest in `folder`, or None if there is none.

        Raises SplatError as `read_sealed` does.
        """
        data = read_sealed(folder / MANIFEST)
        if data is None:
            return None
        try:
            data["outputs"] = records_from_data(data["outputs"])
            files = data["input_files"]
            data["input_files"] = {k: records_from_data(v) for k, v in files.items()}
            return cls(**{f.name: data[f.name] for f in fields(cls)})
        except (KeyError, TypeError, AttributeError) as error:
            raise edited(folder / MANIFEST) from error


def json_value(value: Any) -> Any:
    """`value` as JSON data: arrays and tuples as lists, numpy scalars as numbers, infinity and NaN
    as the strings "inf", "-inf" and "nan", which JSON numbers cannot express."""
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(item) for item in value]
    if hasattr(value, "tolist"):  # numpy, without importing it
        return json_value(value.tolist())
    if isinstance(value, bool) or value is None or isinstance(value, (int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return str(value)


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write JSON under a temporary name, flush it to the disk, rename it, and flush the folder.

    Raises OSError.
    """
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("w", encoding="utf-8") as file:
        json.dump(json_value(data), file, indent=1)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    rename(temporary, path)
    sync_folder(path.parent)


def write_sealed(path: Path, data: Mapping[str, Any]) -> None:
    """Write JSON with the schema version and a digest of the contents added. Raises OSError."""
    body = {"schema": SCHEMA, **json_value(data)}
    write_json(path, {**body, "digest": _seal(body)})


def read_sealed(path: Path) -> dict[str, Any] | None:
    """The data that `write_sealed` wrote, or None if there is no such file.

    Raises SplatError: run-folder-older and run-folder-newer for another schema; manifest-edited if
    it is not JSON, not of the right shape, or does not match its digest; run-folder-unreadable.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except PermissionError as error:
        raise not_permitted(path, error) from error
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:  # reported where the name is used
            raise
        raise RunFolderError(
            "run-folder-unreadable",
            given=f"{path} cannot be read: {error.strerror}.",
            wanted="A run folder that you may read.",
            hint="Check the permissions of the folder.",
        ) from error
    except (ValueError, RecursionError) as error:
        raise edited(path) from error
    if not isinstance(data, dict) or not isinstance(data.get("schema"), int):
        raise edited(path)
    if data["schema"] < SCHEMA:
        raise RunFolderError(
            "run-folder-older",
            given=f"{path} was written by an older version of splat (schema {data['schema']}).",
            wanted=f"A run folder of schema {SCHEMA}. Nothing in the folder was changed.",
            hint="Start a new run folder: splat process PHOTOS --out NEW_RUN",
        )
    if data["schema"] > SCHEMA:
        raise RunFolderError(
            "run-folder-newer",
            given=f"{path} was written by a newer version of splat (schema {data['schema']}).",
            wanted=f"A run folder of schema {SCHEMA}.",
            hint="Upgrade splat, or start a new run folder with --out.",
        )
    digest = data.pop("digest", None)
    if digest != _seal(data):
        raise edited(path)
    return data


def _seal(body: Mapping[str, Any]) -> str:
    text = json.dumps(body, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def edited(path: Path) -> SplatError:
    """The error for a file of a run folder that is not as splat wrote it."""
    what = f"the folder {path.parent}" if path.name == MANIFEST else path
    again = "its stage runs again" if path.name == MANIFEST else "give all options again"
    return RunFolderError(
        "manifest-edited",
        given=f"{path} was changed after it was written, or is damaged.",
        wanted="The file as splat wrote it: later stages depend on it.",
        hint=f"Restore the file, or delete {what}: then {again}. Nothing else is lost.",
    )
