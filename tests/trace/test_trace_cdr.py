"""Entities and details as CDR, against rosbags' independent reading of their schemas."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

from rsltrace.errors import TraceError
from rsltrace.trace.cdr import pack_detail, pack_entity, unpack_detail, unpack_entity
from rsltrace.trace.format import SCHEMA_DETAIL, SCHEMA_ENTITY, SCHEMA_TEXT
from rsltrace.trace.model.entity import Entity, EntityKind

TEXT = st.text(st.characters(exclude_categories=("Cs",)), max_size=20)
U32 = st.integers(0, 2**32 - 1)
U64 = st.integers(0, 2**64 - 1)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=6,
)
ENTITIES = st.builds(
    Entity,
    id=U32,
    node=U32,
    kind=st.sampled_from(EntityKind),
    name=TEXT,
    type=TEXT,
    created_ns=U64,
    detail=st.dictionaries(TEXT, JSON, max_size=4),
)


@pytest.fixture(scope="module")
def store() -> Typestore:
    store = Typestore()
    for name in (SCHEMA_ENTITY, SCHEMA_DETAIL):
        store.register(get_types_from_msg(SCHEMA_TEXT[name], name))
    return store


@given(entity=ENTITIES)
def test_entities_read_back(entity: Entity) -> None:
    assert unpack_entity(pack_entity(entity), entity.created_ns) == entity


@given(entity=ENTITIES)
def test_entities_are_what_their_schema_says(store: Typestore, entity: Entity) -> None:
    decoded = store.deserialize_cdr(pack_entity(entity), SCHEMA_ENTITY)
    assert (decoded.id, decoded.node, decoded.kind) == (entity.id, entity.node, entity.kind)
    assert (decoded.name, decoded.type) == (entity.name, entity.type)
    assert json.loads(decoded.detail) == entity.detail


@given(event=U64, output=U32, text=TEXT)
def test_details_read_back_as_their_schema_says(
    store: Typestore, event: int, output: int, text: str
) -> None:
    data = pack_detail(event, output, text)
    assert unpack_detail(data) == (event, output, text)
    decoded = store.deserialize_cdr(data, SCHEMA_DETAIL)
    assert (decoded.event, decoded.output, decoded.text) == (event, output, text)


def test_equal_details_give_equal_bytes_whatever_their_order() -> None:
    one = Entity(1, 1, EntityKind.TIMER, "t", "", 0, {"a": 1, "b": 2})
    other = Entity(1, 1, EntityKind.TIMER, "t", "", 0, {"b": 2, "a": 1})
    assert pack_entity(one) == pack_entity(other)


def test_text_that_is_not_unicode_is_kept_readable() -> None:
    assert unpack_detail(pack_detail(0, 0, "caf\udce9"))[2] == "caf\\udce9"


def check(data: bytes) -> None:
    """What can be read at all is an entity: it can be written, and means the same when read."""
    try:
        entity = unpack_entity(data, 0)
    except TraceError:
        return
    assert unpack_entity(pack_entity(entity), 0) == entity


@given(data=st.binary(max_size=80))
def test_any_bytes_are_an_entity_or_a_trace_error(data: bytes) -> None:
    for header in (b"", b"\x00\x01\x00\x00"):
        check(header + data)


@given(entity=ENTITIES, data=st.data())
def test_a_damaged_entity_is_an_entity_or_a_trace_error(
    entity: Entity, data: st.DataObject
) -> None:
    packed = bytearray(pack_entity(entity))
    packed[data.draw(st.integers(0, len(packed) - 1))] ^= data.draw(st.integers(1, 255))
    for damaged in (packed, packed[: data.draw(st.integers(0, len(packed)))]):
        check(bytes(damaged))


def test_a_kind_of_the_future_is_named() -> None:
    packed = bytearray(pack_entity(Entity(1, 1, EntityKind.NODE, "/n", "", 0, {})))
    packed[12] = 200
    with pytest.raises(TraceError, match="kind 200, which only a newer rsltrace knows"):
        unpack_entity(bytes(packed), 0)


def test_a_detail_of_deep_nesting_is_an_error_not_a_crash() -> None:
    packed = pack_entity(Entity(1, 1, EntityKind.NODE, "", "", 0, {}))
    text = b'{"a":' + b"[" * 200_000 + b"\0"
    head = packed[: -len(b"{}\0") - 4]
    with pytest.raises(TraceError):
        unpack_entity(head + len(text).to_bytes(4, "little") + text, 0)
