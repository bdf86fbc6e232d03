"""The other end of the uplink: a fleet server on loopback, and the client that reports to it."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Any, Self

import aiohttp
from aiohttp import web

if TYPE_CHECKING:
    from types import TracebackType

REQUEST_TIMEOUT_S = 5.0


class FleetServer:
    """Collect reports over HTTP in a thread and an event loop of its own.

    A stand-in for a computer elsewhere: it shares no loop, and no fate, with the vehicle.
    """

    def __init__(self) -> None:
        """Prepare the server; entering the context starts it."""
        self.reports: list[dict[str, Any]] = []
        self.url = ""
        self._listening = threading.Event()
        self._failure: BaseException | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._closing: asyncio.Event | None = None
        self._thread = threading.Thread(target=self._run, name="fleet-server", daemon=True)

    def __enter__(self) -> Self:
        """Start the thread and wait until the server listens."""
        self._thread.start()
        self._listening.wait()
        if self._failure is not None:
            raise self._failure
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the server and its thread."""
        if self._loop is not None and self._closing is not None:
            self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join()

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as failure:  # handed to the thread that waits in __enter__
            self._failure = failure
            self._listening.set()

    async def _serve(self) -> None:
        self._loop, self._closing = asyncio.get_running_loop(), asyncio.Event()
        app = web.Application()
        app.router.add_post("/reports", self._receive)
        runner = web.AppRunner(app, access_log=None)
        await runner.setup()
        try:
            # Port 0: the system picks a free one.
            await web.TCPSite(runner, "127.0.0.1", 0).start()
            self.url = f"http://127.0.0.1:{runner.addresses[0][1]}/reports"
            self._listening.set()
            await self._closing.wait()
        finally:
            await runner.cleanup()

    async def _receive(self, request: web.Request) -> web.Response:
        self.reports.append(await request.json())
        return web.json_response({"received": len(self.reports)})


class FleetClient:
    """Post reports over one kept-alive session.

    Thread: the event loop's.
    """

    def __init__(self, url: str) -> None:
        """Report to a URL; the first report opens the session."""
        self._url = url
        self._session: aiohttp.ClientSession | None = None

    async def report(self, report: dict[str, Any]) -> int:
        """Send one report and return how many the server has received."""
        if self._session is None:
            timeout = aiohttp.ClientTimeout(total=REQUEST_TIMEOUT_S)
            self._session = aiohttp.ClientSession(timeout=timeout)
        async with self._session.post(self._url, json=report) as response:
            response.raise_for_status()
            return int((await response.json())["received"])

    async def close(self) -> None:
        """Close the connection."""
        if self._session is not None:
            await self._session.close()
            self._session = None
