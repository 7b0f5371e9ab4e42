"""Definitions of the topics: parsed, complete, and equal to ROS's own where they are standard."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from logs.definition import DefinitionError, parse
from logs.topics import TOPICS, definition_text, new_rows, row_dtype

STANDARD = sorted({t.message_type for t in TOPICS.values() if not t.message_type.startswith("deckfix")})


@pytest.mark.parametrize("message_type", STANDARD)
def test_standard_definitions_hash_like_ros(message_type: str) -> None:
    ours = get_typestore(Stores.EMPTY)
    ours.register(get_types_from_msg(definition_text(message_type), message_type))
    reference = get_typestore(Stores.ROS2_JAZZY)
    if message_type == "sensor_msgs/msg/Range":
        # The field "variance" was added in Iron; this is the definition of Humble, which has none.
        reference = get_typestore(Stores.ROS2_HUMBLE)
    assert ours.hash_rihs01(message_type) == reference.hash_rihs01(message_type)


def test_columns_of_the_imu_are_named_by_path_and_folded() -> None:
    assert row_dtype("/imu").names == (
        "orientation",
        "orientation_covariance",
        "angular_velocity",
        "angular_velocity_covariance",
        "linear_acceleration",
        "linear_acceleration_covariance",
    )
    assert row_dtype("/imu")["orientation"].shape == (4,)
    assert row_dtype("sensor_msgs/msg/Imu") == row_dtype("/imu")


def test_new_rows_are_zero_and_take_sequence_lengths() -> None:
    rows = new_rows("/estimate/state", 3, values=15, sigmas=15)
    assert rows.shape == (3,)
    assert rows["values"].shape == (3, 15)
    assert not rows["values"].any()
    assert row_dtype("/gps/fix")["status_status"] == np.int8


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("float64", "not a field"),
        ("Missing thing", "definition of pkg/Missing is missing"),
        ("Thing again", "contains itself"),
        ("float64 x\n====\nfloat64 y", "MSG"),
    ],
)
def test_bad_definitions_are_refused(text: str, problem: str) -> None:
    with pytest.raises(DefinitionError, match=problem):
        parse("pkg/msg/Thing", text)


def test_constants_defaults_bounds_and_comments_are_understood() -> None:
    text = 'uint8 A=1 # one\nstring<=5 name "x" # text\nfloat32[<=3] some\nint8[2] pair [1, 2]\nTime[] stamps'
    found = parse("pkg/Thing", text.replace("Time[]", "builtin_interfaces/Time[]"))
    fields = found.fields["pkg/Thing"]
    assert [(f.name, f.type, f.length) for f in fields] == [
        ("name", "string", None),
        ("some", "float32", -1),
        ("pair", "int8", 2),
        ("stamps", "builtin_interfaces/Time", -1),
    ]
