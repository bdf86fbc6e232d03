"""The HTTP interface of a scheduler: `make_app(sched)` is an aiohttp application around it.

Nodes and handlers share the process and the event loop. The scheduler starts with the
server and ends with it; handlers call its methods as any other code would.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from typing import Any

import msgspec
from aiohttp import web

from horus import ConfigError, Scheduler, TopicError, UnknownNodeError
from horus.stream import MessageStream

SCHEDULER = web.AppKey("scheduler", Scheduler)
STREAMS = web.AppKey("streams", set[MessageStream])

KEEP_ALIVE_S = 10.0
"""After so long without a message a stream says that it is still there."""

ESTOP_TIMEOUT_S = 2.0

routes = web.RouteTableDef()


def make_app(sched: Scheduler) -> web.Application:
    """Return an application that runs `sched` for as long as it is served."""
    app = web.Application(middlewares=[errors_as_json])
    app[SCHEDULER] = sched
    app[STREAMS] = set()
    app.add_routes(routes)
    app.cleanup_ctx.append(run_nodes)
    app.on_shutdown.append(end_streams)
    return app


async def run_nodes(app: web.Application) -> AsyncIterator[None]:
    """Run the nodes while the server does."""
    async with app[SCHEDULER] as sched:
        await sched.started()
        yield


async def end_streams(app: web.Application) -> None:
    """Let go of the clients that listen, or the server would wait for them."""
    for stream in tuple(app[STREAMS]):
        stream.close()


@web.middleware
async def errors_as_json(request: web.Request, handler: Any) -> web.StreamResponse:
    """Answer what the scheduler refuses with its own words."""
    try:
        response: web.StreamResponse = await handler(request)
        return response
    except UnknownNodeError as exc:
        return web.json_response({"error": str(exc)}, status=404)
    except (ConfigError, TopicError) as exc:
        return web.json_response({"error": str(exc)}, status=400)
    except TimeoutError as exc:
        return web.json_response({"error": str(exc)}, status=504)


@routes.get("/nodes")
async def nodes(request: web.Request) -> web.Response:
    """Every node's configuration, state and counters, in execution order."""
    return web.json_response(request.app[SCHEDULER].get_all_nodes())


@routes.get("/nodes/{name}")
async def node(request: web.Request) -> web.Response:
    """One node's."""
    return web.json_response(request.app[SCHEDULER].get_node_stats(request.match_info["name"]))


@routes.post("/nodes/{name}/rate")
async def set_rate(request: web.Request) -> web.Response:
    """`{"rate": 50}`: from the next release on [Hz]."""
    sched, name = request.app[SCHEDULER], request.match_info["name"]
    wanted = await read_object(request)
    sched.set_node_rate(name, wanted.get("rate"))
    return web.json_response(sched.get_node_stats(name))


@routes.post("/estop")
async def estop(request: web.Request) -> web.Response:
    """`{"engaged": true}` (the default) answers when the cart stands; `false` lets it go."""
    sched = request.app[SCHEDULER]
    engaged = (await read_object(request)).get("engaged", True)
    if not isinstance(engaged, bool):
        raise ConfigError("engaged", engaged, "must be true or false")
    stop = {"engaged": engaged}
    if not engaged:
        sched.publish("emergency.stop", stop)
        return web.json_response(stop)
    where = await sched.request(
        "emergency.stop", stop, reply="emergency.stopped", timeout=ESTOP_TIMEOUT_S
    )
    return web.json_response({**stop, **where})


@routes.get("/topics/{topic}/stream")
async def stream_topic(request: web.Request) -> web.StreamResponse:
    """The topic's messages as server-sent events, until the client or the server ends."""
    messages = request.app[SCHEDULER].subscribe(request.match_info["topic"], capacity=100)
    request.app[STREAMS].add(messages)
    response = web.StreamResponse(
        headers={"Content-Type": "text/event-stream", "Cache-Control": "no-cache"}
    )
    with messages, contextlib.suppress(ConnectionResetError):  # the client has gone
        try:
            await response.prepare(request)
            while (event := await next_event(messages)) is not None:
                await response.write(event)
        finally:
            request.app[STREAMS].discard(messages)
    return response


@routes.get("/metrics")
async def metrics(request: web.Request) -> web.Response:
    """Counters of nodes and topics for Prometheus."""
    text = request.app[SCHEDULER].metrics_text()
    return web.Response(text=text, headers={"Content-Type": "text/plain; version=0.0.4"})


async def next_event(messages: MessageStream) -> bytes | None:
    """Return the next message as an event, or a sign of life; None when there will be no more."""
    try:
        async with asyncio.timeout(KEEP_ALIVE_S):
            message = await anext(messages, None)
    except TimeoutError:
        return b": still here\n\n"
    if message is None:
        return None
    return b"data: " + msgspec.json.encode(message, enc_hook=repr) + b"\n\n"


async def read_object(request: web.Request) -> dict[str, Any]:
    """Return the JSON object in the body; an empty one if there is no body."""
    try:
        body = json.loads(await request.text() or "{}")
    except ValueError as exc:
        raise ConfigError("body", "...", f"must be JSON: {exc}") from None
    if not isinstance(body, dict):
        raise ConfigError("body", body, 'must be a JSON object, e.g. {"rate": 50}')
    return body
