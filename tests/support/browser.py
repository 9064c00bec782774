"""A browser for tests: Debian's Chromium without a screen, driven over its DevTools protocol."""

import base64
import io
import json
import shutil
import subprocess
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from matplotlib.image import imread
from websockets.sync.client import connect

from support.waiting import eventually

CHROMIUM = shutil.which("chromium")
GRAPHICS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
"""WebGL in software: what the rerun viewer needs where there is no GPU."""


class Browser:
    """One page; a context manager that leaves no process behind."""

    _session: str

    def __init__(self, profile: Path, *, graphics: bool = False) -> None:
        assert CHROMIUM is not None
        self._profile = profile
        command = [CHROMIUM, "--headless", "--no-sandbox", "--hide-scrollbars", "--disable-background-networking"]
        command += ["--disable-component-update", "--no-first-run", "--remote-debugging-port=0"]
        self._command = [*command, *(GRAPHICS if graphics else ["--disable-gpu"]), f"--user-data-dir={profile}"]
        self._closing = ExitStack()
        self._number = 0
        self._requests: dict[str, str] = {}
        self.errors: list[str] = []
        """What the page complained about."""

    def __enter__(self) -> Self:
        self._process = subprocess.Popen(
            [*self._command, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            # The browser writes there which port it took.
            told = self._profile / "DevToolsActivePort"
            eventually(lambda: told.exists() and len(told.read_text().splitlines()) == 2)
            port, path = told.read_text().splitlines()
            self._socket = self._closing.enter_context(
                connect(f"ws://127.0.0.1:{port}{path}", max_size=None, proxy=None)
            )
            (page,) = [target for target in self._ask("Target.getTargets")["targetInfos"] if target["type"] == "page"]
            self._session = self._ask("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Network", "Log"):
                self._ask(f"{domain}.enable")
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.close()
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        question = {"id": self._number, "method": method, "params": parameters}
        if hasattr(self, "_session"):
            question["sessionId"] = self._session
        self._socket.send(json.dumps(question))
        while True:
            said = json.loads(self._socket.recv(timeout=60))
            if said.get("id") == self._number:
                assert "error" not in said, said
                return dict(said["result"])
            self._note(said)

    def _note(self, said: dict[str, Any]) -> None:
        about = said.get("params", {})
        match said.get("method"):
            case "Network.requestWillBeSent":
                self._requests[about["requestId"]] = about["request"]["url"]
            case "Network.loadingFailed" if about.get("blockedReason") == "csp":
                self._requests.pop(about["requestId"], None)
            case "Runtime.exceptionThrown":
                self.errors.append(str(about["exceptionDetails"]))
            case "Log.entryAdded" if about["entry"]["level"] == "error":
                self.errors.append(about["entry"]["text"])

    def open(self, address: str, *, width: int = 1200, height: int = 900) -> None:
        """Open an address in a window of some size, and wait until it is loaded."""
        self._requests.clear()
        self.errors.clear()
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._ask("Emulation.setDeviceMetricsOverride", **metrics)
        self._ask("Page.navigate", url=address)
        eventually(lambda: self.run("document.readyState") == "complete")

    @property
    def requests(self) -> list[str]:
        """Addresses that the page asked for, without those that its policy kept it from."""
        return list(self._requests.values())

    def run(self, script: str) -> Any:
        """Value of a JavaScript expression in the page."""
        answer = self._ask("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def picture(self, save: Path | None = None) -> np.ndarray:
        """What the window shows, shape (height, width, 3), 0 to 1."""
        data = base64.b64decode(self._ask("Page.captureScreenshot", format="png")["data"])
        if save is not None:
            save.write_bytes(data)
        return np.asarray(imread(io.BytesIO(data))[..., :3])

    def until(self, condition: Callable[[np.ndarray], bool], *, timeout_s: float = 90.0) -> np.ndarray:
        """Wait until the window shows what `condition` asks for; gives that picture."""
        seen: list[np.ndarray] = []

        def shown() -> bool:
            seen[:] = [self.picture()]
            return condition(seen[0])

        eventually(shown, timeout_s=timeout_s, every_s=0.5)
        return seen[0]


def share_of(
    picture: np.ndarray, red: tuple[float, float], green: tuple[float, float], blue: tuple[float, float]
) -> float:
    """Share of pixels whose channels, 0 to 1, lie in the ranges."""
    inside = np.ones(picture.shape[:2], dtype=bool)
    for channel, (low, high) in enumerate((red, green, blue)):
        inside &= (picture[..., channel] >= low) & (picture[..., channel] <= high)
    return float(inside.mean())
