"""Foxglove: what a `Pub` declares is recorded as the schemas that viewers draw, too."""

from __future__ import annotations

import base64
import importlib
import json
import logging
import math
import re
from dataclasses import dataclass

import numpy as np
import pytest
from google.protobuf import descriptor, json_format
from mcap.reader import make_reader

import horus
from horus import ConfigError, Node, Pub, RecordingReader, Scheduler
from horus.foxglove import (
    DECLARATIONS,
    CompressedImage,
    FrameTransform,
    LaserScan,
    PointCloud,
    Pose,
    PoseInFrame,
    RawImage,
)

from .helpers import nothing


@dataclass
class Scan:
    """A scan as a driver might send it."""

    angle_min: float
    angle_max: float
    ranges: list


@dataclass
class Where:
    """A planar pose."""

    x: float
    y: float
    heading: float


IMAGE = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)
POINTS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, math.nan]])
SCAN = LaserScan(frame_id="laser", start_angle="angle_min", end_angle="angle_max", ranges="ranges")
WHERE = Pose(x="x", y="y", yaw="heading")
LOOK_ALIKES = {
    "scan": (SCAN, Scan(-1.5, 1.5, [1.0, math.inf, math.nan])),
    "scan.of.arrays": (
        LaserScan(
            frame_id="laser",
            pose=Pose(x=0.5, yaw=math.pi),
            start_angle=-2,
            end_angle=lambda message: -2 + 0.1 * len(message["r"]),
            ranges="r",
            intensities="i",
        ),
        {"r": np.float32([1, 2]), "i": np.uint8([3, 4])},
    ),
    "pose": (PoseInFrame(frame_id="map", pose=WHERE), Where(1, 2, 0.3)),
    "quaternion": (
        PoseInFrame(frame_id="map", pose=Pose(x="p.0", y="p.1", z="p.2", orientation="q")),
        {"p": (1, 2, 3), "q": (0, 0, 0, 1)},
    ),
    "transform": (
        FrameTransform(parent_frame_id="map", child_frame_id="base", pose=WHERE),
        Where(1, 2, 0.3),
    ),
    "image": (RawImage(frame_id="camera"), IMAGE),
    "bgr": (RawImage(frame_id="camera", data="pixels", encoding="bgr8"), {"pixels": IMAGE}),
    "depth": (RawImage(frame_id="camera"), np.ones((2, 2), np.float32)),
    "jpeg": (CompressedImage(frame_id="camera", format="jpeg"), b"\xff\xd8\xff"),
    "points": (PointCloud(frame_id="map", points="cloud"), {"cloud": POINTS}),
    "points.as.lists": (
        PointCloud(frame_id="map", points="", fields=("x", "y")),
        [(1.0, 2.0), (3.0, 4.0)],
    ),
}


def recorded(directory, *pubs):
    """Send the messages of each (Pub, message, …) in one tick and return the recording."""
    sched = Scheduler(tick_rate=10, recording=directory, deterministic=True)

    def tick(node):
        for pub, *messages in pubs:
            for message in messages:
                node.send(pub.topic, message)

    sched.add(Node("node", tick, rate=10, pubs=[pub for pub, *_ in pubs]))
    sched.tick_once()
    (path,) = sched.stop_recording()
    sched.stop()
    return path


def for_viewers(path):
    """Return what is on the JSON channels for viewers: by topic, schema name and content."""
    with path.open("rb") as file:
        return {
            channel.topic: (schema.name, json.loads(message.data))
            for schema, channel, message in make_reader(file).iter_messages()
            if channel.topic.startswith("foxglove/")
        }


def check_against(kind: descriptor.Descriptor, content):
    """Have the content be exactly what a published schema says: all of its fields, no others."""
    assert set(content) == {field.name for field in kind.fields}, kind.full_name
    for field in kind.fields:
        values = content[field.name] if field.is_repeated else [content[field.name]]
        for value in values:
            if field.message_type is None:
                continue
            if field.message_type.full_name == "google.protobuf.Timestamp":
                assert set(value) == {"sec", "nsec"}
                assert 0 <= value["nsec"] < 10**9
            else:
                check_against(field.message_type, value)
    # The library checks the types of the rest, and that bytes are base64.
    without_time = {name: value for name, value in content.items() if name != "timestamp"}
    json_format.ParseDict(without_time, message_of(kind.full_name))


