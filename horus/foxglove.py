"""How viewers are to show the messages of a topic: declarations for `Pub(topic, foxglove=...)`.

A recording keeps every message exactly. A viewer such as Foxglove or Lichtblick draws only what
has one of its own schemas; a declaration says which of these the messages of a topic fill, and
with what:

    Pub("scan", foxglove=LaserScan(frame_id="laser", start_angle=-1.57, end_angle=1.57,
                                   ranges="ranges_m"))

Where a declaration takes a `Source`, a string is the path of a field within the message, such as
`"pose.x"` or `"corners.0"` (mapping keys, attributes and indexes; `""` is the message itself), a
callable is called with the message, and a number is that number in every message.

Conversion happens on the thread that writes the recording, never in a tick.

Source: https://docs.foxglove.dev/docs/visualization/message-schemas/introduction
"""

from __future__ import annotations

import array
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

from horus.errors import ConfigError
from horus.units import NS_PER_S

Source = str | Callable[[Any], Any] | float
"""A field's path within a message, what is called with the message, or a number."""
Json = Mapping[str, Any]

NO_RETURN_M = 0.0
"""What a beam that met nothing (inf, nan) becomes in JSON, which has no such numbers [m]."""

_FLOAT32, _FLOAT64 = 7, 8
"""Of foxglove.NumericType."""
_ENCODINGS = {
    ("|u1", 1): "mono8",
    ("|u1", 3): "rgb8",
    ("|u1", 4): "rgba8",
    ("<u2", 1): "mono16",
    ("<f4", 1): "32FC1",
}
"""By type and number of channels of an array."""


def object_schema(**fields: str | Json) -> Json:
    """Return the JSON schema of an object, all of whose fields are required."""
    kinds = {
        name: {"type": kind} if isinstance(kind, str) else kind for name, kind in fields.items()
    }
    return {"type": "object", "properties": kinds, "required": list(kinds)}


def timestamp(at_ns: int) -> Json:
    """Return a wall time [ns] as the schemas have it."""
    seconds, rest_ns = divmod(at_ns, NS_PER_S)
    return {"sec": seconds, "nsec": rest_ns}


_TIME = object_schema(sec="integer", nsec="integer")
_VECTOR = object_schema(x="number", y="number", z="number")
_QUATERNION = object_schema(x="number", y="number", z="number", w="number")
_POSE = object_schema(position=_VECTOR, orientation=_QUATERNION)
_NUMBERS = {"type": "array", "items": {"type": "number"}}
_BASE64 = {"type": "string", "contentEncoding": "base64"}
_FIELDS = {
    "type": "array",
    "items": object_schema(name="string", offset="integer", type="integer"),
}

LOG_SCHEMA = object_schema(
    timestamp=_TIME, level="integer", message="string", name="string", file="string", line="integer"
)
"""Of `foxglove.Log`, which log records are recorded as."""


