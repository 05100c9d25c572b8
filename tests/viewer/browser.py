"""A headless Chromium, spoken to over a pair of pipes: no driver to install beside it."""

from __future__ import annotations

import base64
import functools
import io
import itertools
import json
import os
import platform
import select
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from PIL import Image

from tests.packages import UnavailableError, installed, node

_PACKAGE = Path(__file__).parent / "chromium"
_LAST_WORDS = 20  # lines of what a browser says about itself
_OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--remote-debugging-pipe",
)
# The protocol is spoken on descriptors 3 and 4, which may be ours under other numbers.
_LAUNCH = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(number), fcntl.F_DUPFD, 10) for number in sys.argv[1:3]]
for end, place in zip(ends, (3, 4)):
    os.dup2(end, place)
    os.close(end)
os.execv(sys.argv[3], sys.argv[3:])
"""


@functools.cache
def chromium() -> str:
    """The program that SPLAT_CHROMIUM names, or the one that npm brings: never one that happens to
    be installed, which would hide what is missing elsewhere.

    Raises UnavailableError. From npm it is a download of 70 MB, once.
    """
    return os.environ.get("SPLAT_CHROMIUM") or _unpacked()


def _unpacked() -> str:
    """@sparticuz/chromium: a Chromium for Linux on x86-64 with SwiftShader, made for machines
    without a desktop's libraries."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise UnavailableError("npm brings a browser for Linux only, and SPLAT_CHROMIUM names none")
    packages = installed(_PACKAGE)
    home = packages.parent / "unpacked"
    with FileLock(home.with_suffix(".lock")):
        if not home.is_dir():
            with tempfile.TemporaryDirectory(dir=packages.parent) as temporary:
                content = Path(temporary) / "content"
                content.mkdir()
                node().run(_PACKAGE / "unpack.mjs", packages, content)
                content.rename(home)
    return str(home / "chromium")


class Browser:
    """One page of `size` (width, height) pixels, and the addresses that it asked for."""

    def __init__(self, program: str, profile: Path, size: tuple[int, int]) -> None:
        self.requests: list[str] = []
        self.said: list[str] = []
        self._numbers = itertools.count(1)
        self._buffer = b""
        their_in, self._to = os.pipe()
        self._from, their_out = os.pipe()
        self._errors = profile / "stderr.txt"
        descriptors = (str(their_in), str(their_out))
        options = (*_OPTIONS, f"--user-data-dir={profile}")
        with self._errors.open("ab") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _LAUNCH, *descriptors, program, *options],
                pass_fds=(their_in, their_out),
                env=_environment(program, profile),
                stdout=subprocess.DEVNULL,
                stderr=errors,
            )
        os.close(their_in)
        os.close(their_out)
        self._session: str | None = None
        try:
            self._attach()
            self.resize(size)
        except BaseException:
            self.close()
            raise

    def _attach(self) -> None:
        """To a page of its own, whose events are told."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def resize(self, size: tuple[int, int]) -> None:
        """(width, height) of the page, in pixels."""
        width, height = size
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)
        self.run(
            "new Promise(done => document.readyState === 'complete' ? done()"
            " : addEventListener('load', done))"
        )

    def run(self, script: str) -> Any:
        """The value of a script, waited for if it is a promise."""
        answer = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, (answer["exceptionDetails"], self.said)
        return answer["result"].get("value")

    def picture(self) -> np.ndarray:
        """[H, W, 3] float32 in [0, 1]."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        image = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")
        return np.asarray(image, np.float32) / 255

    def call(self, method: str, timeout_s: float = 60, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        try:
            os.write(self._to, json.dumps(message).encode() + b"\0")
        except BrokenPipeError:
            raise AssertionError(f"{method} reached nobody; {self._state()}") from None
        deadline = time.monotonic() + timeout_s
        while True:
            answer = self._receive(deadline, method)
            if answer.get("id") == number:
                assert "error" not in answer, answer["error"]
                return dict(answer["result"])
            self._note(answer)

    def _receive(self, deadline: float, method: str) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            left = max(0.0, deadline - time.monotonic())
            ready, _, _ = select.select([self._from], [], [], left)
            block = os.read(self._from, 1 << 20) if ready else b""
            assert block, f"no answer to {method}; {self._state()}"
            self._buffer += block
        first, _, self._buffer = self._buffer.partition(b"\0")
        return dict(json.loads(first))

    def _note(self, event: dict[str, Any]) -> None:
        parameters = event.get("params", {})
        if event.get("method") == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif event.get("method") == "Runtime.consoleAPICalled":
            self.said.append(" ".join(str(a.get("value")) for a in parameters["args"]))
        elif event.get("method") in ("Log.entryAdded", "Runtime.exceptionThrown"):
            self.said.append(json.dumps(parameters)[:500])

    def _state(self) -> str:
        """What the page said; if the browser is dead, also how it ended and its last words."""
        page = f"the page said {self.said}"
        try:
            status = self._process.wait(timeout=2)  # its pipe closes a little before its end
        except subprocess.TimeoutExpired:
            return page
        words = self._errors.read_text(errors="replace").splitlines()[-_LAST_WORDS:]
        return "\n".join([f"{page}; the browser ended with status {status}:", *words])

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._to)
        os.close(self._from)


_FONTS = """<?xml version="1.0"?>
<!DOCTYPE fontconfig SYSTEM "urn:fontconfig:fonts.dtd">
<fontconfig><dir>{fonts}</dir><cachedir>{cache}</cachedir></fontconfig>
"""


def _environment(program: str, profile: Path) -> dict[str, str]:
    """For the browser from npm all that it needs lies beside it, and nothing else is let in: the
    font configuration that it brings names folders of another system, and without any font a
    Chromium ends as soon as a page asks for a second one."""
    home = Path(program).parent
    if not (home / "al2023").is_dir():
        return dict(os.environ)
    configuration = profile / "fonts.conf"
    configuration.write_text(_FONTS.format(fonts=home / "fonts", cache=profile / "font-cache"))
    return {
        "HOME": str(profile),
        "LANG": "C.UTF-8",
        "LD_LIBRARY_PATH": str(home / "al2023" / "lib"),
        "FONTCONFIG_FILE": str(configuration),
    }
