"""Sends metrics where they are wanted, from a thread that the schedule does not know of."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Protocol

import aiohttp
import msgspec
from aiohttp import web

from horus import clock
from horus.endpoint import Endpoint, Kind
from horus.loop.daemon_pool import DaemonPool
from horus.observe.metrics import Metrics, otlp, prometheus_text

_log = logging.getLogger("horus.telemetry")

PERIOD_S = 1.0
_ANSWER_TIMEOUT_S = 5.0
_RETRY_S = 5.0
_FAREWELL_S = 1.0
"""How long the last snapshot may take [s]."""
_JOIN_S = 2.0


class _Exporter(Protocol):
    async def export(self, snapshot: dict[str, Any]) -> None:
        """Send a snapshot.

        Raises:
            OSError: It could not be sent.
            aiohttp.ClientError: Likewise.
            TimeoutError: Likewise.
        """


class Telemetry:
    """Exports metrics once a second, from `start` to `stop`.

    A snapshot that finds the one before still on its way is dropped and counted. What goes
    wrong is logged when it begins and when it is over.

    Thread: any.
    """

    def __init__(self, endpoint: Endpoint, metrics: Metrics) -> None:
        """Prepare to export; nothing happens yet."""
        self._endpoint = endpoint
        self._metrics = metrics
        self._began_ns = clock.wall_ns()
        self._loop = asyncio.new_event_loop()
        # Looking up a name may hang: that must not keep the process from ending.
        self._loop.set_default_executor(DaemonPool("horus-telemetry-work"))
        self._stopping = asyncio.Event()
        self._failing = False
        self._thread = threading.Thread(target=self._run, name="horus-telemetry", daemon=True)
        self.sent = 0
        self.dropped = 0

    def start(self) -> None:
        """Begin to export."""
        self._thread.start()

    def stop(self) -> None:
        """Export a last time, for a second at most."""
        with contextlib.suppress(RuntimeError):  # it has ended before
            self._loop.call_soon_threadsafe(self._stopping.set)
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._export())
        except Exception:
            _log.exception("telemetry to %s has ended, and the robot runs on", self._endpoint.text)
        finally:
            self._loop.close()

    async def _export(self) -> None:
        if self._endpoint.kind is Kind.SCRAPE:
            await self._serve()
            return
        async with self._exporter() as exporter:
            sending: asyncio.Task[None] | None = None
            while not self._stopping.is_set():
                if sending is None or sending.done():
                    sending = self._loop.create_task(self._send(exporter))
                else:
                    self.dropped += 1
                await self._nap(PERIOD_S)
            if sending is not None:
                await asyncio.wait([sending], timeout=_FAREWELL_S / 2)
                sending.cancel()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_FAREWELL_S):
                    await self._send(exporter)

    async def _send(self, exporter: _Exporter) -> None:
        try:
            await exporter.export(self._metrics.snapshot())
        except (OSError, aiohttp.ClientError, TimeoutError) as exc:
            self.dropped += 1
            self._fails(exc)
        else:
            self.sent += 1
            self._works()

    def _fails(self, exc: Exception) -> None:
        if not self._failing:
            self._failing = True
            reason = str(exc) or type(exc).__name__
            _log.warning(
                "telemetry to %s fails, and the robot runs on: %s", self._endpoint.text, reason
            )

    def _works(self) -> None:
        if self._failing:
            self._failing = False
            _log.warning(
                "telemetry to %s works again; %d snapshots were lost",
                self._endpoint.text,
                self.dropped,
            )

    @asynccontextmanager
    async def _exporter(self) -> AsyncIterator[_Exporter]:
        endpoint = self._endpoint
        if endpoint.path is not None:
            yield _Append(endpoint.path)
            return
        timeout = aiohttp.ClientTimeout(total=_ANSWER_TIMEOUT_S)
        async with aiohttp.ClientSession(timeout=timeout) as session:
            yield _Post(session, endpoint, self._began_ns)

    async def _serve(self) -> None:
        endpoint = self._endpoint
        app = web.Application()
        app.router.add_get("/metrics", self._answer)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
        await runner.setup()
        try:
            while not self._stopping.is_set():
                try:
                    site = web.TCPSite(runner, endpoint.host, endpoint.port)
                    await site.start()
                except OSError as exc:
                    self._fails(exc)
                    await self._nap(_RETRY_S)
                else:
                    self._works()
                    await self._stopping.wait()
        finally:
            await runner.cleanup()

    async def _answer(self, request: web.Request) -> web.Response:
        text = prometheus_text([self._metrics.snapshot()])
        self.sent += 1
        return web.Response(text=text, headers={"Content-Type": "text/plain; version=0.0.4"})

    async def _nap(self, seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._stopping.wait()


class _Post:
    """POSTs snapshots as JSON, or as OTLP/JSON."""

    def __init__(self, session: aiohttp.ClientSession, endpoint: Endpoint, began_ns: int) -> None:
        self._session = session
        self._endpoint = endpoint
        self._began_ns = began_ns

    async def export(self, snapshot: dict[str, Any]) -> None:
        if self._endpoint.kind is Kind.OTLP:
            snapshot = otlp(snapshot, self._began_ns)
        async with self._session.post(
            self._endpoint.url,
            data=msgspec.json.encode(snapshot),
            headers={"Content-Type": "application/json"},
        ) as answer:
            answer.raise_for_status()


class _Append:
    """Appends snapshots to a file, one JSON object a line."""

    def __init__(self, path: Path) -> None:
        self._path = path

    async def export(self, snapshot: dict[str, Any]) -> None:
        # Opened each time: log rotation takes files away.
        with self._path.open("ab") as file:
            file.write(msgspec.json.encode(snapshot) + b"\n")
