"""Telemetry: metrics go where they are wanted; where they cannot go costs the schedule nothing."""

from __future__ import annotations

import asyncio
import contextlib
import http.server
import json
import re
import socket
import threading
import time
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from horus import Node, Scheduler
from horus.errors import ConfigError
from horus.observe import telemetry as module

from .helpers import nothing


def free_port():
    """Return a port of loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Collector(http.server.ThreadingHTTPServer):
    """Takes what is POSTed to it."""

    daemon_threads = True

    def __init__(self, port=0, status=200, delay_s=0.0):
        self.got = []
        self.paths = []
        self.over = threading.Event()
        collector = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                collector.paths.append(self.path)
                collector.got.append(json.loads(body))
                collector.over.wait(delay_s)
                with contextlib.suppress(OSError):
                    self.send_response(status)
                    self.end_headers()

            def log_message(self, *args):
                pass

        super().__init__(("127.0.0.1", port), Handler)


@contextlib.contextmanager
def serving(**options):
    """Serve a collector in the block."""
    with Collector(**options) as collector:
        thread = threading.Thread(target=collector.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield collector
        finally:
            collector.over.set()
            collector.shutdown()
            thread.join()


def make(telemetry, **options):
    """Return a scheduler with a node that sends, and one that fails now and then."""
    sched = Scheduler(tick_rate=100, telemetry=telemetry, name="rover", **options)
    sched.add(Node("lidar", lambda node: node.send("scan", 1), rate=100, pubs=["scan"]))
    sched.add(Node("arm", nothing, on="scan"))
    return sched


@pytest.fixture
def often(monkeypatch):
    """Export five times a second."""
    monkeypatch.setattr(module, "PERIOD_S", 0.2)


def test_snapshots_are_posted_every_second():
    """http://: a JSON snapshot at once, every second, and at the end."""
    with serving() as collector:
        make(f"http://127.0.0.1:{collector.server_port}/in").run(duration=2.5)
    assert 3 <= len(collector.got) <= 5
    assert set(collector.paths) == {"/in"}
    last = collector.got[-1]
    assert last["scheduler"] == "rover"
    assert abs(last["timestamp"] - time.time()) < 60
    assert 2.0 <= last["uptime"] <= 10.0
    nodes = {node["name"]: node for node in last["nodes"]}
    assert nodes["lidar"]["total_ticks"] >= 150
    assert nodes["arm"]["healthy"] == 1
    (topic,) = last["topics"]
    assert topic["topic"] == "scan"
    assert topic["sent"] >= 150
    assert (topic["publishers"], topic["subscribers"]) == (["lidar"], ["arm"])
    assert last["safe_state_reason"] is None
    times = [snapshot["timestamp"] for snapshot in collector.got]
    assert times == sorted(times)


def test_otlp_is_posted_as_its_json_encoding_says():
    """otlp+http://: to /v1/metrics; sums are cumulative, numbers of 64 bits are strings."""
    with serving() as collector:
        make(f"otlp+http://127.0.0.1:{collector.server_port}").run(duration=0.5)
    assert set(collector.paths) == {"/v1/metrics"}
    (resource,) = collector.got[-1]["resourceMetrics"]
    assert {
        "key": "service.name",
        "value": {"stringValue": "rover"},
    } in resource["resource"]["attributes"]
    metrics = {metric["name"]: metric for metric in resource["scopeMetrics"][0]["metrics"]}
    ticks = metrics["horus.node.ticks"]["sum"]
    assert (ticks["aggregationTemporality"], ticks["isMonotonic"]) == (2, True)
    point = next(
        point
        for point in ticks["dataPoints"]
        if point["attributes"] == [{"key": "horus.node", "value": {"stringValue": "lidar"}}]
    )
    assert point["asDouble"] >= 20
    assert re.fullmatch(r"\d{19}", point["timeUnixNano"])
    assert int(point["startTimeUnixNano"]) <= int(point["timeUnixNano"])
    assert metrics["horus.node.rate"]["gauge"]["dataPoints"]
    assert metrics["horus.node.rate"]["unit"] == "Hz"


def test_otlp_agrees_with_the_published_messages():
    """What is sent parses as the protocol's own request, without unknown fields."""
    service = pytest.importorskip("opentelemetry.proto.collector.metrics.v1.metrics_service_pb2")
    from google.protobuf import json_format

    from horus.observe.metrics import otlp

    sched = make(None, deterministic=True)
    sched.tick_for(0.1)
    content = otlp(sched._session.metrics().snapshot(), 1)
    request = json_format.ParseDict(content, service.ExportMetricsServiceRequest())
    assert len(request.resource_metrics[0].scope_metrics[0].metrics) > 15
    sched.stop()


def test_prometheus_is_served():
    """prometheus://: /metrics on loopback, in the text format."""
    port = free_port()
    sched = make(f"prometheus://:{port}")
    texts = []

    def scrape(node):
        if not texts and sched.get_node_stats("lidar")["total_ticks"] > 20:
            url = f"http://127.0.0.1:{port}/metrics"
            with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=5) as page:
                texts.append(page.read().decode())
                node.request_stop()

    sched.add(Node("scrape", scrape, rate=5, compute=True))
    sched.run(duration=10.0)
    families = {family.name: family for family in text_string_to_metric_families(texts[0])}
    (sample,) = (
        sample
        for sample in families["horus_node_ticks"].samples
        if sample.labels == {"scheduler": "rover", "node": "lidar"}
    )
    assert sample.name == "horus_node_ticks_total"
    assert sample.value > 20
    assert families["horus_topic_messages"].samples[0].labels["topic"] == "scan"
    assert families["horus_uptime_seconds"].type == "gauge"
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5)


