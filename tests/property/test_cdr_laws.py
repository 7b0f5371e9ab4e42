"""Packed layouts are exactly CDR: the same bytes as three independent encoders, and back."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from logs.cdr import Columns, LayoutError, layout, layout_of_message
from logs.definition import PRIMITIVES, Definition, parse
from logs.encode import encode
from logs.topics import TOPICS, definition_text

TYPES = sorted({t.message_type for t in TOPICS.values()})
PLAIN = [t for t in sorted(PRIMITIVES) if t not in ("byte", "char")]
texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)


def primitives(name: str) -> st.SearchStrategy[Any]:
    code = np.dtype(PRIMITIVES[name])
    if name == "bool":
        return st.booleans()
    if code.kind == "f":
        return st.floats(width=8 * code.itemsize, allow_nan=False)
    return st.integers(int(np.iinfo(code).min), int(np.iinfo(code).max))


@st.composite
def values(draw: st.DrawFn, definition: Definition, name: str) -> dict[str, Any]:
    """Draw a message as nested dictionaries."""
    message: dict[str, Any] = {}
    for field in definition.fields[name]:
        if field.type in PRIMITIVES:
            one: st.SearchStrategy[Any] = primitives(field.type)
        elif field.type == "string":
            one = texts
        elif field.type == "builtin_interfaces/Time":
            nano = st.integers(0, 999_999_999)
            one = st.fixed_dictionaries({"sec": st.integers(0, 2**31 - 1), "nanosec": nano})
        else:
            one = values(definition, field.type)
        if field.length is None:
            message[field.name] = draw(one)
        else:
            size = field.length if field.length >= 0 else draw(st.integers(0, 3))
            message[field.name] = draw(st.lists(one, min_size=size, max_size=size))
    return message


@st.composite
def definitions(draw: st.DrawFn) -> str:
    """Draw the text of a message of primitives, strings, arrays and one nested message."""
    kinds = [*PLAIN, "string", "Inner", "builtin_interfaces/Time"]
    suffix = st.sampled_from(["", "", "[]", "[3]"])

    def body(choices: list[str]) -> str:
        count = draw(st.integers(1, 5))
        lines = (f"{draw(st.sampled_from(choices))}{draw(suffix)} f{i}" for i in range(count))
        return "\n".join(lines)

    outer, inner = body(kinds), body([*PLAIN, "string"])
    return f"{outer}\n{'=' * 80}\nMSG: pkg/Inner\n{inner}\n"


def namespace(value: Any) -> Any:
    if isinstance(value, dict):
        return SimpleNamespace(**{k: namespace(v) for k, v in value.items()})
    return [namespace(v) for v in value] if isinstance(value, list) else value


def rosbags_object(store: Any, definition: Definition, name: str, value: dict[str, Any]) -> Any:
    """Build the dataclass that rosbags serialises."""
    package, base = name.split("/")
    made = {}
    for field in definition.fields[name]:
        v = value[field.name]
        if field.type in PRIMITIVES and field.length is not None:
            v = np.array(v, dtype=np.bool_ if field.type == "bool" else PRIMITIVES[field.type])
        elif "/" in field.type:
            one = field.length is None
            items = [rosbags_object(store, definition, field.type, x) for x in ([v] if one else v)]
            v = items[0] if one else items
        made[field.name] = v
    return store.types[f"{package}/msg/{base}"](**made)


def check(name: str, text: str, value: dict[str, Any]) -> None:
    definition = parse(name, text)
    ours = encode(definition, value)
    assert ours == serialize_dynamic(name, text)[name](namespace(value))

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, name))
    message = rosbags_object(store, definition, definition.name, value)
    # rosbags pads a message to a multiple of four bytes.
    theirs = bytes(store.serialize_cdr(message, name))
    assert theirs[: len(ours)] == ours
    assert not any(theirs[len(ours) :])

    # An example gives the layout; unpacking and packing it gives the same bytes, also from its columns alone.
    found = layout_of_message(definition, ours)
    assert len(ours) == found.dtype.itemsize
    array = np.frombuffer(ours, dtype=found.dtype)
    stamps, columns = found.unpack(array)
    assert found.pack(stamps, columns).tobytes() == ours
    again = layout(definition, Columns(columns.dtype, found.strings))
    assert again.pack(stamps, columns).tobytes() == ours
    assert bool(found.matches(array.view(np.uint8).reshape(1, -1))[0])
    assert generate_dynamic(name, text)[name](ours) is not None


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_message_of_our_topics(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(TYPES))
    text = definition_text(name)
    definition = parse(name, text)
    check(name, text, data.draw(values(definition, definition.name)))


@settings(max_examples=80, deadline=None)
@given(st.data())
def test_any_message_of_any_definition(data: st.DataObject) -> None:
    text = data.draw(definitions())
    definition = parse("pkg/msg/Outer", text)
    value = data.draw(values(definition, definition.name))
    try:
        check("pkg/msg/Outer", text, value)
    except LayoutError as error:  # two paths can make one name: f0_f1 of a nested and of a flat field
        assert "one field too many" in str(error)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_cut_or_changed_message_never_reads_beyond_its_end(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(TYPES))
    definition = parse(name, definition_text(name))
    whole = bytearray(encode(definition, data.draw(values(definition, definition.name))))
    place = data.draw(st.integers(0, len(whole) - 1))
    whole[place] = data.draw(st.integers(0, 255))
    cut = bytes(whole[: data.draw(st.integers(0, len(whole)))])
    try:
        found = layout_of_message(definition, cut)
    except LayoutError:
        return
    assert found.dtype.itemsize <= len(cut)


@pytest.mark.parametrize("little", [True, False])
def test_both_byte_orders_give_the_same_columns(little: bool) -> None:
    definition = parse("sensor_msgs/msg/Range", definition_text("sensor_msgs/msg/Range"))
    strings = {"header_frame_id": "range"}
    dtype = layout(definition, Columns(np.dtype([]), strings)).row_dtype
    columns = np.zeros(2, dtype=dtype)
    columns["range"] = [1.5, 2.5]
    stamps = np.array([1_500_000_001, -3], dtype=np.int64)
    packed = layout(definition, Columns(dtype, strings), little).pack(stamps, columns)
    back_stamps, back = layout_of_message(definition, packed[:1].tobytes()).unpack(packed)
    assert np.array_equal(back_stamps, stamps)
    assert back.tobytes() == columns.tobytes()
    assert packed.tobytes()[1] == int(little)


@pytest.mark.parametrize(
    "text", ["float64[4000000000] x", "Inner[4000000000] x\n====\nMSG: pkg/Inner\nint8 y"]
)
def test_a_definition_of_gigabytes_is_refused_at_once(text: str) -> None:
    with pytest.raises(LayoutError, match=r"too (large|many)"):
        layout_of_message(parse("pkg/msg/Huge", text), bytes([0, 1, 0, 0, 0, 0, 0, 0]))


def test_a_stamp_beyond_2038_is_refused() -> None:
    definition = parse("sensor_msgs/msg/FluidPressure", definition_text("sensor_msgs/msg/FluidPressure"))
    fixed = layout(definition, Columns(np.dtype([]), {}))
    with pytest.raises(LayoutError, match="2038"):
        fixed.pack(np.array([2**31 * 10**9]), np.zeros(1, dtype=fixed.row_dtype))


def test_integers_of_a_sequence_keep_all_their_bits_and_must_fit() -> None:
    for values in ([0, 2**63 + 1], [-1, 2**63 - 1]):
        kind = "uint64" if values[0] == 0 else "int64"
        got = encode(parse("pkg/msg/Sequence", f"{kind}[] f0"), {"f0": values})
        assert np.frombuffer(got[-16:], dtype=kind).tolist() == values
    with pytest.raises(LayoutError, match="'f0' cannot hold"):
        encode(parse("pkg/msg/Sequence", "uint8[] f0"), {"f0": [300]})
