"""Help: quick, and with examples."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from splatcli.app import ENTRIES, app, loaded
from stages.base.distribution import NAME, VERSION
from stages.base.settings import PANELS
from stages.run.stages import STAGE_NAMES
from tests import processes
from tests.cli.help_text import help_of

ROOT = Path(__file__).parent.parent.parent
COMMANDS = (
    *("process", *STAGE_NAMES, "status", "render", "view", "info", "convert", "verify"),
    *("batch", "tradeoff", "compare", "edit", "cameras", "doctor"),
)
HEAVY = ("torch", "numba", "cv2", "pycolmap", "numpy", "PIL", "pxr")


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "sys.argv = ['splat', '--help']\n"
        "from splatcli.app import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        f"print([m for m in {HEAVY!r} if m in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stderr.strip() == "[]"


@pytest.mark.parametrize("words", [["--help"], ["train", "--help"], ["process", "--help"]])
def test_help_writes_nothing(words: list[str], tmp_path: Path) -> None:
    env = {n: value for n, value in os.environ.items() if n != "NUMBA_CACHE_DIR"}
    places = {name: str(tmp_path) for name in ("HOME", "XDG_CACHE_HOME", "TMPDIR", "LOCALAPPDATA")}
    done = subprocess.run(
        processes.splat(*words),
        cwd=tmp_path,
        env=env | places,
        stdout=subprocess.DEVNULL,
        timeout=60,
        check=True,
    )
    assert done.returncode == 0
    assert not list(tmp_path.iterdir())


def test_help_of_train_says_what_a_run_that_goes_on_keeps() -> None:
    text = " ".join(help_of("train").split())
    assert "as before, else standard" in text
    assert "as before, else by preset" in text
    assert "in training (pixels). [default: by preset]" in " ".join(help_of("process").split())


def _cpu_s(code: str, *arguments: str) -> float:
    """Processor time of a Python process that runs `code` (seconds)."""
    command = [sys.executable, "-c", code, *arguments]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    assert child.returncode == 0
    return usage.ru_utime + usage.ru_stime


@pytest.mark.skipif(not hasattr(os, "wait4"), reason="no account of a child's processor time")
def test_help_takes_less_than_three_times_what_importing_typer_takes() -> None:
    """The least of three each, taken in turn: processors differ, and are shared."""
    pairs = [
        (
            _cpu_s("from splatcli.app import main; main()", "--help"),
            _cpu_s("import typer, typer.rich_utils"),
        )
        for _ in range(3)
    ]
    help_s, typer_s = map(min, zip(*pairs, strict=True))
    assert help_s < 3 * typer_s, pairs


def test_help_lists_every_command_and_shows_examples() -> None:
    text = help_of()
    for command in COMMANDS:
        assert re.search(rf"\b{command}\b", text), command
    assert "splat process photos/" in text


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command: str) -> None:
    text = help_of(command)
    assert f"splat {command}" in text.split("Example:")[1]


@pytest.mark.parametrize("name", ENTRIES)
def test_the_list_of_commands_has_the_first_line_of_each_commands_help(name: str) -> None:
    first = (loaded(name).help or "").split("\n\n")[0]
    assert " ".join(first.split()) == ENTRIES[name].help


def test_process_has_the_promised_options() -> None:
    text = help_of("process")
    for flag in (
        "--out",
        "--preset",
        "--seed",
        "--backend",
        "--max-side",
        "--train-side",
        "--steps",
        "--max-splats",
        "--format",
        "--allow-partial",
        "--view",
        "--quiet",
        "--json",
    ):
        assert flag in text, flag


@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_help_of_80_columns_cuts_nothing(command: str | None) -> None:
    words = [command, "--help"] if command else ["--help"]
    text = CliRunner(env={"COLUMNS": "80", "TERM": "dumb"}).invoke(app, words).output
    assert max(map(len, text.splitlines())) <= 80
    assert not re.search("\u2026|<\\w+>|: \\(", text)
    for parameter in loaded(command).params if command else ():
        for name in (*parameter.opts, *parameter.secondary_opts):
            named = name.upper() if not name.startswith("-") else name
            assert re.search(rf"{re.escape(named)}(?![\\w-])", text), name


def test_the_list_of_commands_has_groups_and_process_a_panel_of_units() -> None:
    found = re.findall(r"─ (.+?) ─+╮", help_of())
    assert found == [
        "Options",
        "Scenes",
        "One stage of a run",
        "Files",
        "Look and measure",
        "This machine",
    ]
    text = help_of("process")
    units = text[text.index("─ Units ─") : text.index("─ Light and masks ─")]
    assert all(flag in units for flag in ("--metres", "--scale", "--marker", "--crs"))


def test_process_groups_its_options_and_lists_the_common_ones_first() -> None:
    text = help_of("process")
    found = re.findall(r"─ (.+?) ─+╮", text)
    assert found == ["Arguments", *PANELS, "Options"]
    between = text[text.index("Quality and time") : text.index("─ Size ─")]
    assert all(flag in between for flag in ("--preset", "--steps", "--train-side"))
    assert text.index("--preset") < text.index("--cameras") < text.index("--backend")


@pytest.mark.parametrize(
    ("line", "completed"),
    [("splat pro", ["process"]), ("splat process --preset s", ["standard"])],
)
def test_shell_completion_knows_commands_and_choices(
    line: str, completed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("_SPLAT_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split()) - 1))
    result = CliRunner().invoke(app, [], prog_name="splat")
    assert result.stdout.split() == completed


def test_version_is_the_distributions(splat) -> None:
    assert splat("--version").stdout.strip() == f"{NAME} {VERSION}"
