"""Ask the scheduler about itself and its nodes.

Prints:
    idle: tick 0, running False, name agv
    3 nodes: ['sensor', 'motor', 'planner'], has motor: True
    sensor: order=0, state=uninitialized
    motor: order=20, state=uninitialized
    planner: order=50, state=uninitialized
    inside a tick: running, running True
    the motor's order is 20
    stopped: tick ..., running False
"""

from __future__ import annotations

from horus import Node, Scheduler

sched = Scheduler(tick_rate=100, name="agv")
answers: list[str] = []


def read() -> None:
    """Ask from inside a tick."""
    answers.append(f"inside a tick: {sched.status()}, running {sched.is_running()}")


if __name__ == "__main__":
    sched.add(Node(name="sensor", tick=read, rate=100, order=0))
    sched.add(Node(name="motor", tick=lambda: None, rate=100, order=20))
    sched.add(Node(name="planner", tick=lambda: None, rate=10, order=50, compute=True))
    print(
        f"{sched.status()}: tick {sched.current_tick()}, "
        f"running {sched.is_running()}, name {sched.scheduler_name()}"
    )
    names, has_motor = sched.get_node_names(), sched.has_node("motor")
    print(f"{sched.get_node_count()} nodes: {names}, has motor: {has_motor}")
    for info in sched.get_all_nodes():
        print(f"{info['name']}: order={info['order']}, state={info['state']}")
    sched.run(duration=0.2)
    print(answers[-1])
    print(f"the motor's order is {sched.get_node_info('motor')}")
    print(f"{sched.status()}: tick {sched.current_tick()}, running {sched.is_running()}")
