"""Ask for real-time scheduling and see what the machine granted.

Prints:
    ...
    RT scheduling: ...
    Memory locking: ...
    CPU isolation: ...
"""

from __future__ import annotations

from horus import Scheduler

if __name__ == "__main__":
    sched = Scheduler(tick_rate=1000, rt=True)
    if sched.has_full_rt():
        print("Full real-time capabilities active")
    else:
        print("Running with degraded RT")
        for degradation in sched.degradations():
            print(f"  Degradation: {degradation}")
    capabilities = sched.capabilities()
    print(f"RT scheduling: {capabilities['rt_scheduling']}")
    print(f"Memory locking: {capabilities['memory_locking']}")
    print(f"CPU isolation: {capabilities['cpu_isolation']}")
