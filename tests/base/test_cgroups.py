"""Free memory and processors under the limits of control groups."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from stages.base import cgroups, threads
from stages.base.memory import MIB, available_mib

V2 = "memory.max", "memory.current", "inactive_file"
V1 = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"


def make_group(
    group: Path, names: tuple[str, str, str], limit: str, used: int, cached: int
) -> None:
    group.mkdir(parents=True, exist_ok=True)
    (group / names[0]).write_text(f"{limit}\n")
    (group / names[1]).write_text(f"{used}\n")
    (group / "memory.stat").write_text(f"anon 5\n{names[2]} {cached}\n")


def process_in(folder: Path, groups: str) -> tuple[Path, Path]:
    """Arguments of the functions for a process in these groups."""
    (folder / "self").mkdir()
    (folder / "self/cgroup").write_text(groups)
    return folder / "self", folder / "mounts"


def free_of(folder: Path, groups: str) -> float:
    return cgroups.free_bytes(*process_in(folder, groups))


def test_free_memory_is_what_the_limit_leaves_and_cached_files_are_free(tmp_path: Path) -> None:
    make_group(tmp_path / "mounts", V2, "1000", 700, 200)
    assert free_of(tmp_path, "0::/\n") == 500


def test_the_tightest_limit_of_the_groups_above_holds(tmp_path: Path) -> None:
    make_group(tmp_path / "mounts/a", V2, "600", 500, 0)
    make_group(tmp_path / "mounts/a/b", V2, "max", 90, 0)
    make_group(tmp_path / "mounts/a/b/c", V2, "900", 80, 0)
    assert free_of(tmp_path, "0::/a/b/c\n") == 100


@pytest.mark.parametrize("path", ["/job", "/docker/0123"])
def test_limits_of_the_first_version_hold_where_the_host_names_the_path(
    tmp_path: Path, path: str
) -> None:
    folder = tmp_path / "mounts/memory" / ("job" if path == "/job" else "")
    make_group(folder, V1, "800", 300, 100)
    assert free_of(tmp_path, f"7:cpu,cpuacct:/x\n4:memory:{path}\n0::/\n") == 600


def test_a_group_that_uses_more_than_its_limit_has_none_free(tmp_path: Path) -> None:
    make_group(tmp_path / "mounts", V2, "100", 700, 0)
    assert free_of(tmp_path, "0::/\n") == 0


@pytest.mark.parametrize("groups", ["", "0::/\n", "3:cpuset:/x\n"])
def test_without_limits_memory_is_not_bounded(tmp_path: Path, groups: str) -> None:
    make_group(tmp_path / "mounts", V2, "max", 700, 0)
    assert free_of(tmp_path, groups) == math.inf


def test_available_memory_is_within_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cgroups, "free_bytes", lambda: 3.0 * MIB)
    assert available_mib() == 3.0


@pytest.mark.parametrize(
    ("limit", "processors"), [("250000 100000", 2.5), ("max 100000", math.inf)]
)
def test_processors_are_the_quota_by_the_period(
    tmp_path: Path, limit: str, processors: float
) -> None:
    (tmp_path / "mounts").mkdir()
    (tmp_path / "mounts/cpu.max").write_text(f"{limit}\n")
    assert cgroups.processors(*process_in(tmp_path, "0::/\n")) == processors


@pytest.mark.parametrize(("quota", "processors"), [("150000", 1.5), ("-1", math.inf)])
def test_processors_by_the_files_of_the_first_version(
    tmp_path: Path, quota: str, processors: float
) -> None:
    group = tmp_path / "mounts/cpu,cpuacct/job"
    group.mkdir(parents=True)
    (group / "cpu.cfs_quota_us").write_text(quota)
    (group / "cpu.cfs_period_us").write_text("100000")
    assert cgroups.processors(*process_in(tmp_path, "2:cpu,cpuacct:/job\n")) == processors


@pytest.mark.parametrize(("limit", "count"), [(2.5, 3), (0.2, 1), (64.0, 8), (math.inf, 8)])
def test_threads_are_no_more_than_the_processors_that_a_container_may_use(
    monkeypatch: pytest.MonkeyPatch, limit: float, count: int
) -> None:
    monkeypatch.delenv("SPLAT_THREADS", raising=False)
    monkeypatch.setattr("os.sched_getaffinity", lambda process: set(range(8)), raising=False)
    monkeypatch.setattr(cgroups, "processors", lambda: limit)
    assert threads.count() == count
