"""What this machine has, and what is missing."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from splatcli.app import app
from splatcli.commands import doctor
from stages.base import libraries, threads
from stages.raster.kernels import cache


def checks() -> dict[str, dict]:
    result = CliRunner().invoke(app, ["doctor", "--json"])
    return {check["name"]: check for check in json.loads(result.stdout)["checks"]}


def test_every_dependency_and_the_kernel_cache_are_checked() -> None:
    found = checks()
    assert set(libraries.needed()) <= set(found)
    assert all(found[name]["ok"] for name in libraries.needed())
    assert found["kernel cache"]["value"].startswith(f"{cache.folder()}, ")


def test_readable_formats_are_listed() -> None:
    found = checks()
    assert {"JPEG", "PNG", "HEIF"} <= set(found["photographs read"]["value"].split(", "))
    assert {"h264", "hevc"} <= set(found["videos read"]["value"].split(", "))


def test_a_library_that_is_missing_or_broken_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "needed", lambda: ("no-such-distribution", "plyfile"))
    monkeypatch.setattr(doctor, "modules_of", lambda n: ("wave_of_none",) if n == "plyfile" else ())
    found = checks()
    assert not found["no-such-distribution"]["ok"]
    assert "wave_of_none" in found["plyfile"]["value"]
    assert CliRunner().invoke(app, ["doctor"]).exit_code == 6


@pytest.mark.parametrize(("avx512", "minutes"), [(True, (2, 3)), (False, (3, 5))])
def test_it_ends_with_what_it_means_for_a_run(
    avx512: bool, minutes: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "backend_of", lambda name: SimpleNamespace(name="cpu"))
    monkeypatch.setattr(doctor, "_has_avx512", lambda: avx512)
    monkeypatch.setattr(threads, "count", lambda: 2)
    *_, (name, check) = checks().items()
    assert name == "so training"
    assert check["value"] == (
        "uses the CPU, no GPU: 24 photographs of 640 px take about "
        f"{minutes[0]} min at `preview`, about {minutes[1]} min at `standard`, a whole run"
    )


def test_kernels_of_other_versions_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, size in (("kernels-own", 2000), ("kernels-old", 3000)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x.nbi").write_bytes(bytes(size))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels-own"))
    value = doctor._kernel_cache()
    assert value == f"{tmp_path / 'kernels-own'}, 2.0 kB; 1 other version beside it, 3.0 kB"
