"""Upload from an `async def` tick, to a server on the loopback interface.

`async with` runs the scheduler on the application's event loop, which the server shares.

Prints:
    the server received ... uploads, the first one {'voltage': 24.0}
"""

from __future__ import annotations

import asyncio
from typing import Any

import aiohttp
from aiohttp import web

from horus import Node, Scheduler

received: list[Any] = []


async def accept(request: web.BaseRequest) -> web.Response:
    """Take one upload."""
    received.append(await request.json())
    return web.Response()


def read_battery(node: Node) -> None:
    """Publish the voltage."""
    node.send("telemetry", {"voltage": 24.0})


def uploader(url: str) -> Node:
    """Return a node that posts every telemetry message to `url`."""

    async def upload_telemetry(node: Node) -> None:
        if node.has_msg("telemetry"):
            data = node.recv("telemetry")
            async with aiohttp.ClientSession() as session, session.post(url, json=data):
                pass

    return Node("cloud", upload_telemetry, rate=20, subs=["telemetry"], failure_policy="skip")


async def main() -> None:
    """Serve and upload on one loop."""
    runner = web.ServerRunner(web.Server(accept))
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    port = runner.addresses[0][1]
    battery = Node("battery", read_battery, rate=20, pubs=["telemetry"])
    cloud = uploader(f"http://127.0.0.1:{port}/telemetry")
    async with Scheduler(tick_rate=100).add(battery).add(cloud):
        await asyncio.sleep(0.5)
    await runner.cleanup()
    print(f"the server received {len(received)} uploads, the first one {received[0]}")


if __name__ == "__main__":
    asyncio.run(main())
