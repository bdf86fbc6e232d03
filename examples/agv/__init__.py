"""Parts of the warehouse AGV.

`layout`, `world`, `sensors`, `grid`, `planner`, `safety`, `drive`, `fleet` and `picture` know
nothing of the scheduler: each can be used, and tested, on its own. `messages`, `devices` and
`telemetry` make nodes of them, together with ``warehouse_agv.py``.
"""
