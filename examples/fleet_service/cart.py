"""The cart: drives back and forth along an aisle, and stops when told to."""

from __future__ import annotations

import math

from horus import Node, Scheduler, dt, ms

AISLE_M = 20.0
SPEED_MPS = 1.5
BRAKING_MPS2 = 4.0


class Drive(Node):
    """The motor and its odometry, 100 times a second."""

    def __init__(self) -> None:
        """Stand at the dock."""
        super().__init__(
            "drive", rate=100, order=10, subs=["emergency.stop"], pubs=["odom", "emergency.stopped"]
        )
        self.travelled_m = 0.0
        self.speed_mps = 0.0
        self.stopping = False

    def tick(self) -> None:
        """Follow the speed that is wanted, and tell where that leads."""
        if self.has_msg("emergency.stop"):
            stop = self.recv("emergency.stop")
            self.stopping = stop["engaged"]
            self.log_warning("emergency stop %s", "engaged" if self.stopping else "released")
        wanted_mps = 0.0 if self.stopping else SPEED_MPS
        step_mps = BRAKING_MPS2 * dt()
        self.speed_mps += max(-step_mps, min(step_mps, wanted_mps - self.speed_mps))
        self.travelled_m += self.speed_mps * dt()
        self.send("odom", {"x_m": self.position_m(), "speed_mps": self.speed_mps})
        if self.stopping and self.speed_mps == 0.0:
            self.send("emergency.stopped", {"x_m": self.position_m()})

    def position_m(self) -> float:
        """Return where along the aisle it is."""
        lap_m = math.fmod(self.travelled_m, 2 * AISLE_M)
        return lap_m if lap_m <= AISLE_M else 2 * AISLE_M - lap_m

    def enter_safe_state(self) -> None:
        """Cut the power."""
        self.speed_mps = 0.0

    def shutdown(self) -> None:
        """Leave with the brake on."""
        self.speed_mps = 0.0
        self.log_info("brake on at %.2f m", self.position_m())


def battery() -> Node:
    """Return a node that tells the battery's voltage once a second."""
    voltage = 25.2

    def tick(node: Node) -> None:
        nonlocal voltage
        voltage = max(22.0, voltage - 0.001)
        node.send("battery", {"voltage_v": round(voltage, 3)})

    return Node("battery", tick, rate=1, order=100, budget=5 * ms, pubs=["battery"])


def make_cart() -> Scheduler:
    """Return the cart, standing."""
    cart = Scheduler(name="cart", tick_rate=100, watchdog_ms=500)
    cart.add(Drive()).add(battery())
    cart.add_critical_node("drive", timeout_ms=200)
    return cart
