"""Compiled kernels: a folder made when they are first needed, one a version, few in all."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

from stages.raster.kernels import cache

ROOT = Path(__file__).resolve().parents[3]
SHOW = "import os; print(os.environ['NUMBA_CACHE_DIR'])"


def python(code: str, home: Path, **more: str) -> str:
    """What a fresh process prints that has `home` as its home folder."""
    env = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    env |= {"HOME": str(home), "XDG_CACHE_HOME": str(home / "cache"), **more}
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_nothing_is_made_before_kernels_are_needed(tmp_path: Path) -> None:
    shown = python("import os, stages, stages.run.pipeline; print('NUMBA_CACHE_DIR' in os.environ)",
                  tmp_path)  # fmt: skip
    assert shown == "False"
    assert not list(tmp_path.iterdir())


def test_numba_keeps_kernels_in_the_folder_that_was_made_for_them(tmp_path: Path) -> None:
    code = f"import stages.raster.kernels.simd, numba; {SHOW}; print(numba.config.CACHE_DIR)"
    shown = python(code, tmp_path)
    made, used = shown.splitlines()
    assert made == used
    assert Path(made).parent == tmp_path / "cache" / "splat"
    assert Path(made).is_dir()


def test_folder_that_the_user_named_is_used_and_no_other_made(tmp_path: Path) -> None:
    mine = str(tmp_path / "mine")
    assert python(f"import stages.raster.kernels; {SHOW}", tmp_path, NUMBA_CACHE_DIR=mine) == mine
    assert not (tmp_path / "cache").exists()


def test_another_processor_has_another_folder(tmp_path: Path) -> None:
    """Two machines that share a home must not run each other's kernels."""
    code = (
        "import llvmlite.binding as llvm, sys\n"
        "llvm.get_host_cpu_name = lambda: sys.argv[0] and 'other'\n"
        f"import stages.raster.kernels; {SHOW}"
    )
    here = python(f"import stages.raster.kernels; {SHOW}", tmp_path)
    assert python(f"import stages.raster.kernels; {SHOW}", tmp_path) == here
    assert python(code, tmp_path) != here


def test_home_that_cannot_be_written_gives_way_to_the_temporary_folder(tmp_path: Path) -> None:
    blocked = tmp_path / "cache"
    blocked.write_text("a file where a folder should be")
    shown = python(f"import stages.raster.kernels; {SHOW}", tmp_path, TMPDIR=str(tmp_path))
    assert Path(shown).is_dir()
    assert tmp_path in Path(shown).parents


def test_old_folders_go_less_the_newest_few_and_those_used_within_a_day(tmp_path: Path) -> None:
    root, day = tmp_path / "cache" / "splat", 24 * 3600
    hours = {"now": 0.5, "today": 20, "yesterday": 25, "last-week": 7 * 24, "last-year": 365 * 24}
    for name, ago in hours.items():
        folder = root / f"kernels-{name}"
        folder.mkdir(parents=True)
        (folder / "x.nbi").write_text("kernel")
        os.utime(folder, (time.time() - 3600 * ago,) * 2)
    own = python(f"import stages.raster.kernels; {SHOW}", tmp_path)
    kept = {"kernels-now", "kernels-today", Path(own).name}
    assert {path.name for path in root.glob("kernels-*")} == kept
    assert len(kept) == cache.KEPT
    for name in ("now", "today"):
        os.utime(root / f"kernels-{name}", (time.time() - 2 * day,) * 2)
    (root / "kernels-newer").mkdir()
    (root / "kernels-newest").mkdir()
    python("import stages.raster.kernels", tmp_path)
    kept = {"kernels-newer", "kernels-newest", Path(own).name}
    assert {path.name for path in root.glob("kernels-*")} == kept


def test_many_folders_used_within_a_day_stay(tmp_path: Path) -> None:
    root = tmp_path / "cache" / "splat"
    for number in range(6):
        (root / f"kernels-{number}").mkdir(parents=True)
    python("import stages.raster.kernels", tmp_path)
    assert len(list(root.glob("kernels-*"))) == 7


def test_kernels_of_a_folder_that_is_removed_are_compiled_again(tmp_path: Path) -> None:
    code = (
        "import shutil; from stages.raster.kernels import cache\n"
        "shutil.rmtree(cache.folder())\n"
        "from stages.mesh.fuse_kernels import _clip\n"
        "print(_clip(0.0, 1.0, 0.5, 0.0), cache.are_compiled('_clip'))"
    )
    assert python(code, tmp_path) == "(0.0, 1.0) True"


def test_only_this_package_imports_numba() -> None:
    """So that it never loads before its folder is set."""
    pattern = re.compile(r"^\s*(?:import|from) (?:numba|llvmlite)", re.M)
    packages = {
        path.parent.name
        for path in (ROOT / "stages").rglob("*.py")
        if pattern.search(path.read_text("utf-8"))
    }
    assert packages == {"kernels"}


def test_a_change_in_any_package_with_kernels_makes_another_folder() -> None:
    stages = ROOT / "stages"
    with_kernels = {
        path.relative_to(stages).parts[0]
        for path in stages.rglob("*.py")
        if "@kernel" in path.read_text("utf-8")
    }
    assert with_kernels == set(cache.PACKAGES)


def test_what_is_compiled_is_known_kernel_by_kernel(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(cache, "folder", lambda: tmp_path)
    assert not cache.are_compiled()
    (tmp_path / "cpu_1").mkdir()
    (tmp_path / "cpu_1" / "contributions.gather-165.py311.nbi").touch()
    assert cache.are_compiled()
    assert cache.are_compiled("gather")
    assert not cache.are_compiled("gather_contributions")
