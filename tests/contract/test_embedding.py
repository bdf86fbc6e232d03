"""Embedding: the nodes run inside an application, which waits for them and talks to them."""

from __future__ import annotations

import asyncio
import threading

import anyio
import pytest
import trio

from horus import Node, NodeError, Scheduler, StateError, UnknownNodeError

from .helpers import KINDS, TRIGGER, node_of, nothing, run_async, until

pytestmark = [pytest.mark.realtime, pytest.mark.usefixtures("leaves_nothing_behind")]


def robot(make, journal):
    """Return a scheduler with a node of every class; their shutdowns go to the journal."""
    sched = make()
    for kind in KINDS:
        sched.add(node_of(kind, kind, shutdown=lambda node: journal.append(node.name)))
    return sched


# -- waiting ------------------------------------------------------------------------


def test_started_returns_when_every_node_is_initialised(make, loop):
    """Whoever waits finds all of them running, on whatever loop."""
    sched = make()
    done = []

    async def slow_init(node):
        await asyncio.sleep(0.05)
        done.append(node.name)

    async def tick(node):
        pass

    sched.add(Node("slow", tick, init=slow_init))
    sched.add(Node("motor", nothing, rate=100, init=lambda node: done.append(node.name)))

    async def main():
        async with sched:
            await sched.started()
            assert sorted(done) == ["motor", "slow"]
            assert {info["state"] for info in sched.get_all_nodes()} == {"running"}
            await sched.started()  # at once, as it has

    run_async(main(), loop)


def test_started_waits_for_a_run_that_has_not_begun(make, loop):
    """A task that was created a line before has not run yet."""
    sched = make().add(Node("motor", nothing, rate=100))

    async def main():
        waiter = asyncio.create_task(sched.started())
        await asyncio.sleep(0.05)
        assert not waiter.done()
        run = asyncio.create_task(sched.arun(duration=0.2))
        await waiter
        assert sched.is_running()
        await run

    run_async(main(), loop)


def test_started_says_when_the_run_ended_before(make, loop):
    """Instead of waiting for ever."""
    sched = make()
    sched.add(Node("motor", nothing, rate=100, init=lambda node: node.request_stop("no power")))

    async def main():
        async with sched:
            with pytest.raises(StateError, match=r"ended before its nodes could tick: no power"):
                await sched.started()

    run_async(main(), loop)


def test_wait_node_returns_when_it_has_ticked_that_often(make, loop):
    """Ticks in all, as in `total_ticks`; once if nothing else is said."""
    sched = make().add(Node("motor", nothing, rate=200))

    async def main():
        async with sched:
            await sched.wait_node("motor")
            await sched.wait_node("motor", ticks=10)
            assert sched.get_node_stats("motor")["total_ticks"] >= 10

    run_async(main(), loop)


def test_wait_node_says_when_it_would_wait_for_ever(make, loop):
    """An unknown node, one whose init() has failed, one that goes, a run that ends."""
    sched = make()

    def fail(node):
        raise OSError("no such port")

    sched.add(Node("broken", nothing, rate=100, init=fail))
    sched.add(Node("motor", nothing, rate=100))
    sched.add(Node("camera", nothing, rate=100))

    async def main():
        async with sched:
            with pytest.raises(UnknownNodeError, match="moter"):
                await sched.wait_node("moter")
            with pytest.raises(StateError, match=r"'broken' does not tick: its init\(\) failed"):
                await sched.wait_node("broken")
            asyncio.get_running_loop().call_later(0.05, sched.remove_node, "camera")
            with pytest.raises(UnknownNodeError, match="camera"):
                await sched.wait_node("camera", ticks=10**9)
            asyncio.get_running_loop().call_later(0.05, sched.stop, "enough")
            with pytest.raises(
                StateError, match=r"before node 'motor' had ticked 10\d+ times: eno"
            ):
                await sched.wait_node("motor", ticks=10**9)

    run_async(main(), loop)


