"""Messages between a scheduler and a worker."""

from __future__ import annotations

import gc
import os
import resource
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from horus.workers.channel import LARGE, Channel
from horus.workers.pickling import dumps, loads

Pair = tuple[Channel, Channel]


def open_pair() -> Pair:
    """Return two ends that are connected."""
    ours, theirs = socket.socketpair()
    return Channel(ours, dumps, loads), Channel(theirs, dumps, loads)


@pytest.fixture
def pair() -> Iterator[Pair]:
    """Two ends that are connected, and closed in the end."""
    ends = open_pair()
    yield ends
    for end in ends:
        end.close()


def pass_on(pair: Pair, message: Any) -> Any:
    """Send a message, however long, and return what arrives."""
    sender = threading.Thread(target=pair[0].send, args=(message,))
    sender.start()
    arrived = pair[1].receive()
    sender.join()
    return arrived


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary(max_size=3 * LARGE),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(), inner, max_size=5),
    max_leaves=10,
)


@given(plain)
def test_what_is_sent_arrives(message: Any) -> None:
    """Small and large, whatever the shape."""
    pair = open_pair()
    try:
        assert pass_on(pair, message) == message
    finally:
        for end in pair:
            end.close()


@given(st.lists(st.integers(0, 3 * LARGE), max_size=6), st.sampled_from("Bdf"))
def test_arrays_of_any_size_arrive_aligned_and_read_only(sizes: list[int], kind: str) -> None:
    """Each where it lies in the segment, at an address that fits its type."""
    pair = open_pair()
    try:
        sent = [np.arange(size // 8, dtype=kind) for size in sizes]
        arrived = pass_on(pair, sent)
        assert all(np.array_equal(one, other) for one, other in zip(sent, arrived, strict=True))
        assert all(one.flags.aligned for one in arrived)
        if sum(one.nbytes for one in sent) > 2 * LARGE:
            assert not any(one.flags.writeable for one in arrived)
        del arrived
    finally:
        for end in pair:
            end.close()


def test_more_arrays_than_the_kernel_takes_buffers(pair: Pair) -> None:
    """They are joined."""
    sent = [np.full(100, number) for number in range(3000)]
    assert [int(one[0]) for one in pass_on(pair, sent)] == list(range(3000))


def test_a_segment_is_used_again_when_nobody_looks_any_more(pair: Pair) -> None:
    """As long as somebody does, what he sees does not change."""
    first = pass_on(pair, np.full(LARGE, 1, np.uint8))
    second = pass_on(pair, np.full(LARGE, 2, np.uint8))
    part = first[10:20]
    del first, second
    gc.collect()
    before = len(os.listdir("/proc/self/fd"))
    for number in range(3, 50):
        pass_on((pair[1], pair[0]), None)  # tells what has been given back
        assert pass_on(pair, np.full(LARGE, number, np.uint8))[0] == number
    assert len(os.listdir("/proc/self/fd")) <= before + 2
    assert part.tolist() == [1] * 10


def test_what_is_kept_costs_no_descriptors(pair: Pair) -> None:
    """A node may keep hundreds of images."""
    before = len(os.listdir("/proc/self/fd"))
    kept = [pass_on(pair, np.full(LARGE, number % 250, np.uint8)) for number in range(300)]
    assert len(os.listdir("/proc/self/fd")) <= before + 20
    assert all(image[-1] == number % 250 for number, image in enumerate(kept))


def test_where_no_segments_can_be_had_messages_go_by_socket(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Out of descriptors or of memory, or on another platform."""

    def refuse(name: str, flags: int) -> int:
        raise OSError("no more descriptors")

    monkeypatch.setattr(os, "memfd_create", refuse)
    image = np.arange(10 * LARGE)
    assert np.array_equal(pass_on(pair, image), image)


def test_out_of_descriptors_where_a_segment_arrives(pair: Pair) -> None:
    """The message is lost, and named; the segment goes back, and the next message arrives."""
    image = np.arange(10 * LARGE)
    pair[0].send(image)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (pair[0].fileno(), hard))
    try:
        with pytest.raises(Exception, match="Too many open files") as failure:
            pair[1].receive()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert not isinstance(failure.value, OSError)
    pair[1].send("given back")
    assert pair[0].receive() == "given back"
    before = len(os.listdir("/proc/self/fd"))
    assert np.array_equal(pass_on(pair, image), image)
    assert len(os.listdir("/proc/self/fd")) == before


def test_small_and_large_messages_that_wait_arrive_in_order(pair: Pair) -> None:
    """However many were sent before the first is received."""
    sent = [number if number % 3 else np.full(LARGE, number) for number in range(12)]
    for message in sent:
        pair[0].send(message)
    for number in range(12):
        assert np.max(pair[1].receive()) == number


def test_two_threads_that_send_while_a_third_receives(pair: Pair) -> None:
    """What each has sent arrives whole, and in its order."""

    def talk(name: str) -> None:
        for number in range(200):
            pair[0].send((name, number, np.full(LARGE if number % 10 == 0 else 10, number)))
            pair[0].receive()

    def answer() -> None:
        for _ in range(400):
            name, number, content = pair[1].receive()
            arrived[name].append(number)
            assert np.all(content == number)
            del content
            pair[1].send(None)

    arrived: dict[str, list[int]] = {"one": [], "other": []}
    threads = [threading.Thread(target=talk, args=(name,)) for name in arrived]
    threads.append(threading.Thread(target=answer))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert arrived == {"one": list(range(200)), "other": list(range(200))}


def test_out_of_memory_in_the_middle(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """What has been written is given up, and the message goes by socket."""

    def refuse(descriptor: int, parts: Any, offset: int) -> int:
        raise OSError("no memory")

    before = len(os.listdir("/proc/self/fd"))
    monkeypatch.setattr(os, "pwritev", refuse)
    image = np.arange(10 * LARGE)
    assert np.array_equal(pass_on(pair, image), image)
    assert len(os.listdir("/proc/self/fd")) == before


def test_the_other_end_is_gone(pair: Pair) -> None:
    """Who receives hears it, who sends too."""
    pair[1].close()
    with pytest.raises(EOFError):
        pair[0].receive()
    with pytest.raises(BrokenPipeError):
        pair[0].send("anybody there?")


@pytest.mark.parametrize("doing", ["send", "receive"])
def test_hanging_up_on_who_is_in_the_middle(doing: str) -> None:
    """Who waits hears it at once; descriptors are given back when nobody uses them any more."""
    before = len(os.listdir("/proc/self/fd"))
    pair = open_pair()
    ended: list[BaseException] = []

    def wait() -> None:
        try:
            while True:  # until the socket takes no more; or at once
                if doing == "send":
                    pair[0].send(bytes(LARGE - 1000))
                else:
                    pair[0].receive()
        except (EOFError, OSError) as exc:
            ended.append(exc)

    thread = threading.Thread(target=wait)
    thread.start()
    time.sleep(0.05)
    pair[0].close()
    thread.join(5.0)
    assert not thread.is_alive()
    assert isinstance(ended[0], BrokenPipeError if doing == "send" else EOFError)
    pair[1].close()
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_channel_that_is_closed_says_so(pair: Pair) -> None:
    """Its descriptor may be another file's by now."""
    pair[0].close()
    pair[0].close()
    with pytest.raises(BrokenPipeError):
        pair[0].send("anybody there?")
    with pytest.raises(EOFError):
        pair[0].receive()


class Unreadable:
    """Its own code fails with what could be mistaken for a lost connection."""

    def __init__(self, *, at: str) -> None:
        self.at = at

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        if self.at == "sending":
            raise OSError("disk on fire")
        return (_fail, ())


def _fail() -> None:
    raise EOFError("end of my file")


def test_errors_of_a_message_are_not_mistaken_for_a_lost_connection(pair: Pair) -> None:
    """Neither when it is packed nor when it is unpacked; the next message goes through."""
    with pytest.raises(Exception, match="disk on fire") as sending:
        pair[0].send(Unreadable(at="sending"))
    assert not isinstance(sending.value, OSError)
    pair[0].send(Unreadable(at="receiving"))
    with pytest.raises(Exception, match="end of my file") as receiving:
        pair[1].receive()
    assert not isinstance(receiving.value, EOFError)
    pair[0].send("next")
    assert pair[1].receive() == "next"
