"""Take what is POSTed to 127.0.0.1, and count it.

``python -P sink.py`` prints the port it listens on, serves until its standard input is closed, and
prints how many JSON objects it was sent.
"""

from __future__ import annotations

import http.server
import json
import sys
import threading

HOST = "127.0.0.1"


class Handler(http.server.BaseHTTPRequestHandler):
    """Answers requests of one connection."""

    protocol_version = "HTTP/1.1"
    received = 0
    """JSON objects of all connections, of which there is one at a time."""

    def do_POST(self) -> None:
        """Take a JSON object."""
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        Handler.received += isinstance(body, dict)
        self.send_response(200)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_arguments: object) -> None:
        """Say nothing: standard error is the benchmark's."""


def main() -> None:
    """Serve until nobody is left who could tell to stop."""
    server = http.server.ThreadingHTTPServer((HOST, 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    print(server.server_port, flush=True)
    sys.stdin.read()
    server.shutdown()
    print(Handler.received, flush=True)


if __name__ == "__main__":
    main()
