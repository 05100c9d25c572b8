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
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.packages import UnavailableError, installed, node

_PACKAGE = Path(__file__).parent / "chromium"
NAMES = ("chromium", "chromium-browser", "google-chrome-stable", "google-chrome", "chrome")
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


@functools.cache
def chromium() -> str:
    """The program that SPLAT_CHROMIUM names, or the first that the path has, or one from npm.

    Raises UnavailableError. From npm it is a download of 70 MB, once.
    """
    named = os.environ.get("SPLAT_CHROMIUM")
    found = named or next((path for name in NAMES if (path := shutil.which(name))), None)
    return found or _unpacked()


def _unpacked() -> str:
    """@sparticuz/chromium: a Chromium for Linux on x86-64 with SwiftShader, made for machines
    without a desktop's libraries."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise UnavailableError("no Chromium on the path, and SPLAT_CHROMIUM names none")
    packages = installed(_PACKAGE)
    home = packages.parent / "unpacked"
    if not home.is_dir():
        with tempfile.TemporaryDirectory(dir=packages.parent) as temporary:
            content = Path(temporary) / "content"
            content.mkdir()
            node().run(_PACKAGE / "unpack.mjs", packages, content)
            try:
                content.rename(home)
            except OSError:  # another run was faster
                assert home.is_dir()
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
        # The protocol is spoken on descriptors 3 and 4.
        command = f'exec "$0" "$@" 3<&{their_in} 4>&{their_out}'
        self._process = subprocess.Popen(
            ["bash", "-c", command, program, *_OPTIONS, f"--user-data-dir={profile}"],
            pass_fds=(their_in, their_out),
            env=_environment(program),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(their_in)
        os.close(their_out)
        self._session: str | None = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
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
        os.write(self._to, json.dumps(message).encode() + b"\0")
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
            assert block, f"no answer to {method}; the page said {self.said}"
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

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(timeout=20)
        os.close(self._to)
        os.close(self._from)


def _environment(program: str) -> dict[str, str]:
    """With the libraries and fonts that lie beside an unpacked browser; a bare machine has none."""
    home = Path(program).parent
    if not (home / "al2023").is_dir():
        return dict(os.environ)
    found = {
        "LD_LIBRARY_PATH": str(home / "al2023" / "lib"),
        "FONTCONFIG_PATH": str(home / "fonts"),
    }
    return {**os.environ, **found}
