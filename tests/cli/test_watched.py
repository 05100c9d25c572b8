"""A command that a signal ends is reported, and signals reach the command once."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import psutil
import pytest

from tests import processes

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")

# The command: prints its process id, then does what is asked.
CODE = """
import os, signal, sys, time
from splatcli.watched import watched

def command():
    print(os.getpid(), flush=True)
    {do}

watched(command)
"""


def started(do: str, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        processes.python(CODE.format(do=do), *words),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGKILL, signal.SIGBUS])
def test_signal_that_ends_the_command_is_named_with_memory_as_its_cause(number: int) -> None:
    _, shown = (process := started(f"os.kill(os.getpid(), {int(number)})")).communicate(timeout=30)
    assert process.returncode == 6
    assert f"signal {int(number)} ({signal.Signals(number).name}), probably because memory" in shown
    assert "the same command again" in shown


def test_with_json_the_end_is_an_event() -> None:
    shown, _ = started("os.kill(os.getpid(), 9)", "--json").communicate(timeout=30)
    assert '"event": "error", "code": "command-crashed"' in shown


@pytest.mark.parametrize("status", [0, 3])
def test_exit_status_is_the_commands(status: int) -> None:
    (process := started(f"sys.exit({status})")).communicate(timeout=30)
    assert process.returncode == status


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_reaches_the_command_once(number: int) -> None:
    counting = (
        "count = []; signal.signal({0}, lambda *_: count.append(1)); print('ready', flush=True);"
        "time.sleep(1.5); sys.exit(len(count))"
    )
    process = started(counting.format(int(number)))
    assert process.stdout is not None
    process.stdout.readline()
    process.stdout.readline()
    process.send_signal(number)
    process.communicate(timeout=30)
    assert process.returncode == 1


def test_signal_that_the_command_does_not_handle_ends_both_by_it() -> None:
    process = started("time.sleep(60)")
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=30)
    assert process.returncode == -signal.SIGTERM


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="the kernel of Linux does it")
def test_command_dies_with_the_process_that_watches_it() -> None:
    process = started("time.sleep(60)")
    assert process.stdout is not None
    command = psutil.Process(int(process.stdout.readline()))
    process.kill()
    process.communicate(timeout=30)
    deadline = time.monotonic() + 10
    while command.is_running() and command.status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_ctrl_c_of_a_terminal_reaches_the_command_once() -> None:
    """Also on a terminal that stops what writes to it from the background."""
    import pty
    import termios

    # print would fail in the handler if the signal interrupts the print of "ready"
    counting = (
        "count = [];"
        "signal.signal(2, lambda *_: (count.append(1), os.write(1, b'heard')));"
        "print('ready', flush=True); time.sleep(1.5); sys.exit(len(count))"
    )
    pid, terminal = pty.fork()
    if pid == 0:
        words = processes.python(CODE.format(do=counting))
        os.execv(words[0], words)
    attributes = termios.tcgetattr(terminal)
    attributes[3] |= termios.TOSTOP
    termios.tcsetattr(terminal, termios.TCSANOW, attributes)
    shown = b""
    while b"ready" not in shown:
        shown += os.read(terminal, 4096)
    os.write(terminal, b"\x03")
    while b"heard" not in shown:
        shown += os.read(terminal, 4096)
    _, status = os.waitpid(pid, 0)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(status) == 1
