"""Where telemetry goes: the endpoint URL of `Scheduler(telemetry=)`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from horus.errors import ConfigError

_PROMETHEUS_PORT = 9464
"""Of exporters in a process, by OpenTelemetry's convention."""


class Kind(StrEnum):
    """What is done with the metrics."""

    PUSH = "push"
    """POST a JSON snapshot every second."""
    OTLP = "otlp"
    """POST OTLP/JSON every second."""
    SCRAPE = "scrape"
    """Serve them to Prometheus."""
    APPEND = "append"
    """Append a JSON line to a file every second."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A telemetry endpoint."""

    text: str
    """As it was given, without a password."""
    kind: Kind
    url: str = ""
    """Where to POST to."""
    host: str = ""
    port: int = 0
    path: Path | None = None
    """The file."""


def parse_endpoint(value: object) -> Endpoint | None:
    """Return the endpoint of a URL; None for None.

    Raises:
        ConfigError: It is no URL, or of a scheme that is not known.
    """
    if value is None:
        return None
    from urllib.parse import urlsplit  # only who wants telemetry waits for it

    if not isinstance(value, str) or not value or not value.isprintable():
        raise ConfigError("telemetry", value, f"must be a URL: {_SCHEMES}")
    shown = value.rpartition("@")[2]  # messages end up in logs
    try:
        url = urlsplit(value)
        shown = value.replace(f":{url.password}@", ":***@") if url.password else value
        port = url.port
    except ValueError as exc:
        raise ConfigError("telemetry", shown, f"is no URL: {exc}") from exc
    scheme = url.scheme.lower()
    if scheme in ("http", "https", "otlp+http", "otlp+https"):
        if not url.hostname:
            raise ConfigError("telemetry", shown, "names no host")
        target = value[len(scheme) - len(scheme.removeprefix("otlp+")) :]
        if scheme in ("http", "https"):
            return Endpoint(shown, Kind.PUSH, url=target)
        if url.path in ("", "/"):
            target = target.rstrip("/") + "/v1/metrics"
        return Endpoint(shown, Kind.OTLP, url=target)
    if scheme == "prometheus":
        if url.path not in ("", "/", "/metrics"):
            raise ConfigError("telemetry", shown, "serves /metrics; leave the path out")
        listen = _PROMETHEUS_PORT if port is None else port
        return Endpoint(shown, Kind.SCRAPE, host=url.hostname or "127.0.0.1", port=listen)
    if scheme == "file":
        if url.netloc or not url.path.startswith("/") or url.path.endswith("/"):
            raise ConfigError("telemetry", shown, "must be file:///an/absolute/path.jsonl")
        return Endpoint(shown, Kind.APPEND, path=Path(url.path))
    raise ConfigError("telemetry", shown, f"is of a scheme that is not known: {_SCHEMES}")


_SCHEMES = (
    "http(s)://host/path, otlp+http(s)://host:4318, prometheus://host:port or file:///path.jsonl"
)
