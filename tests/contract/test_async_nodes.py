"""Async nodes: `async def tick` on the one event loop."""

from __future__ import annotations

import asyncio
import contextvars
import threading
import time

import aiohttp
import pytest
from aiohttp import web

import horus
from horus import Node, ms

from .helpers import (
    all_have_ticked,
    nothing,
    run_async,
    run_until,
    running,
    until,
    wait_until,
)


async def nap(node: Node) -> None:
    """Let the loop do something else."""
    await asyncio.sleep(0)


def test_async_def_makes_the_node_async_io_without_further_configuration():
    """If tick is `async def`, the node is automatically assigned to the AsyncIo class."""
    assert Node("cloud", nap).execution_class == "AsyncIo"
    assert Node("cloud", nap, rate=1).execution_class == "AsyncIo"


@pytest.mark.realtime
def test_an_async_node_uploads_with_aiohttp(make, loop):
    """The async node of the contract: an aiohttp session posts telemetry as JSON."""
    received = []

    async def collect(request):
        received.append(await request.json())
        return web.Response()

    async def main():
        app = web.Application()
        app.router.add_post("/telemetry", collect)
        server = web.AppRunner(app)
        await server.setup()
        site = web.TCPSite(server, "127.0.0.1", 0)
        await site.start()
        port = server.addresses[0][1]

        async def upload_telemetry(node):
            if node.has_msg("telemetry"):
                data = node.recv("telemetry")
                async with aiohttp.ClientSession() as session:
                    await session.post(f"http://127.0.0.1:{port}/telemetry", json=data)
                node.request_stop()

        sched = make()
        sched.add(
            Node(
                name="cloud",
                tick=upload_telemetry,
                rate=20,
                order=200,
                pubs=[],
                subs=["telemetry"],
                failure_policy="skip",
            )
        )
        sched.publish("telemetry", {"battery": 23.5})
        try:
            await sched.arun(duration=10.0)
        finally:
            await server.cleanup()

    run_async(main(), loop)

    assert received == [{"battery": 23.5}]


@pytest.mark.realtime
def test_while_one_tick_awaits_others_tick(make, loop):
    """An async tick that waits for the network holds up nobody."""
    ticks = {"fast": 0, "logger": 0}

    async def slow(node):
        await asyncio.sleep(10)

    async def fast(node):
        ticks["fast"] += 1

    def logger(node):
        ticks["logger"] += 1

    sched = make(loop=loop)
    sched.add(Node("slow", slow, rate=100, order=0))
    sched.add(Node("fast", fast, rate=100, order=1))
    sched.add(Node("logger", logger, order=2))

    run_until(sched, lambda: ticks["fast"] >= 15 and ticks["logger"] >= 5)

    assert sched.get_node_stats("slow")["total_ticks"] == 0


@pytest.mark.realtime
def test_async_ticks_never_overlap_themselves(make, loop):
    """A release that finds the node still busy is skipped and counted, never run beside it."""
    inside = []
    overlaps = []

    async def tick(node):
        overlaps.extend(inside)
        inside.append(1)
        await asyncio.sleep(25 * ms)
        inside.pop()

    sched = make(loop=loop)
    sched.add(Node("node", tick, rate=100))

    run_until(sched, lambda: sched.get_node_stats("node")["total_ticks"] >= 5)

    stats = sched.get_node_stats("node")
    assert overlaps == []
    assert stats["skipped"] >= stats["total_ticks"]


def test_async_ticks_never_overlap_themselves_in_virtual_time(make):
    """A tick of 25 ms at 100 Hz runs at every third release; the others are skipped."""
    times = []

    async def tick(node):
        times.append(round(horus.now(), 6))
        await asyncio.sleep(25 * ms)

    sched = make(tick_rate=100, deterministic=True)
    sched.add(Node("node", tick, rate=100))

    sched.tick_for(0.3)

    assert times == [round(0.03 * k, 6) for k in range(10)]
    assert sched.get_node_stats("node")["skipped"] == 20


@pytest.mark.realtime
def test_background_tasks_keep_running_between_ticks(make, loop):
    """User libraries live on this one loop: their background tasks run between ticks."""
    beats = []
    tasks = []

    async def heart():
        while True:
            beats.append(1)
            await asyncio.sleep(5 * ms)

    async def init(node):
        tasks.append(asyncio.create_task(heart()))

    async def tick(node):
        pass

    async def shutdown(node):
        tasks[0].cancel()

    sched = make(loop=loop)
    sched.add(Node("node", tick, rate=5, init=init, shutdown=shutdown))

    run_until(sched, lambda: len(beats) >= 10)

    assert sched.get_node_stats("node")["total_ticks"] < len(beats)


