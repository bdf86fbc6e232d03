"""What systemd is told: that the robot is ready, that it is alive, that it stops.

Source: sd_notify(3), sd_watchdog_enabled(3).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
from collections.abc import Callable

_log = logging.getLogger("horus.supervisor")


class Notifier:
    """Sends states to the socket that the service manager has named in the environment.

    Thread: any. Sending never blocks and never fails: a full or vanished socket loses
    the message.
    """

    def __init__(self, address: str, watchdog_s: float | None) -> None:
        """Send to `address`; the manager expects a sign of life every `watchdog_s` [s]."""
        # An abstract socket is written with an @ for its leading zero byte.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.watchdog_s = watchdog_s
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, state: str) -> None:
        """Send a state such as `READY=1`."""
        with contextlib.suppress(OSError):
            self._socket.sendto(state.encode(), self._address)

    async def keep_alive(self, is_healthy: Callable[[], bool]) -> None:
        """Send signs of life, twice as often as expected, for as long as all is well."""
        assert self.watchdog_s is not None
        while True:
            if is_healthy():
                self.send("WATCHDOG=1")
            await asyncio.sleep(self.watchdog_s / 2)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def find_notifier() -> Notifier | None:
    """Return a notifier if a service manager runs this process and wants to hear from it."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if address[:1] not in ("/", "@"):
        return None
    try:
        return Notifier(address, _watchdog_s())
    except OSError as exc:
        _log.warning("the service manager cannot be notified: %s", exc)
        return None


def _watchdog_s() -> float | None:
    """Return how often the manager expects a sign of life [s]; None for never."""
    interval_us, pid = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not interval_us.isdigit() or int(interval_us) == 0:
        return None
    meant = not pid or pid == str(os.getpid())
    return int(interval_us) / 1e6 if meant else None
