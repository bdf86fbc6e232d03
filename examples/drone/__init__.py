"""Parts of the drone flight controller.

`airframe`, `world`, `sensors`, `estimation`, `control`, `course`, `failsafe`, `flight_log` and
`picture` know nothing of the scheduler: each can be used, and tested, on its own. `messages`,
`devices` and `guidance` make nodes of them, together with ``drone_flight_controller.py``.
"""