@pytest.mark.parametrize("ticks", [0, -1, 1.5, "ten", True])
def test_wait_node_refuses_other_counts(make, ticks):
    """Before anything is waited for."""
    sched = make().add(Node("motor", nothing))
    with pytest.raises(ValueError, match="ticks"):
        asyncio.run(sched.wait_node("motor", ticks=ticks))


# -- asking ----------------------------------------------------------------------------


def answering(kind="Event"):
    """Return a node that adds two numbers."""

    def add(node):
        numbers = node.recv("sum.request")
        if numbers is not None:
            node.send("sum", sum(numbers))

    return Node("adder", add, on="sum.request", pubs="sum")


def test_request_returns_the_answer(make, loop):
    """A message out, the first one on the reply topic back."""
    sched = make().add(answering())

    async def main():
        async with sched:
            await sched.started()
            assert await sched.request("sum.request", [1, 2], reply="sum", timeout=5.0) == 3
            assert await sched.request("sum.request", [3, 4], reply="sum") == 7

    run_async(main(), loop)


def test_request_gives_up_in_time(make, loop):
    """The error names the topic and the time, and nothing listens any more."""
    sched = make().add(Node("deaf", nothing, subs="sum.request", pubs="sum"))

    async def main():
        async with sched:
            with pytest.raises(TimeoutError, match=r"no answer on topic 'sum' in 0.05 s"):
                await sched.request("sum.request", [1], reply="sum", timeout=0.05)
            asyncio.get_running_loop().call_later(0.05, sched.stop)
            with pytest.raises(StateError, match="ended before there was an answer on topic 'sum'"):
                await sched.request("sum.request", [1], reply="sum")

    run_async(main(), loop)
    (topic,) = (each for each in sched._bus.topics() if each.name == "sum")
    assert topic.subscriptions == ()


@pytest.mark.parametrize("timeout", [0, -1.0, float("nan"), "soon"])
def test_request_refuses_other_timeouts(make, timeout):
    """Before anything is sent."""
    sched = make().add(answering())
    with pytest.raises(ValueError, match="timeout"):
        asyncio.run(sched.request("sum.request", [1], reply="sum", timeout=timeout))
    assert sched._bus.topic("sum.request").sent == 0


# -- ways to embed ------------------------------------------------------------------------


def test_in_the_background_of_a_block(make, loop):
    """`async with` starts it and stops it, and the nodes are shut down in order."""
    journal = []
    sched = robot(make, journal)

    async def main():
        async with sched:
            await sched.started()
            sched.publish(TRIGGER, 1)
            for kind in KINDS:
                await sched.wait_node(kind)
        assert sched.status() == "stopped"

    run_async(main(), loop)
    assert journal == list(reversed(KINDS))


@pytest.mark.parametrize("backend_options", [{}, {"use_uvloop": True}], ids=["asyncio", "uvloop"])
def test_in_an_anyio_task_group(make, backend_options):
    """Under `anyio.run`, cancelled with its group."""
    journal = []
    sched = robot(make, journal)

    async def main():
        async with anyio.create_task_group() as group:
            group.start_soon(sched.arun)
            await sched.started()
            with anyio.fail_after(10):
                await sched.wait_node("Rt", ticks=5)
            group.cancel_scope.cancel()

    anyio.run(main, backend_options=backend_options)
    assert journal == list(reversed(KINDS))


def test_under_an_anyio_cancel_scope(make):
    """A deadline around it ends the run in order."""
    journal = []
    sched = robot(make, journal)

    async def main():
        with anyio.move_on_after(0.2) as scope:
            await sched.arun()
        assert scope.cancelled_caught

    anyio.run(main)
    assert journal == list(reversed(KINDS))


def test_under_trio_it_says_what_it_needs(make):
    """Not an obscure error from within."""
    sched = make().add(Node("motor", nothing))

    with pytest.raises(StateError, match="trio"):
        trio.run(sched.arun)