@pytest.mark.realtime
def test_a_session_opened_in_init_is_usable_in_tick_and_closed_in_shutdown(make, loop):
    """init, tick and shutdown of an async node share the loop, so sessions live across them."""
    loops = []
    sessions = []

    async def init(node):
        loops.append(asyncio.get_running_loop())
        sessions.append(aiohttp.ClientSession())

    async def tick(node):
        loops.append(asyncio.get_running_loop())
        assert not sessions[0].closed

    async def shutdown(node):
        loops.append(asyncio.get_running_loop())
        await sessions[0].close()

    sched = make(loop=loop)
    sched.add(Node("cloud", tick, rate=50, init=init, shutdown=shutdown))

    run_until(sched, lambda: all_have_ticked(sched))

    assert len(loops) >= 3
    assert len(set(loops)) == 1
    assert sessions[0].closed
    assert sched.get_node_stats("cloud")["errors_count"] == 0


@pytest.mark.realtime
def test_all_async_nodes_share_one_loop(make, loop):
    """Async nodes can share locks, queues and sessions: there is one loop for all."""
    loops = set()

    async def tick(node):
        loops.add(asyncio.get_running_loop())

    sched = make(loop=loop)
    for name in "abc":
        sched.add(Node(name, tick, rate=50))

    run_until(sched, lambda: all_have_ticked(sched))

    assert len(loops) == 1


@pytest.mark.realtime
def test_async_code_may_hand_work_to_threads(make, loop):
    """`await asyncio.to_thread(...)` works, and what it logs and reads is the node's."""
    seen = []

    async def tick(node):
        elapsed = await asyncio.to_thread(lambda: (threading.get_ident(), horus.tick()))
        seen.append(elapsed)
        node.request_stop()

    sched = make(loop=loop)
    sched.add(Node("node", tick, rate=50))

    sched.run(duration=10.0)

    assert seen[0][0] != threading.get_ident()


@pytest.mark.realtime
def test_the_clock_follows_a_tick_across_await(make, loop):
    """horus.tick() and horus.dt() answer for the same tick before and after an await."""
    seen = []

    async def tick(node):
        before = (horus.tick(), horus.dt())
        await asyncio.sleep(15 * ms)
        seen.append((before, (horus.tick(), horus.dt())))

    sched = make(tick_rate=1000, loop=loop)
    for name in "ab":
        sched.add(Node(name, tick, rate=20))

    run_until(sched, lambda: len(seen) >= 6)

    assert all(before == after for before, after in seen)


def test_context_variables_of_a_node_are_its_own(make, deterministic):
    """What a node sets in a context variable is seen by its later ticks and by no other node."""
    variable = contextvars.ContextVar("variable", default="unset")
    seen = []

    async def tick(node):
        seen.append((node.name, variable.get()))
        variable.set(node.name)

    sched = make(tick_rate=100, deterministic=deterministic)
    for name in "ab":
        sched.add(Node(name, tick, rate=100))

    for _ in range(2):
        sched.tick_once()

    assert seen == [("a", "unset"), ("b", "unset"), ("a", "a"), ("b", "b")]
    assert variable.get() == "unset"


def test_sleeping_advances_virtual_time_only(make):
    """In deterministic mode asyncio.sleep() takes virtual time, and no real time."""
    journal = []

    async def tick(node):
        begin = horus.now()
        await asyncio.sleep(60.0)
        journal.append(horus.now() - begin)

    sched = make(tick_rate=1, deterministic=True)
    sched.add(Node("node", tick, rate=0.01))
    begun = time.monotonic()

    sched.tick_for(1000.0)

    assert journal == pytest.approx([60.0] * 10)
    assert time.monotonic() - begun < 20.0


def test_async_ticks_interleave_reproducibly_in_virtual_time(make):
    """Async ticks with sleeps replay identically, run after run."""

    def trace():
        journal = []

        def make_tick(pause):
            async def tick(node):
                journal.append((node.name, "begin", round(horus.now(), 9)))
                await asyncio.sleep(pause * horus.rng_float())
                journal.append((node.name, "end", round(horus.now(), 9)))

            return tick

        sched = make(tick_rate=100, deterministic=True)
        for index, name in enumerate("abc"):
            sched.add(Node(name, make_tick(0.01 * (index + 1)), rate=50))
        sched.tick_for(1.0)
        return journal

    first = trace()
    assert len(first) > 200
    assert trace() == first