def test_a_port_that_is_taken_leaves_the_robot_running(caplog):
    """It is told once."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        sched = make(f"prometheus://127.0.0.1:{taken.getsockname()[1]}")
        sched.run(duration=0.5)
    assert sched.get_node_stats("lidar")["total_ticks"] >= 20
    assert len([r for r in caplog.records if "robot runs on" in r.getMessage()]) == 1


def test_json_lines_are_appended(often, tmp_path):
    """file://: one object a line; what was there stays."""
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"old": 1}\n')
    make(f"file://{path}").run(duration=0.5)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[0] == {"old": 1}
    assert len(lines) >= 3
    assert lines[-1]["scheduler"] == "rover"


def test_a_file_that_cannot_be_written_leaves_the_robot_running(often, tmp_path, caplog):
    """It is told once, and once more when it works again."""
    directory = tmp_path / "later"
    sched = make(f"file://{directory}/m.jsonl")

    def mend(node):
        if sched.get_node_stats("lidar")["total_ticks"] >= 50:
            directory.mkdir(exist_ok=True)

    sched.add(Node("mend", mend, rate=100, order=200))
    sched.run(duration=1.0)
    told = [r.getMessage() for r in caplog.records if "telemetry to" in r.getMessage()]
    assert len(told) == 2
    assert "No such file" in told[0]
    assert re.search(r"works again; [1-9] snapshots were lost", told[1])
    assert (directory / "m.jsonl").read_text()


@pytest.mark.parametrize("scheme", ["http", "otlp+http"])
def test_a_dead_endpoint_costs_the_schedule_nothing(scheme, often, caplog):
    """Nobody listens: told once, and every tick is there."""
    sched = make(f"{scheme}://127.0.0.1:{free_port()}/x")
    began = time.monotonic()
    sched.run(duration=0.8)
    assert time.monotonic() - began < 4.0
    assert sched.get_node_stats("lidar")["total_ticks"] >= 60
    assert len([r for r in caplog.records if "robot runs on" in r.getMessage()]) == 1


def test_a_slow_endpoint_costs_the_schedule_nothing(often):
    """Snapshots that find the one before still on its way are dropped, and the end is bounded."""
    with serving(delay_s=30) as collector:
        sched = make(f"http://127.0.0.1:{collector.server_port}/x")
        began = time.monotonic()
        sched.run(duration=0.8)
        assert time.monotonic() - began < 5.0
    assert sched.get_node_stats("lidar")["total_ticks"] >= 60
    assert 1 <= len(collector.got) <= 2


def test_an_endpoint_that_refuses_and_recovers(often, caplog):
    """A 503 counts as failure; the endpoint is tried again in the next period."""
    port = free_port()
    sched = make(f"http://127.0.0.1:{port}/x")

    async def main():
        with contextlib.ExitStack() as servers:
            servers.enter_context(serving(port=port, status=503))
            async with sched:
                await asyncio.sleep(0.4)
                servers.close()
                healthy = servers.enter_context(serving(port=port))
                await asyncio.sleep(0.8)
                return list(healthy.got)

    assert asyncio.run(main())
    told = [r.getMessage() for r in caplog.records if "telemetry to" in r.getMessage()]
    assert "503" in told[0]
    assert "works again" in told[1]


def test_metrics_text_is_for_endpoints_of_ones_own():
    """The same text, without telemetry=; also while nothing runs."""
    sched = make(None, deterministic=True)
    assert 'horus_node_ticks_total{node="lidar",scheduler="rover"} 0.0' in sched.metrics_text()
    sched.tick_for(0.1)
    assert 'horus_node_ticks_total{node="lidar",scheduler="rover"} 10.0' in sched.metrics_text()
    assert "horus_cycles_total" in sched.metrics_text()
    sched.stop()


@pytest.mark.parametrize(
    "telemetry",
    [
        "ftp://127.0.0.1/x",
        "127.0.0.1:4318",
        "udp://127.0.0.1:1",
        "http://",
        "otlp+http://",
        "otlp://127.0.0.1",
        "http://127.0.0.1:99999/",
        "http://[::1/x",
        "prometheus://127.0.0.1:9464/other",
        "file://relative/path",
        "file:///directory/",
        "http://127.0.0.1/\0",
        "http://127.0.0.1/\n",
    ],
)
def test_endpoints_that_make_no_sense_are_refused_at_construction(telemetry):
    """With the schemes there are."""
    with pytest.raises(ConfigError, match="telemetry"):
        Scheduler(telemetry=telemetry)


def test_a_password_is_not_logged(caplog):
    """What is told of an endpoint does not give it away."""
    make(f"http://me:secret@127.0.0.1:{free_port()}/x").run(duration=0.2)
    assert "me:***@127.0.0.1" in caplog.text
    assert "secret" not in caplog.text


@pytest.mark.parametrize(
    "telemetry",
    [
        "mqtt://me:secret@host",
        "http://me:secret@host:99999/",
        "http://me:secret@[host/",
        "file://me:secret@host/x",
        "prometheus://me:secret@host/x",
    ],
)
def test_a_password_is_not_in_the_error(telemetry):
    """Errors of a configuration end up in logs, too."""
    with pytest.raises(ConfigError) as caught:
        Scheduler(telemetry=telemetry)
    assert "secret" not in str(caught.value)
