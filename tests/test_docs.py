"""The documentation is true: tables, codes, paths and links, and every command in it exists."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path
from typing import Any

import pytest

from splatcli.app import ENTRIES, loaded
from stages.base.distribution import VERSION
from stages.formats.format_table import TABLE
from stages.run.stages import STAGE_NAMES
from stages.train.settings import PRESETS, STEPS_PER_VIEW, STEPS_PER_VIEW_SQUARED
from tests.docs_commands import bash_lines, inline_commands, splat_commands
from tests.docs_picture import EVERYWHERE, PICTURE, Drawing, imports, reached_from
from tests.docs_tables import PAGES, ROOT, renewed

COMMANDS = {name: loaded(name) for name in ENTRIES}
GUIDE = (ROOT / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md")))
EXPERIMENTS = sorted(
    page for page in (ROOT / "docs" / "experiments").glob("*.md") if page.stem != "index"
)
README_LINES = 200
SUMMARY_WORDS = 450  # of a page of experiments
_CODE = re.compile(r"[a-z0-9]+(?:-[a-z0-9]+)+$")
# Strings of the source that look like codes and are something else.
_NO_CODES = {
    "no-referrer",
    *("drop-floaters", "max-mb"),  # operations of `splat edit`
    *("utf-8", "utf-8-sig", "no-store", "same-origin"),  # encodings, headers
    "2-sfm",  # a folder
    "allow-nonfinite",  # an argument of the USD reader's process
    *("in-use", "peak-memory"),  # parts of file names
    *("no-rotation", "too-large", "vertical-axis"),  # flags of `splat info`
}


def page_id(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("words", splat_commands(), ids=" ".join)
def test_command_of_the_documentation_parses(words: list[str]) -> None:
    """By the real command line with all its options; nothing is run."""
    command: Any = COMMANDS[words[1]]
    command.make_context(words[1], list(words[2:]))


@pytest.mark.parametrize("words", inline_commands(), ids=" ".join)
def test_command_in_the_text_has_its_options(words: list[str]) -> None:
    if words[1].startswith("-"):
        assert words[1:] in (["--help"], ["--version"], ["--show-completion"])
        return
    if words[1].isupper():  # a placeholder
        return
    known = {option for found in COMMANDS[words[1]].params for option in found.opts}
    known |= {option for found in COMMANDS[words[1]].params for option in found.secondary_opts}
    options = {word.split("=")[0] for word in words[2:] if word.startswith("--")}
    assert options <= known | {"--help"}


def test_other_commands_of_the_documentation_are_known() -> None:
    """Blocks hold splat, pip, pytest and the tools of this repository, and nothing else."""
    tools = ("pytest", "python", "ruff", "mypy", "pre-commit", "mkdocs", ".")
    known = ("splat", "pip", "uv", "pipx", *tools)
    for page in (*GUIDE, ROOT / "CONTRIBUTING.md"):
        for line in bash_lines(page):
            assert line.split()[0] in known, f"{page_id(page)}: {line}"


def test_guide_names_every_command() -> None:
    assert {words[1] for words in splat_commands()} >= COMMANDS.keys()


def test_readme_is_short_and_has_both_commands() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= README_LINES
    run = "splat process sample_captures/still_life/images --preset preview --out run"
    assert f"pip install . && {run}" in text
    assert 'pip install ".[test]" && pytest' in text


@pytest.mark.parametrize("page", ["README.md", "docs/guide/presets.md"])
def test_presets_are_those_of_the_code(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8").replace(",", "")
    for name, preset in PRESETS.items():
        (row,) = [line for line in text.splitlines() if re.match(rf"\| `{name}`.*steps.* at", line)]
        steps = f"{preset.steps} steps"
        if not preset.steps:
            steps = f"{preset.steps_per_view or STEPS_PER_VIEW} steps a training view"
        if not preset.steps and not preset.steps_per_view:
            steps += f" ({STEPS_PER_VIEW_SQUARED} times their number if more)"
        assert f"{steps} at {preset.train_side} px" in row


def test_readme_names_every_format() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8").split("## Formats")[1]
    assert {"mesh", *(row.ending for row in TABLE)} <= set(re.findall(r"`([\w.-]+)`", text))


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_generated_tables_are_those_of_the_code(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert renewed(text) == text, "stale: run python -m tests.docs_tables"


def test_picture_of_the_packages_is_that_of_the_imports() -> None:
    drawing = Drawing()
    assert PICTURE.read_text("utf-8") == drawing.svg(), "stale: run python -m tests.docs_picture"
    upward = [(a, b) for a, b in drawing.arrows if drawing.rows[a] >= drawing.rows[b]]
    assert not upward


def test_arrows_of_the_picture_lead_to_every_import() -> None:
    """What is left out follows from what is drawn."""
    drawn: dict[str, set[str]] = {package: set() for package in imports()}
    for source, target in Drawing().arrows:
        drawn[target].add(source)
    for package, others in imports().items():
        assert others - {*EVERYWHERE} == reached_from(drawn, package) & others


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=page_id)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http://", "https://")):
            assert (page.parent / target).exists(), target


def _anchor(heading: str) -> str:
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading.strip().lower())
    return re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", text))


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_lead_to_headings(page: Path) -> None:
    for target, anchor in re.findall(r"\]\(([^)#\s]*)#([^)]+)\)", page.read_text("utf-8")):
        if target.startswith(("http://", "https://")):
            continue
        text = (page.parent / target if target else page).read_text(encoding="utf-8")
        headings = {_anchor(heading) for heading in re.findall(r"^#+ (.*)$", text, re.M)}
        assert anchor in headings, f"{target}#{anchor}"


@pytest.mark.parametrize("page", EXPERIMENTS, ids=page_id)
def test_experiments_begin_with_a_page_of_what_was_decided(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    summary, details = text.split("\n## Details\n")
    assert "**Summary.**" in summary
    assert "\n|--" in summary.replace(" ", ""), "a table of decisions"
    assert len(summary.split()) <= SUMMARY_WORDS
    assert details.strip()


def test_map_names_every_module() -> None:
    """In a table of its package, once, with something to say."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for top in ("stages", "splatcli"):
        for path in (ROOT / top).rglob("*.py"):
            if path.name == "__init__.py":
                continue
            name, folder = path.name, path.parent.relative_to(ROOT).as_posix()
            head = f"| module of `{folder}/` | contents |"
            assert text.count(head) == 1, folder
            table = text.split(head)[1].split("\n\n")[0].split("<!--")[0]
            assert re.search(rf"^\| `{re.escape(name)}` \| \S", table, re.M), path