class Declaration(Protocol):
    """What a `Pub` takes as `foxglove`."""

    schema_name: ClassVar[str]
    schema: ClassVar[Json]

    def converted(self, message: Any, at_ns: int) -> Json:
        """Return a message as the schema has it.

        Args:
            message: The message.
            at_ns: When it was sent, as wall time [ns].

        Raises:
            Exception: It has no such fields, or not of such types.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Where something is and which way it looks; by default where its frame is.

    Args:
        x: Position [m].
        y: Position [m].
        z: Position [m].
        yaw: Rotation about the z axis [rad].
        orientation: A quaternion in the order x, y, z, w, instead of `yaw`.
    """

    x: Source = 0.0
    y: Source = 0.0
    z: Source = 0.0
    yaw: Source = 0.0
    orientation: Source | None = None

    def __post_init__(self) -> None:
        """Refuse what is no source.

        Raises:
            ConfigError: See `Source`; or both an orientation and a yaw were given.
        """
        for name in ("x", "y", "z", "yaw"):
            _check_source(name, getattr(self, name))
        if self.orientation is not None:
            _check_source("orientation", self.orientation, number=False)
            if self.yaw != 0.0:
                raise ConfigError("yaw", self.yaw, "is part of the orientation: give one of them")

    def converted(self, message: Any) -> Json:
        """Return a message's `foxglove.Pose`."""
        return {
            "position": self.position(message),
            "orientation": self.rotation(message),
        }

    def position(self, message: Any) -> Json:
        """Return a message's `foxglove.Vector3`."""
        return {name: _number(message, getattr(self, name)) for name in ("x", "y", "z")}

    def rotation(self, message: Any) -> Json:
        """Return a message's `foxglove.Quaternion`."""
        if self.orientation is None:
            half = _number(message, self.yaw) / 2
            x, y, z, w = 0.0, 0.0, math.sin(half), math.cos(half)
        else:
            x, y, z, w = (_finite(value) for value in _found(message, self.orientation))
        return {"x": x, "y": y, "z": z, "w": w}


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseInFrame:
    """Messages that say where something is, for viewers a `foxglove.PoseInFrame`.

    Args:
        frame_id: The frame that the pose is in.
        pose: The pose.
    """

    schema_name: ClassVar[str] = "foxglove.PoseInFrame"
    schema: ClassVar[Json] = object_schema(timestamp=_TIME, frame_id="string", pose=_POSE)
    frame_id: str
    pose: Pose

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: The frame is no name, the pose no `Pose`.
        """
        _check_text("frame_id", self.frame_id)
        _check_pose(self.pose)

    def converted(self, message: Any, at_ns: int) -> Json:
        """Return a message as the schema has it."""
        return {
            "timestamp": timestamp(at_ns),
            "frame_id": self.frame_id,
            "pose": self.pose.converted(message),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTransform:
    """Messages that say where a frame is in another, for viewers a `foxglove.FrameTransform`.

    Args:
        parent_frame_id: The frame that the pose is in.
        child_frame_id: The frame that has this pose.
        pose: The pose.
    """

    schema_name: ClassVar[str] = "foxglove.FrameTransform"
    schema: ClassVar[Json] = object_schema(
        timestamp=_TIME,
        parent_frame_id="string",
        child_frame_id="string",
        translation=_VECTOR,
        rotation=_QUATERNION,
    )
    parent_frame_id: str
    child_frame_id: str
    pose: Pose

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: A frame is no name, the pose no `Pose`.
        """
        _check_text("parent_frame_id", self.parent_frame_id)
        _check_text("child_frame_id", self.child_frame_id)
        _check_pose(self.pose)

    def converted(self, message: Any, at_ns: int) -> Json:
        """Return a message as the schema has it."""
        return {
            "timestamp": timestamp(at_ns),
            "parent_frame_id": self.parent_frame_id,
            "child_frame_id": self.child_frame_id,
            "translation": self.pose.position(message),
            "rotation": self.pose.rotation(message),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserScan:
    """Messages that hold the scan of a planar range finder, for viewers a `foxglove.LaserScan`.

    Args:
        frame_id: The frame that the scan is in.
        pose: Where in it the range finder is.
        start_angle: Bearing of the first beam [rad].
        end_angle: Bearing of the last beam [rad].
        ranges: Distances, (n_beams,) [m]; one that is not finite becomes 0.
        intensities: Intensities, (n_beams,); none when not given.
    """

    schema_name: ClassVar[str] = "foxglove.LaserScan"
    schema: ClassVar[Json] = object_schema(
        timestamp=_TIME,
        frame_id="string",
        pose=_POSE,
        start_angle="number",
        end_angle="number",
        ranges=_NUMBERS,
        intensities=_NUMBERS,
    )
    frame_id: str
    start_angle: Source
    end_angle: Source
    ranges: Source
    intensities: Source | None = None
    pose: Pose = field(default_factory=Pose)

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: The frame is no name, the pose no `Pose`, another field no source.
        """
        _check_text("frame_id", self.frame_id)
        _check_pose(self.pose)
        _check_source("start_angle", self.start_angle)
        _check_source("end_angle", self.end_angle)
        _check_source("ranges", self.ranges, number=False)
        if self.intensities is not None:
            _check_source("intensities", self.intensities, number=False)

    def converted(self, message: Any, at_ns: int) -> Json:
        """Return a message as the schema has it."""
        intensities = () if self.intensities is None else _found(message, self.intensities)
        return {
            "timestamp": timestamp(at_ns),
            "frame_id": self.frame_id,
            "pose": self.pose.converted(message),
            "start_angle": _number(message, self.start_angle),
            "end_angle": _number(message, self.end_angle),
            "ranges": _finite_numbers(_found(message, self.ranges)),
            "intensities": _finite_numbers(intensities),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class PointCloud:
    """Messages that hold points, for viewers a `foxglove.PointCloud`.

    Args:
        frame_id: The frame that the points are in.
        pose: Where in it their origin is.
        points: The points, (n_points, len(fields)) [m]: an array, or a sequence of sequences.
        fields: What the columns are; a viewer draws `x`, `y` and `z`.
    """

    schema_name: ClassVar[str] = "foxglove.PointCloud"
    schema: ClassVar[Json] = object_schema(
        timestamp=_TIME,
        frame_id="string",
        pose=_POSE,
        point_stride="integer",
        fields=_FIELDS,
        data=_BASE64,
    )
    frame_id: str
    points: Source
    fields: Sequence[str] = ("x", "y", "z")
    pose: Pose = field(default_factory=Pose)

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: The frame is no name, the pose no `Pose`, `points` no source, a field no
                name.
        """
        _check_text("frame_id", self.frame_id)
        _check_pose(self.pose)
        _check_source("points", self.points, number=False)
        if isinstance(self.fields, str) or not self.fields:
            raise ConfigError("fields", self.fields, "must be the names of the columns")
        for name in self.fields:
            _check_text("fields", name)

    def converted(self, message: Any, at_ns: int) -> Json:
        """Return a message as the schema has it."""
        points, columns = _found(message, self.points), len(self.fields)
        if _is_array(points):
            if points.ndim != 2 or points.shape[1] != columns:
                raise ValueError(
                    f"points of shape {points.shape} are not (n_points, {columns}), as "
                    f"fields={tuple(self.fields)} says"
                )
            kind = _FLOAT64 if points.dtype.str == "<f8" else _FLOAT32
            data = points.astype("<f8" if kind == _FLOAT64 else "<f4").tobytes()
        else:
            rows = [tuple(point) for point in points]
            if any(len(row) != columns for row in rows):
                raise ValueError(f"a point has not {columns} numbers, as the fields say")
            kind, data = _FLOAT64, array.array("d", itertools.chain.from_iterable(rows)).tobytes()
        size = 8 if kind == _FLOAT64 else 4
        return {
            "timestamp": timestamp(at_ns),
            "frame_id": self.frame_id,
            "pose": self.pose.converted(message),
            "point_stride": size * columns,
            "fields": [
                {"name": name, "offset": size * place, "type": kind}
                for place, name in enumerate(self.fields)
            ],
            "data": data,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class RawImage:
    """Messages that hold the pixels of an image, for viewers a `foxglove.RawImage`.

    Args:
        frame_id: The frame of the camera.
        data: The image, (height, width) or (height, width, channels): an array.
        encoding: What the channels are, such as `"bgr8"`. By default `mono8`, `rgb8`, `rgba8`,
            `mono16` or `32FC1`, by the array's type and channels.
    """

    schema_name: ClassVar[str] = "foxglove.RawImage"
    schema: ClassVar[Json] = object_schema(
        timestamp=_TIME,
        frame_id="string",
        width="integer",
        height="integer",
        encoding="string",
        step="integer",
        data=_BASE64,
    )
    frame_id: str
    data: Source = ""
    encoding: str | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: The frame or the encoding is no name, `data` no source.
        """
        _check_text("frame_id", self.frame_id)
        _check_source("data", self.data, number=False)
        if self.encoding is not None:
            _check_text("encoding", self.encoding)

    def converted(self, message: Any, at_ns: int) -> Json:
        """Return a message as the schema has it."""
        image = _found(message, self.data)
        if not _is_array(image) or image.ndim not in (2, 3):
            raise TypeError("an image is no array of (height, width) or (height, width, channels)")
        height, width = image.shape[:2]
        channels = image.shape[2] if image.ndim == 3 else 1
        encoding = self.encoding or _ENCODINGS.get((image.dtype.str, channels))
        if encoding is None:
            raise ValueError(
                f"an image of {channels} channels of {image.dtype} has no usual encoding: "
                "name it, RawImage(encoding=...)"
            )
        return {
            "timestamp": timestamp(at_ns),
            "frame_id": self.frame_id,
            "width": width,
            "height": height,
            "encoding": encoding,
            "step": width * channels * image.dtype.itemsize,
            "data": image.tobytes(),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class CompressedImage:
    """Messages that hold a compressed image, for viewers a `foxglove.CompressedImage`.

    Args:
        frame_id: The frame of the camera.
        format: `"jpeg"`, `"png"`, `"webp"` or `"avif"`.
        data: The compressed image: bytes.
    """

    schema_name: ClassVar[str] = "foxglove.CompressedImage"
    schema: ClassVar[Json] = object_schema(
        timestamp=_TIME, frame_id="string", data=_BASE64, format="string"
    )
    frame_id: str
    format: str
    data: Source = ""

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: The frame or the format is no name, `data` no source.
        """
        _check_text("frame_id", self.frame_id)
        _check_text("format", self.format)
        _check_source("data", self.data, number=False)

    def converted(self, message: Any, at_ns: int) -> Json:
        """Return a message as the schema has it."""
        data = _found(message, self.data)
        if not isinstance(data, bytes | bytearray | memoryview):
            raise TypeError(f"a compressed image is {type(data).__name__}, not bytes")
        return {
            "timestamp": timestamp(at_ns),
            "frame_id": self.frame_id,
            "data": bytes(data),
            "format": self.format,
        }


DECLARATIONS = (PoseInFrame, FrameTransform, LaserScan, PointCloud, RawImage, CompressedImage)


def check_declaration(value: object) -> None:
    """Refuse what does not say how to show a topic.

    Raises:
        ConfigError: It is neither a declaration nor None.
    """
    if value is not None and not isinstance(value, DECLARATIONS):
        names = ", ".join(kind.__name__ for kind in DECLARATIONS)
        raise ConfigError("foxglove", value, f"must be one of horus.foxglove's {names}, or None")


def _check_text(argument: str, value: object) -> None:
    if not isinstance(value, str) or not value:
        raise ConfigError(argument, value, "must be a name")


def _check_pose(value: object) -> None:
    if not isinstance(value, Pose):
        raise ConfigError("pose", value, "must be a horus.foxglove.Pose")


def _check_source(argument: str, value: object, *, number: bool = True) -> None:
    if isinstance(value, str) or callable(value):
        return
    if number and isinstance(value, int | float) and not isinstance(value, bool):
        return
    allowed = "a field's path, a callable or a number" if number else "a field's path or a callable"
    raise ConfigError(argument, value, f"must be {allowed}")


def _found(message: Any, source: Source) -> Any:
    """Return what a source says of a message."""
    if callable(source):
        return source(message)
    if not isinstance(source, str):
        return source
    found = message
    for part in source.split(".") if source else ():
        try:
            if isinstance(found, Mapping):
                found = found[part]
            elif part.isdecimal():
                found = found[int(part)]
            else:
                found = getattr(found, part)
        except (LookupError, AttributeError, TypeError) as exc:
            raise ValueError(f"{type(message).__name__} has no field {source!r}") from exc
    return found


def _number(message: Any, source: Source) -> float:
    return _finite(_found(message, source))


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} cannot be drawn")
    return number


def _finite_numbers(values: Any) -> list[float]:
    numbers = map(float, values.tolist() if _is_array(values) else values)
    return [number if math.isfinite(number) else NO_RETURN_M for number in numbers]


def _is_array(value: Any) -> bool:
    # Without importing NumPy, which horus does not need.
    return hasattr(value, "dtype") and hasattr(value, "tobytes") and hasattr(value, "shape")
