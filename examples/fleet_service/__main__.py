"""Serve the cart: `python examples/fleet_service [--port 8080]`, end with Ctrl+C or SIGTERM."""

from __future__ import annotations

import argparse
import logging

from aiohttp import web

from cart import make_cart
from service import make_app


def main() -> None:
    """Serve until stopped."""
    parser = argparse.ArgumentParser(
        prog="fleet_service", description="A cart with an HTTP interface, in one process."
    )
    parser.add_argument("--host", default="127.0.0.1", help="default 127.0.0.1")
    parser.add_argument("--port", type=int, default=8080, help="default 8080; 0 takes a free one")
    options = parser.parse_args()
    logging.basicConfig(
        level=logging.INFO, format="%(asctime)s %(levelname)-8s %(name)s: %(message)s"
    )
    # aiohttp turns SIGTERM and Ctrl+C into the end of the server; the nodes go with it.
    web.run_app(make_app(make_cart()), host=options.host, port=options.port, shutdown_timeout=5.0)


if __name__ == "__main__":
    main()
