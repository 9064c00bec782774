"""A browser for tests: Debian's Chromium in headless mode, controlled over its DevTools protocol."""

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
"""Software WebGL, which the rerun viewer needs without a GPU."""


class Browser:
    """One page; a context manager that terminates the browser on exit."""

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
        """Errors reported by the page."""

    def __enter__(self) -> Self:
        self._process = subprocess.Popen(
            [*self._command, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            # The browser writes its port into this file.
            port_file = self._profile / "DevToolsActivePort"
            eventually(lambda: port_file.exists() and len(port_file.read_text().splitlines()) == 2)
            port, path = port_file.read_text().splitlines()
            self._socket = self._closing.enter_context(
                connect(f"ws://127.0.0.1:{port}{path}", max_size=None, proxy=None)
            )
            (page,) = [target for target in self._call("Target.getTargets")["targetInfos"] if target["type"] == "page"]
            self._session = self._call("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Network", "Log"):
                self._call(f"{domain}.enable")
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

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        request = {"id": self._number, "method": method, "params": parameters}
        if hasattr(self, "_session"):
            request["sessionId"] = self._session
        self._socket.send(json.dumps(request))
        while True:
            reply = json.loads(self._socket.recv(timeout=60))
            if reply.get("id") == self._number:
                assert "error" not in reply, reply
                return dict(reply["result"])
            self._handle_event(reply)

    def _handle_event(self, event: dict[str, Any]) -> None:
        parameters = event.get("params", {})
        match event.get("method"):
            case "Network.requestWillBeSent":
                self._requests[parameters["requestId"]] = parameters["request"]["url"]
            case "Network.loadingFailed" if parameters.get("blockedReason") == "csp":
                self._requests.pop(parameters["requestId"], None)
            case "Runtime.exceptionThrown":
                self.errors.append(str(parameters["exceptionDetails"]))
            case "Log.entryAdded" if parameters["entry"]["level"] == "error":
                self.errors.append(parameters["entry"]["text"])

    def open(self, address: str, *, width: int = 1200, height: int = 900) -> None:
        """Open a URL in a window of the given size, and wait until it is loaded."""
        self._requests.clear()
        self.errors.clear()
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._call("Emulation.setDeviceMetricsOverride", **metrics)
        self._call("Page.navigate", url=address)
        eventually(lambda: self.run("document.readyState") == "complete")

    def emulate(self, *, media: str = "", scheme: str = "light") -> None:
        """Set the medium, "screen" or "print", and the color scheme, "light" or "dark"."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self._call("Emulation.setEmulatedMedia", media=media, features=features)

    @property
    def requests(self) -> list[str]:
        """URLs requested by the page, without those blocked by its Content-Security-Policy."""
        return list(self._requests.values())

    def run(self, script: str) -> Any:
        """Value of a JavaScript expression in the page."""
        reply = self._call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in reply, reply
        return reply["result"].get("value")

    def screenshot(self, save: Path | None = None) -> np.ndarray:
        """Screenshot of the window, shape (height, width, 3), values 0 to 1."""
        data = base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"])
        if save is not None:
            save.write_bytes(data)
        return np.asarray(imread(io.BytesIO(data))[..., :3])

    def until(self, condition: Callable[[np.ndarray], bool], *, timeout_s: float = 90.0) -> np.ndarray:
        """Wait until a screenshot satisfies `condition`; returns it."""
        latest: list[np.ndarray] = []

        def is_satisfied() -> bool:
            latest[:] = [self.screenshot()]
            return condition(latest[0])

        eventually(is_satisfied, timeout_s=timeout_s, every_s=0.5)
        return latest[0]


def share_of(
    image: np.ndarray, red: tuple[float, float], green: tuple[float, float], blue: tuple[float, float]
) -> float:
    """Share of pixels with all channels, 0 to 1, within the ranges."""
    inside = np.ones(image.shape[:2], dtype=bool)
    for channel, (low, high) in enumerate((red, green, blue)):
        inside &= (image[..., channel] >= low) & (image[..., channel] <= high)
    return float(inside.mean())