def test_asyncio_timeouts_follow_virtual_time(make):
    """`asyncio.timeout` and `wait_for` are measured on the simulated clock."""
    outcome = []

    async def tick(node):
        try:
            async with asyncio.timeout(5.0):
                await asyncio.sleep(3600)
        except TimeoutError:
            outcome.append(round(horus.now(), 6))

    sched = make(tick_rate=10, deterministic=True)
    sched.add(Node("node", tick, rate=0.1))

    sched.tick_for(10.0)

    assert outcome == [5.0]


@pytest.mark.realtime
def test_sync_callbacks_of_an_async_node_work(make, loop):
    """An async tick may go with plain init and shutdown functions."""
    journal = []

    async def tick(node):
        journal.append("tick")

    sched = make(loop=loop)
    sched.add(
        Node(
            "node",
            tick,
            rate=50,
            init=lambda: journal.append("init"),
            shutdown=lambda: journal.append("shutdown"),
        )
    )

    run_until(sched, lambda: "tick" in journal)

    assert journal[0] == "init"
    assert journal[1] == "tick"
    assert journal[-1] == "shutdown"


@pytest.mark.realtime
def test_an_application_publishes_and_subscribes(make, loop):
    """Applications get the same bus: publish(), and `async for` over subscribe()."""
    echoes = []

    def echo(node):
        for message in node.recv_all("ask"):
            node.send("answer", message * 2)

    sched = make(tick_rate=100)
    sched.add(Node("echo", echo, rate=100, subs=["ask"], pubs=["answer"]))

    async def main():
        answers = sched.subscribe("answer")
        async with sched:
            for question in (1, 2, 3):
                sched.publish("ask", question)
            async for answer in answers:
                echoes.append(answer)
                if len(echoes) == 3:
                    break
        # The run is over: what waits is delivered, then the iteration ends.
        echoes.extend([answer async for answer in answers])

    run_async(main(), loop)

    assert echoes == [2, 4, 6]


@pytest.mark.realtime
def test_a_subscription_ends_with_the_run(make, loop):
    """`async for` over a subscription ends when the run does, so no task hangs."""
    received = []
    sched = make(tick_rate=100)
    sched.add(Node("source", lambda n: n.send("value", 1), rate=100, pubs=["value"]))

    async def main():
        values = sched.subscribe("value")

        async def listen():
            received.extend([value async for value in values])

        listener = asyncio.ensure_future(listen())
        await sched.arun(duration=0.1)
        await asyncio.wait_for(listener, 10.0)

    run_async(main(), loop)

    assert len(received) == sched.get_node_stats("source")["total_ticks"]


@pytest.mark.realtime
def test_publish_from_another_thread_reaches_the_nodes(make, loop):
    """publish() is thread-safe and may be called from any thread while running."""
    received = []
    sched = make(loop=loop)
    sched.add(Node("event", lambda n: received.append(n.recv("go")), on="go"))
    sched.add(Node("rt", nothing, rate=100))

    with running(sched):
        wait_until(lambda: sched.get_node_stats("rt")["total_ticks"] > 0)
        threads = [
            threading.Thread(
                target=lambda base=base: [sched.publish("go", base + i) for i in range(50)]
            )
            for base in (0, 100, 200)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        wait_until(lambda: len(received) == 150)

    assert sorted(received) == sorted(b + i for b in (0, 100, 200) for i in range(50))
    for base in (0, 100, 200):
        assert [m for m in received if base <= m < base + 50] == list(range(base, base + 50))


@pytest.mark.realtime
def test_arun_beside_a_web_server(make, loop):
    """Real web-framework composition: a handler reads and commands the running robot."""

    async def main():
        sched = make(tick_rate=100)
        sched.add(
            Node(
                "motor",
                lambda n: n.send("speed", n.latest("cmd")),
                rate=100,
                subs=["cmd"],
                pubs=["speed"],
            )
        )
        sched.publish("cmd", 0.0)

        async def command(request):
            sched.publish("cmd", float(request.query["speed"]))
            return web.json_response({"nodes": sched.get_node_names()})

        app = web.Application()
        app.router.add_get("/", command)
        server = web.AppRunner(app)
        await server.setup()
        await web.TCPSite(server, "127.0.0.1", 0).start()
        url = f"http://127.0.0.1:{server.addresses[0][1]}/?speed=1.5"
        speeds = sched.subscribe("speed")
        async with sched:
            await until(lambda: all_have_ticked(sched))
            async with aiohttp.ClientSession() as session, session.get(url) as response:
                nodes = (await response.json())["nodes"]
            async with asyncio.timeout(10.0):
                async for speed in speeds:
                    if speed == 1.5:
                        break
        await server.cleanup()
        return nodes

    assert run_async(main(), loop) == ["motor"]
