"""What `--help` prints."""

from __future__ import annotations

from typer.testing import CliRunner

from splatcli.app import app


def help_of(*words: str) -> str:
    return CliRunner(env={"COLUMNS": "200", "TERM": "dumb"}).invoke(app, [*words, "--help"]).output