def message_of(full_name):
    """Return an empty message of a published schema."""
    name = full_name.removeprefix("foxglove.")
    return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)()


@pytest.mark.parametrize("name", LOOK_ALIKES)
def test_declared_messages_pass_the_published_schemas(name, tmp_path):
    """Scans, poses, images and points have every field that Foxglove publishes, and its types."""
    declaration, message = LOOK_ALIKES[name]
    path = recorded(tmp_path, (Pub(name, foxglove=declaration), message))
    ((topic, (schema, content)),) = for_viewers(path).items()
    assert topic == f"foxglove/{name}"
    assert schema == declaration.schema_name
    check_against(message_of(schema).DESCRIPTOR, content)
    with RecordingReader(path) as reader:
        (exact,) = reader.messages([name])
        assert repr(exact.message()) == repr(message)


def test_every_declaration_was_tried():
    """The table above has all that `Pub` takes."""
    assert {type(declaration) for declaration, _ in LOOK_ALIKES.values()} == set(DECLARATIONS)


def test_log_records_pass_the_published_schema(tmp_path):
    """What nodes log is a `foxglove.Log`, level, file and line included."""
    sched = Scheduler(tick_rate=10, recording=tmp_path, deterministic=True)
    sched.add(Node("node", lambda node: node.log_warning("low battery")))
    sched.tick_once()
    (path,) = sched.stop_recording()
    sched.stop()
    with path.open("rb") as file:
        logs = [
            (schema.name, json.loads(message.data))
            for schema, _, message in make_reader(file).iter_messages("horus/log")
        ]
    assert {name for name, _ in logs} == {"foxglove.Log"}
    for _, content in logs:
        check_against(message_of("foxglove.Log").DESCRIPTOR, content)
    assert "low battery" in [content["message"] for _, content in logs]


def test_schemas_in_the_file_are_those_that_are_published():
    """The JSON schema of each declaration requires exactly the published fields."""
    for kind in DECLARATIONS:
        published = message_of(kind.schema_name).DESCRIPTOR
        assert kind.schema["required"] == list(kind.schema["properties"])
        assert set(kind.schema["required"]) == {field.name for field in published.fields}


def test_what_viewers_get_is_what_was_sent(tmp_path):
    """Angles, ranges, pixels and points arrive; what JSON lacks is zero, at the range finder."""
    topics = ("scan", "image", "points", "transform")
    path = recorded(
        tmp_path, *((Pub(t, foxglove=LOOK_ALIKES[t][0]), LOOK_ALIKES[t][1]) for t in topics)
    )
    shown = {topic.removeprefix("foxglove/"): it for topic, (_, it) in for_viewers(path).items()}
    assert shown["scan"]["start_angle"] == -1.5
    assert shown["scan"]["ranges"] == [1.0, 0.0, 0.0]
    image = shown["image"]
    assert (image["width"], image["height"], image["step"]) == (4, 2, 12)
    assert image["encoding"] == "rgb8"
    assert base64.b64decode(image["data"]) == IMAGE.tobytes()
    points = shown["points"]
    sent = np.frombuffer(base64.b64decode(points["data"])).reshape(-1, 3)
    np.testing.assert_array_equal(sent, POINTS)
    assert points["point_stride"] == 24
    assert [(field["name"], field["offset"]) for field in points["fields"]] == [
        ("x", 0),
        ("y", 8),
        ("z", 16),
    ]
    turned = shown["transform"]["rotation"]
    assert 2 * math.atan2(turned["z"], turned["w"]) == pytest.approx(0.3)


def test_time_and_sequence_are_those_of_the_message(tmp_path):
    """A picture can be traced to the exact message that it was made from."""
    path = recorded(tmp_path, (Pub("image", foxglove=RawImage(frame_id="camera")), IMAGE))
    with path.open("rb") as file:
        by_topic = {
            channel.topic: (message.log_time, message.sequence, channel.metadata["publisher"])
            for _, channel, message in make_reader(file).iter_messages(["image", "foxglove/image"])
        }
    assert by_topic["image"] == by_topic["foxglove/image"]
    seconds, rest_ns = divmod(by_topic["image"][0], 10**9)
    assert for_viewers(path)["foxglove/image"][1]["timestamp"] == {"sec": seconds, "nsec": rest_ns}