def test_two_schedulers_on_one_loop(make, loop):
    """Each with its own nodes, topics and end."""
    journals = [], []
    first, second = (robot(make, journal) for journal in journals)

    async def main():
        async with first:
            async with second:
                await asyncio.gather(first.started(), second.started())
                await asyncio.gather(*(s.wait_node("Rt", ticks=5) for s in (first, second)))
            assert first.is_running()
            before = first.get_node_stats("Rt")["total_ticks"]
            await first.wait_node("Rt", ticks=before + 5)

    run_async(main(), loop)
    assert journals == (list(reversed(KINDS)), list(reversed(KINDS)))


def test_on_a_loop_in_another_thread(make, loop):
    """An application may have its event loop wherever it likes, and wait on another."""
    journal = []
    sched = robot(make, journal)
    stop = threading.Event()

    async def serve():
        async with sched:
            await until(stop.is_set)

    thread = threading.Thread(target=run_async, args=(serve(), loop))
    thread.start()

    async def main():
        await sched.started()
        await sched.wait_node("BestEffort", ticks=2)

    asyncio.run(main())
    stop.set()
    thread.join()
    assert journal == list(reversed(KINDS))


# -- how the application may fail -------------------------------------------------------------


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_error_in_the_block_shuts_the_nodes_down(make, loop, error):
    """And goes on, whatever it is."""
    journal = []
    sched = robot(make, journal)

    async def main():
        async with sched:
            await sched.started()
            raise error("application")

    with pytest.raises(error, match="application"):
        run_async(main(), loop)
    assert journal == list(reversed(KINDS))


def test_cancelling_the_application_shuts_the_nodes_down(make, loop):
    """Also when the cancellation comes twice, while they are shut down."""
    journal = []
    sched = robot(make, journal)

    async def main():
        async with sched:
            await sched.started()
            await asyncio.sleep(60)

    async def cancel_it():
        task = asyncio.create_task(main())
        await sched.started()
        task.cancel()
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_async(cancel_it(), loop)
    assert journal == list(reversed(KINDS))


def test_a_fatal_node_ends_the_block_with_its_error(make, loop):
    """The application hears of it where it waits, and at the end of the block."""

    def fail(node):
        raise OSError("cable")

    sched = make().add(Node("motor", fail, rate=100, failure_policy="fatal"))

    async def main():
        async with sched:
            with pytest.raises(StateError, match="ended before"):
                await sched.wait_node("motor", ticks=10)

    with pytest.raises(NodeError, match="cable"):
        run_async(main(), loop)


def test_in_virtual_time_beside_the_application(make, loop):
    """A deterministic scheduler runs at full speed, on a thread, and can be waited for."""
    sched = Scheduler(deterministic=True).add(Node("motor", nothing, rate=100))

    async def main():
        async with sched:
            await sched.started()
            await sched.wait_node("motor", ticks=1000)

    run_async(main(), loop)


def test_the_newest_message_of_a_stream_can_be_asked_for_again(make):
    """It stays, received or not, for the next request of a web server."""
    sched = make()
    stream = sched.subscribe("pose", capacity=2)
    assert stream.latest() is None
    for message in ([1], [2], [3]):
        sched.publish("pose", message)
    stream.latest().append("mine alone")
    assert [stream.latest(), stream.recv(), stream.recv(), stream.recv()] == [[3], [2], [3], None]
    assert stream.latest() == [3]
    stream.close()


def test_what_a_stream_has_dropped_is_counted_when_it_is_gone(make):
    """A counter that fell would look like a restart."""
    sched = make()
    stream = sched.subscribe("pose", capacity=1)
    for number in range(5):
        sched.publish("pose", number)
    lines = [line for line in sched.metrics_text().splitlines() if "topic_dropped_total{" in line]
    assert [line.split()[-1] for line in lines] == ["4.0"]
    stream.close()
    stream.close()
    assert all(line in sched.metrics_text().splitlines() for line in lines)
