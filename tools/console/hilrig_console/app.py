"""Web application of the console: the page, the lab's state as server-sent events, recordings and their reports.

All routes are read-only. Each browser receives the newest frame as soon as its connection has sent the previous one, so
a slow browser skips frames.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from typing import Final

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from hilrig_console.auth import HEALTH_PATH, REPORT_POLICY, AccessPolicy, AuthMiddleware
from hilrig_console.catalog import RecordingCatalog
from hilrig_console.subscriber import LabSubscriber
from hilrig_console.view_model import ClientState, Frame
from hilrig_runtime.errors import HilrigError, InputError
from hilrig_runtime.escaping import as_html, printable

FRAME_PERIOD_S: Final = 0.2
"""Period of the frames, s."""
MAX_BROWSERS: Final = 64
"""Upper limit of simultaneous event streams."""
STATIC_FOLDER: Final = Path(__file__).with_name("static")

logger = logging.getLogger(__name__)


class Broadcast:
    """Broadcasts the newest frame to the event streams of all browsers."""

    def __init__(self, make_frame: Callable[[], Frame]) -> None:
        self._make_frame = make_frame
        self._frame: Frame | None = None
        self._next = asyncio.Event()
        self.browsers = 0
        self.closed = False

    def close(self) -> None:
        """End every stream within a period; may be called from any thread."""
        self.closed = True

    async def publish(self) -> None:
        """Make a frame if a browser is connected, and wake up the streams."""
        # In another thread: a frame of hundreds of rigs takes long, and must not block downloads.
        self._frame = await asyncio.to_thread(self._make_frame) if self.browsers else None
        published, self._next = self._next, asyncio.Event()
        published.set()

    async def stream(self, event: int) -> AsyncIterator[str]:
        """Yield the server-sent events for a browser that has received the events up to a number."""
        state = ClientState(event=event)
        self.browsers += 1
        try:
            while not self.closed:
                await self._next.wait()
                text, state = ("", state) if self._frame is None else self._frame.updates(state)
                if text:
                    yield text
        finally:
            self.browsers -= 1


class Console:
    """Routes of the console of one lab."""

    def __init__(self, subscriber: LabSubscriber, catalog: RecordingCatalog, policy: AccessPolicy) -> None:
        self._subscriber = subscriber
        self._catalog = catalog
        self.broadcast = Broadcast(self._frame)
        routes = [
            Route("/live", self._live),
            Route("/scenes", self._scenes),
            Route("/runs", self._runs),
            Route("/recordings/{path:path}", self._recording),
            Route("/reports/{path:path}", self._report),
            Route(HEALTH_PATH, self._health),
            Mount("/", StaticFiles(directory=STATIC_FOLDER, html=True)),
        ]
        app = Starlette(routes=routes, lifespan=self._lifespan, exception_handlers={HilrigError: _error_response})  # type: ignore[dict-item]
        self.app: ASGIApp = AuthMiddleware(app, policy)

    @asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        del app
        tasks = [asyncio.create_task(_repeat(task)) for task in (self.broadcast.publish, self._refresh_recordings)]
        yield
        for task in tasks:
            task.cancel()
        with suppress(asyncio.CancelledError):
            await asyncio.gather(*tasks)

    def _frame(self) -> Frame:
        return self._subscriber.frame({"runs": self._catalog.version})

    async def _refresh_recordings(self) -> None:
        """Refresh the list of recordings while a browser is connected."""
        if self.broadcast.browsers:
            await asyncio.to_thread(self._catalog.refresh)

    async def _health(self, request: Request) -> Response:
        del request
        return PlainTextResponse("ok\n")

    async def _live(self, request: Request) -> Response:
        if self.broadcast.browsers >= MAX_BROWSERS:
            return PlainTextResponse(
                f"limit of {MAX_BROWSERS} connected browsers reached\n", HTTPStatus.SERVICE_UNAVAILABLE
            )
        last = request.headers.get("last-event-id", "")
        stream = self.broadcast.stream(int(last) if last.isascii() and last.isdigit() else 0)
        return StreamingResponse(stream, media_type="text/event-stream", headers={"X-Accel-Buffering": "no"})

    async def _scenes(self, request: Request) -> Response:
        del request
        return JSONResponse(self._subscriber.scenes())

    async def _runs(self, request: Request) -> Response:
        return JSONResponse(self._catalog.search(request.query_params.get("query", "")))

    async def _recording(self, request: Request) -> Response:
        file = self._catalog.file(request.path_params["path"])
        return FileResponse(file, filename=printable(file.name), media_type="application/octet-stream")

    async def _report(self, request: Request) -> Response:
        page = await asyncio.to_thread(self._catalog.report, request.path_params["path"])
        text = await asyncio.to_thread(page.read_text, "utf-8")
        return HTMLResponse(text, headers={"Content-Security-Policy": REPORT_POLICY})


async def _repeat(task: Callable[[], Awaitable[None]]) -> None:
    """Run a task every period; an exception is logged and does not stop the repetition."""
    while True:
        try:
            await task()
        except Exception:
            logger.exception("%s failed", task)
        await asyncio.sleep(FRAME_PERIOD_S)


async def _error_response(request: Request, error: HilrigError) -> Response:
    """Return an error page with the message of the error."""
    del request
    status = HTTPStatus.NOT_FOUND if isinstance(error, InputError) else HTTPStatus.SERVICE_UNAVAILABLE
    text = (
        f"<!DOCTYPE html><html lang=en><meta charset=utf-8><title>hilrig</title><p>{as_html(str(error))}</p></html>\n"
    )
    return HTMLResponse(text, status)
