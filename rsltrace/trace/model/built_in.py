"""What rclpy makes for every node: most entities of most runs, and hardly ever of interest."""

from __future__ import annotations

from rsltrace.trace.model.entity import Entity, EntityKind

NODE_TOPICS = frozenset(("/rosout", "/parameter_events"))
NODE_SERVICES = frozenset(
    (
        "describe_parameters",
        "get_parameter_types",
        "get_parameters",
        "get_type_description",
        "list_parameters",
        "set_parameters",
        "set_parameters_atomically",
    )
)


def is_built_in(entity: Entity) -> bool:
    """Whether rclpy made ``entity`` without being asked: publishers of log and parameter events,
    and the parameter services."""
    if entity.kind is EntityKind.PUBLISHER:
        return entity.name in NODE_TOPICS
    return entity.kind is EntityKind.SERVICE and entity.name.rpartition("/")[2] in NODE_SERVICES