@pytest.mark.parametrize(
    ("declaration", "message", "said"),
    [
        (SCAN, {"angle_min": 0}, "dict has no field 'angle_max'"),
        (SCAN, Scan(math.nan, 1.0, []), "nan cannot be drawn"),
        (RawImage(frame_id="camera"), "a string", "an image is no array"),
        (RawImage(frame_id="camera"), np.ones((2, 2, 2), np.uint8), "name it"),
        (PointCloud(frame_id="map", points=""), POINTS[:, :2].copy(), r"shape \(2, 2\)"),
        (PointCloud(frame_id="map", points=""), [(1.0,)], "has not 3 numbers"),
        (CompressedImage(frame_id="camera", format="png"), "text", "is str, not bytes"),
        (PoseInFrame(frame_id="m", pose=Pose(x=lambda _: 1 / 0)), 1, "division by zero"),
    ],
)
def test_a_message_that_does_not_fit_is_reported_once_and_recorded(
    declaration, message, said, tmp_path, caplog
):
    """The exact record does not suffer from a declaration that is wrong; a log says why."""
    pub = Pub("topic", foxglove=declaration)
    with caplog.at_level(logging.ERROR, "horus"):
        path = recorded(tmp_path, (pub, message, message))
    with RecordingReader(path) as reader:
        assert len(list(reader.messages(["topic"]))) == 2
    assert for_viewers(path) == {}
    (report,) = [record.getMessage() for record in caplog.records if "topic" in record.getMessage()]
    assert report.startswith(
        f"messages of topic 'topic' are not shown as {declaration.schema_name}"
    )
    assert re.search(said, report)


@pytest.mark.parametrize(
    ("make", "argument"),
    [
        (lambda: Pub("t", foxglove="foxglove.LaserScan"), "foxglove"),
        (lambda: Pub("t", foxglove=RawImage), "foxglove"),
        (lambda: RawImage(frame_id=""), "frame_id"),
        (lambda: RawImage(frame_id="c", data=3), "data"),
        (lambda: RawImage(frame_id="c", encoding=8), "encoding"),
        (lambda: Pose(x=None), "x"),
        (lambda: Pose(x=True), "x"),
        (lambda: Pose(yaw=1, orientation="q"), "yaw"),
        (lambda: Pose(orientation=1), "orientation"),
        (lambda: PoseInFrame(frame_id="map", pose="pose"), "pose"),
        (lambda: PointCloud(frame_id="map", points="p", fields="xyz"), "fields"),
        (lambda: PointCloud(frame_id="map", points="p", fields=()), "fields"),
        (lambda: CompressedImage(frame_id="c", format=None), "format"),
    ],
)
def test_declarations_are_checked_where_they_are_written(make, argument):
    """A wrong declaration is a ConfigError that names the argument."""
    with pytest.raises(ConfigError) as caught:
        make()
    assert caught.value.argument == argument


def test_a_declaration_is_not_for_subscribers():
    """`Sub` has no such argument: how a topic is shown is said where it is sent."""
    with pytest.raises(TypeError):
        horus.Sub("t", foxglove=SCAN)


def test_nodes_of_all_kinds_of_compute_are_shown(tmp_path):
    """A declaration with a lambda works for a node in a process of its own, too."""
    pub = Pub(
        "where", foxglove=PoseInFrame(frame_id="map", pose=Pose(x=lambda message: message["x"]))
    )
    sched = Scheduler(tick_rate=50, recording=tmp_path)
    tick = lambda node: node.send("where", {"x": 1.0})  # noqa: E731
    sched.add(Node("it", tick, rate=50, compute="process", pubs=[pub]))
    sched.add(Node("other", nothing, rate=50))
    sched.run(duration=1.0)
    (path,) = sched.stop_recording()
    assert for_viewers(path)["foxglove/where"][1]["pose"]["position"]["x"] == 1.0
