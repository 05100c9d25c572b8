"""Fixtures of the command line's tests, for runs on a cluster and at URLs."""

from tests.cli.conftest import *  # noqa: F403
