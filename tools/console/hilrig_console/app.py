"""What a browser is given: the page, what happens in the lab as server-sent events, recordings and their reports.

Everything is read, nothing is changed. Each browser waits for the next frame and takes the newest there is when its
connection has taken the last one: one that is slow sees fewer.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from html import escape
from http import HTTPStatus
from pathlib import Path
from typing import Final

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from hilrig_console.auth import HEALTH_PATH, REPORT_POLICY, AccessPolicy, AuthMiddleware
from hilrig_console.catalog import RecordingCatalog
from hilrig_console.subscriber import LabSubscriber
from hilrig_console.view_model import ClientState, Frame
from hilrig_runtime.errors import HilrigError, InputError

PERIOD_S: Final = 0.2
"""Between frames."""
MAX_BROWSERS: Final = 64
"""That follow the lab at once."""
FILES: Final = Path(__file__).with_name("static")
PAGE_FILES: Final = ("console.css", "console.js", "icon.svg")

logger = logging.getLogger(__name__)


class Broadcast:
    """The newest frame, for all browsers; `close` ends their streams."""

    def __init__(self, make: Callable[[], Frame]) -> None:
        self._make = make
        self._frame: Frame | None = None
        self._next = asyncio.Event()
        self.browsers = 0
        self.closed = False

    def close(self) -> None:
        """End every stream within a period; from any thread."""
        self.closed = True

    async def make(self) -> None:
        """Make a frame, if somebody looks."""
        # On another thread: with hundreds of rigs it takes a while, and downloads go on.
        self._frame = await asyncio.to_thread(self._make) if self.browsers else None
        woken, self._next = self._next, asyncio.Event()
        woken.set()

    async def stream(self, event: int) -> AsyncIterator[str]:
        """What one browser gets that has seen the events up to a number."""
        seen = ClientState(event=event)
        self.browsers += 1
        try:
            while not self.closed:
                await self._next.wait()
                text, seen = ("", seen) if self._frame is None else self._frame.news(seen)
                if text:
                    yield text
        finally:
            self.browsers -= 1


class Console:
    """The pages of one lab."""

    def __init__(self, subscriber: LabSubscriber, catalog: RecordingCatalog, policy: AccessPolicy) -> None:
        self._subscriber = subscriber
        self._catalog = catalog
        self._page = (FILES / "index.html").read_text(encoding="utf-8")
        self.broadcast: Broadcast | None = None
        routes = [
            Route("/", self._index),
            Route("/live", self._live),
            Route("/scenes", self._scenes),
            Route("/runs", self._runs),
            Route("/recordings/{path:path}", self._recording),
            Route("/reports/{path:path}", self._report),
            Route(HEALTH_PATH, self._health),
            *(Route(f"/{name}", self._file) for name in PAGE_FILES),
        ]
        app = Starlette(routes=routes, lifespan=self._life, exception_handlers={HilrigError: _sorry})  # type: ignore[dict-item]
        self.app: ASGIApp = AuthMiddleware(app, policy)

    @asynccontextmanager
    async def _life(self, app: Starlette) -> AsyncIterator[None]:
        del app
        self.broadcast = Broadcast(self._frame)
        tasks = [asyncio.create_task(_repeat(work)) for work in (self.broadcast.make, self._look)]
        yield
        for task in tasks:
            task.cancel()
        with suppress(asyncio.CancelledError):
            await asyncio.gather(*tasks)

    def _frame(self) -> Frame:
        return self._subscriber.frame({"runs": self._catalog.version})

    async def _look(self) -> None:
        """Keep the list of recordings fresh while somebody looks."""
        if self._stream.browsers:
            await asyncio.to_thread(self._catalog.refresh)

    @property
    def _stream(self) -> Broadcast:
        assert self.broadcast is not None
        return self.broadcast

    async def _index(self, request: Request) -> Response:
        del request
        return HTMLResponse(self._page)

    async def _file(self, request: Request) -> Response:
        return FileResponse(FILES / request.url.path[1:])

    async def _health(self, request: Request) -> Response:
        del request
        return PlainTextResponse("well\n")

    async def _live(self, request: Request) -> Response:
        if self._stream.browsers >= MAX_BROWSERS:
            return PlainTextResponse(f"{MAX_BROWSERS} browsers look already\n", HTTPStatus.SERVICE_UNAVAILABLE)
        last = request.headers.get("last-event-id", "")
        stream = self._stream.stream(int(last) if last.isascii() and last.isdigit() else 0)
        return StreamingResponse(stream, media_type="text/event-stream", headers={"X-Accel-Buffering": "no"})

    async def _scenes(self, request: Request) -> Response:
        del request
        return JSONResponse(self._subscriber.scenes())

    async def _runs(self, request: Request) -> Response:
        return JSONResponse(self._catalog.search(request.query_params.get("words", "")))

    async def _recording(self, request: Request) -> Response:
        file = self._catalog.file(request.path_params["path"])
        return FileResponse(file, filename=file.name, media_type="application/octet-stream")

    async def _report(self, request: Request) -> Response:
        page = await asyncio.to_thread(self._catalog.report, request.path_params["path"])
        text = await asyncio.to_thread(page.read_text, "utf-8")
        return HTMLResponse(text, headers={"Content-Security-Policy": REPORT_POLICY})


async def _repeat(work: Callable[[], Awaitable[None]]) -> None:
    """Do it every period; a mistake in it once is no reason to stop."""
    while True:
        try:
            await work()
        except Exception:
            logger.exception("%s failed", work)
        await asyncio.sleep(PERIOD_S)


async def _sorry(request: Request, error: HilrigError) -> Response:
    """A page that says in one sentence what is wrong."""
    del request
    status = HTTPStatus.NOT_FOUND if isinstance(error, InputError) else HTTPStatus.SERVICE_UNAVAILABLE
    text = f"<!DOCTYPE html><html lang=en><meta charset=utf-8><title>hilrig</title><p>{escape(str(error))}</p></html>\n"
    return HTMLResponse(text, status)