def source_of(path: Path) -> str:
    """Text of a module, or of all modules of a package."""
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    return "\n".join(file.read_text(encoding="utf-8") for file in files)


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_paths_and_names_of_the_code_exist(page: Path) -> None:
    """`stages/x.py` and `stages/x.py` `Name`; experiments name modules by path only."""
    text = page.read_text(encoding="utf-8")
    for path, _, name in re.findall(r"`((?:stages|splatcli|tests)/[\w./]*)`( `(\w+)`)?", text):
        assert (ROOT / path).exists(), path
        if name:
            assert re.search(rf"\b{name}\b", source_of(ROOT / path)), f"{path} has no {name}"
    names = {
        path.name for top in ("stages", "splatcli", "tests") for path in (ROOT / top).rglob("*")
    }
    for name in re.findall(r"`([\w/]+\.(?:py|cpp))`", text):
        assert name.split("/")[-1] in names, name
        assert "/" not in name or (ROOT / name).exists(), f"{name} begins at the repository's root"
    for module in re.findall(r"python -m ((?:stages|tests)[\w.]*)", text):
        found = ROOT.joinpath(*module.split("."))
        assert found.with_suffix(".py").exists() or (found / "__main__.py").exists(), module


@pytest.mark.parametrize("page", GUIDE, ids=page_id)
def test_keys_and_metrics_that_the_guide_names_exist(page: Path) -> None:
    """`psnr_as_taken_db` and the like: words in code style with an underscore."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    code = source_of(ROOT / "stages") + source_of(ROOT / "splatcli")
    for inline in re.findall(r"`([^`]+)`", text):
        for name in re.findall(r"(?<![\w./-])[a-z]+_\w+(?!\.)\b", inline):
            known = name in ("a_mask", "poses_bounds", "transforms_train", "sample_captures")
            assert known or re.search(rf"\b{name}\b", code), name


@functools.cache
def codes_of_source() -> frozenset[str]:
    """Codes of errors and warnings: kebab-case strings, and f-strings with upper-case fields."""
    found = set()
    for top in ("stages", "splatcli"):
        for path in (ROOT / top).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                text = node.value if isinstance(node, ast.Constant) else None
                if isinstance(text, str) and _CODE.fullmatch(text):
                    found.add(text)
    return frozenset(found - _NO_CODES)


def test_troubleshooting_has_every_code_and_no_other() -> None:
    text = (ROOT / "docs" / "guide" / "troubleshooting.md").read_text(encoding="utf-8")
    codes = re.findall(r"^\| `([\w-]+)` \|", text, re.M)
    assert len(codes) == len(set(codes))
    written = {code for code in codes if code.islower()}
    assert written - codes_of_source() == set(), "documented, and not in the source"
    assert codes_of_source() - written == set(), "in the source, and not documented"


def test_architecture_names_every_stage_and_its_folder() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for number, name in enumerate(STAGE_NAMES, 1):
        assert f"`{number}-{name}`" in text


def test_glossary_is_sorted_and_has_one_sentence_a_term() -> None:
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    terms = re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", text, re.M)[2:]
    assert [term.lower() for term, _ in terms] == sorted(term.lower() for term, _ in terms)
    assert not [term for term, meaning in terms if ". " in meaning]


def test_changelog_begins_with_this_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert text.split("## ", 1)[1].startswith(VERSION)
