"""The warehouse: walls, racks, and the places where things happen [m].

One description feeds the physics model, the planner's static map and the picture, so that the
three can never disagree.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Rect:
    """An axis-aligned rectangle on the floor [m]."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float

    @property
    def center(self) -> tuple[float, float]:
        """Return the middle of the rectangle [m]."""
        return (self.x_min + self.x_max) / 2, (self.y_min + self.y_max) / 2

    @property
    def half_size(self) -> tuple[float, float]:
        """Return half the width and half the depth [m]."""
        return (self.x_max - self.x_min) / 2, (self.y_max - self.y_min) / 2

    @classmethod
    def around(cls, x: float, y: float, half_x: float, half_y: float) -> Rect:
        """Return the rectangle of that half size around a point."""
        return cls(x - half_x, y - half_y, x + half_x, y + half_y)


FLOOR = Rect(0.0, 0.0, 14.0, 9.2)
WALL_THICKNESS_M = 0.1

# Three aisles along x, a cross aisle at x = 7, open bays at both ends.
RACKS = (
    Rect(3.0, 0.0, 11.0, 0.8),
    Rect(3.0, 2.6, 6.2, 3.6),
    Rect(7.8, 2.6, 11.0, 3.6),
    Rect(3.0, 5.6, 6.2, 6.6),
    Rect(7.8, 5.6, 11.0, 6.6),
    Rect(3.0, 8.4, 11.0, 9.2),
)

START = (1.3, 4.6)
GOAL = (12.6, 6.3)

# The vehicle. The wheels and casters stay inside the chassis' footprint.
CHASSIS_HALF_LENGTH_M = 0.40
CHASSIS_HALF_WIDTH_M = 0.28
WHEEL_RADIUS_M = 0.10
HALF_TRACK_M = 0.24

# A loaded pallet stands outside until the vehicle's centre crosses DROP_TRIGGER_X_M; then it
# falls across the middle aisle, where the vehicle cannot pass it.
PALLET_HALF_M = (0.40, 0.60)
PALLET_PARKED = (-3.0, 4.6)
DROP_TRIGGER_X_M = 8.0
DROP_AT = (DROP_TRIGGER_X_M + CHASSIS_HALF_LENGTH_M + 1.15 + PALLET_HALF_M[0], 4.62)

# A carton on no map, too low for the LiDARs' scan plane: only the camera sees it.
CARTON_HALF_M = (0.20, 0.20)
CARTON_HEIGHT_M = 0.12
CARTON_AT = (9.4, 7.98)
