"""Give a node init and shutdown callbacks: each runs once, whatever ends the run.

Prints:
    [INFO] Connecting to motor controller...
    [INFO] Driving: 0.5
    [INFO] Stopping motor controller...
    init and shutdown sent {'state': 'ready'} and {'linear': 0.0, 'angular': 0.0}
"""

from __future__ import annotations

import logging
import sys

from horus import Node, Scheduler, ms


def setup_hardware(node: Node) -> None:
    """Connect; called once before the first tick."""
    node.log_info("Connecting to motor controller...")
    node.send("status", {"state": "ready"})


def control(node: Node) -> None:
    """Drive; called every tick."""
    if node.has_msg("cmd"):
        node.log_info(f"Driving: {node.recv('cmd')['linear']}")


def cleanup(node: Node) -> None:
    """Stop the wheels; called once, after the last tick."""
    node.log_info("Stopping motor controller...")
    node.send("stop", {"linear": 0.0, "angular": 0.0})


motor = Node(
    name="motor",
    init=setup_hardware,
    tick=control,
    shutdown=cleanup,
    rate=20,
    order=5,
    budget=20 * ms,
    subs=["cmd"],
    pubs=["status", "stop"],
)
witness = Node("witness", lambda: None, order=0, subs=["status", "stop"])

if __name__ == "__main__":
    logging.basicConfig(format="[%(levelname)s] %(message)s", stream=sys.stdout, level="INFO")
    logging.getLogger("horus.scheduler").setLevel("ERROR")
    sched = Scheduler(tick_rate=20)
    sched.add(motor).add(witness)
    sched.publish("cmd", {"linear": 0.5, "angular": 0.0})
    sched.run(duration=0.2)
    print(f"init and shutdown sent {witness.latest('status')} and {witness.latest('stop')}")
