"""The fleet service: a robot with an HTTP interface, talked to by a real client."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import aiohttp
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "fleet_service"
TIMEOUT_S = 20.0


@pytest.fixture
def service() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Serve on a free port; return the process and its address."""
    command = [sys.executable, "-u", str(EXAMPLE), "--port", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if found := re.search(r"http://[\d.]+:\d+", line):
                break
        else:
            raise AssertionError("it does not say where it listens")
        try:
            yield process, found[0]
        finally:
            process.kill()


def test_the_robot_is_seen_and_told_over_http(service):
    """Nodes, rates, emergency stop, messages and metrics."""
    _, address = service

    async def main():
        timeout = aiohttp.ClientTimeout(total=TIMEOUT_S)
        async with aiohttp.ClientSession(address, timeout=timeout) as client:
            async with client.get("/nodes") as answer:
                assert [node["name"] for node in await answer.json()] == ["drive", "battery"]
            async with client.get("/nodes/drive") as answer:
                assert (await answer.json())["state"] == "running"

            async with client.post("/nodes/drive/rate", json={"rate": 50}) as answer:
                assert (await answer.json())["rate"] == 50

            async with client.get("/topics/odom/stream") as stream:
                while (await next_event(stream))["speed_mps"] < 1.0:
                    pass
            async with client.post("/estop") as answer:
                stopped = await answer.json()
                assert answer.status == 200, stopped
                assert stopped["engaged"] is True
            async with client.get("/topics/odom/stream") as stream:
                assert stream.content_type == "text/event-stream"
                events = [await next_event(stream) for _ in range(3)]
                assert {event["speed_mps"] for event in events} == {0.0}
                assert events[0]["x_m"] == pytest.approx(stopped["x_m"])
            async with client.post("/estop", json={"engaged": False}) as answer:
                assert await answer.json() == {"engaged": False}

            async with client.get("/metrics") as answer:
                metrics = await answer.text()
            ticks = re.search(r'^horus_node_ticks_total\{node="drive",.*\} (\S+)$', metrics, re.M)
            assert ticks is not None
            assert float(ticks[1]) > 20
            assert 'horus_node_healthy{node="battery",scheduler="cart"} 1.0' in metrics

    asyncio.run(main())


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "message"),
    [
        ("GET", "/nodes/motor", None, 404, "motor"),
        ("POST", "/nodes/motor/rate", '{"rate": 5}', 404, "motor"),
        ("POST", "/nodes/drive/rate", '{"rate": -5}', 400, "rate"),
        ("POST", "/nodes/drive/rate", "{}", 400, "rate"),
        ("POST", "/nodes/drive/rate", "faster", 400, "JSON"),
        ("POST", "/nodes/drive/rate", "[5]", 400, "JSON object"),
        ("POST", "/estop", '{"engaged": "yes"}', 400, "engaged"),
        ("GET", "/topics/..%2Fetc/stream", None, 400, "topic"),
        ("GET", "/wheels", None, 404, "Not Found"),
    ],
)
def test_what_is_refused_says_why(service, method, path, body, status, message):
    """In the scheduler's own words, and the robot goes on."""
    _, address = service

    async def main():
        async with aiohttp.ClientSession() as client:
            async with client.request(method, address + path, data=body) as answer:
                assert answer.status == status
                assert message in await answer.text()
            async with client.get(f"{address}/nodes/drive") as answer:
                assert (await answer.json())["errors_count"] == 0

    asyncio.run(main())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_shuts_down_in_order_although_clients_listen(service, number):
    """The stream ends, the brake is on, the exit status is 0."""
    process, address = service

    async def main():
        url = f"{address}/topics/odom/stream"
        async with aiohttp.ClientSession() as client, client.get(url) as stream:
            await next_event(stream)
            process.send_signal(number)
            async with asyncio.timeout(TIMEOUT_S):
                while await stream.content.readline():
                    pass

    began_s = time.monotonic()
    asyncio.run(main())
    said, _ = process.communicate(timeout=TIMEOUT_S)
    assert time.monotonic() - began_s < 4.0  # the server did not have to wait for the client
    assert process.returncode == 0, said
    assert "brake on at" in said
    assert "Traceback" not in said


async def next_event(stream):
    """Return the data of the next server-sent event."""
    while True:
        line = (await stream.content.readline()).decode()
        assert line, "the stream has ended"
        if line.startswith("data: "):
            return json.loads(line.removeprefix("data: "))
