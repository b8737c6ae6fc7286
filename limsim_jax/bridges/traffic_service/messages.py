"""The messages of the `.proto` files here, made at their first use.

Generated code fits few versions of protobuf; descriptors fit all. They lie in a pool of their own, so that a
process may also hold AlpaSim's generated code.
"""

from __future__ import annotations

import functools
from typing import Any

SERVICE = "traffic.TrafficService"
METHODS = {
    "start_session": ("traffic.TrafficSessionRequest", "common.SessionRequestStatus"),
    "close_session": ("traffic.TrafficSessionCloseRequest", "common.Empty"),
    "simulate": ("traffic.TrafficRequest", "traffic.TrafficReturn"),
    "get_metadata": ("common.Empty", "traffic.TrafficModuleMetadata"),
    "get_available_scenes": ("common.Empty", "common.AvailableScenesReturn"),
}
"""Method to the types of its request and its answer."""

DRIVER = "driver.DriverService"
DRIVER_METHODS = {"drive": ("driver.DriveRequest", "driver.DriveReturn")}
"""Likewise, of planners in other processes."""

FILES: dict[str, dict[str, str]] = {
    "common": {
        "Empty": "",
        "Quat": "float w=1, float x=2, float y=3, float z=4",
        "Vec3": "float x=1, float y=2, float z=3",
        "Pose": "common.Vec3 vec=1, common.Quat quat=2",
        "AABB": "float size_x=1, float size_y=2, float size_z=3",
        "PoseAtTime": "common.Pose pose=1, fixed64 timestamp_us=2",
        "Trajectory": "*common.PoseAtTime poses=1",
        "VersionId": "string version_id=1, string git_hash=2, common.VersionId.APIVersion grpc_api_version=3",
        "VersionId.APIVersion": "uint32 major=1, uint32 minor=2, uint32 patch=3",
        "SessionRequestStatus": "",
        "AvailableScenesReturn": "*string scene_ids=1",
    },
    "traffic": {
        "ObjectTrajectory": "common.AABB aabb=1, common.Trajectory trajectory=2, string object_id=3, "
        "bool is_static=4, string label_class=5",
        "ObjectTrajectoryUpdate": "string object_id=1, common.Trajectory trajectory=2",
        "TrafficSessionRequest": "string session_uuid=1, string scene_id=2, fixed64 random_seed=3, "
        "*traffic.ObjectTrajectory logged_object_trajectories=4, fixed64 handover_time_us=5",
        "TrafficSessionCloseRequest": "string session_uuid=1",
        "TrafficRequest": "string session_uuid=1, fixed64 time_query_us=2, "
        "*traffic.ObjectTrajectoryUpdate object_trajectory_updates=3",
        "TrafficReturn": "*traffic.ObjectTrajectoryUpdate object_trajectory_updates=1",
        "TrafficModuleMetadata": "common.VersionId version_id=1, fixed64 minimum_history_length_us=2",
    },
    "driver": {
        "Array": "string name=1, *uint32 shape=2, *float values=3",
        "DriveRequest": "*driver.Array seen=1",
        "DriveReturn": "*driver.Array command=1",
    },
}
"""File to message to fields: type, name and number; *: repeated."""

ADVICE = 'the traffic service needs grpcio: pip install "limsim-jax[grpc]"'


def grpc() -> Any:
    """The module of gRPC.

    Raises:
      ModuleNotFoundError: it is not installed.
    """
    try:
        import grpc
    except ModuleNotFoundError:
        raise ModuleNotFoundError(ADVICE) from None
    return grpc


@functools.cache
def message(name: str) -> Any:
    """The class of a message, such as traffic.TrafficRequest.

    Raises:
      ModuleNotFoundError: protobuf is not installed.
    """
    from google.protobuf import message_factory

    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(name))


def file_descriptor(name: str) -> Any:
    """What `protoc` makes of a file: common, traffic or driver."""
    try:
        from google.protobuf import descriptor_pb2
    except ModuleNotFoundError:
        raise ModuleNotFoundError(ADVICE) from None
    kinds = descriptor_pb2.FieldDescriptorProto
    made: Any = descriptor_pb2.FileDescriptorProto(name=f"{name}.proto", package=name, syntax="proto3")
    within: dict[str, Any] = {}
    for path, fields in FILES[name].items():
        outer, _, own = path.rpartition(".")
        one = within[outer].nested_type.add(name=own) if outer else made.message_type.add(name=own)
        within[path] = one
        for field in filter(None, fields.split(", ")):
            kind, _, rest = field.partition(" ")
            word, _, number = rest.partition("=")
            label = kinds.LABEL_REPEATED if kind.startswith("*") else kinds.LABEL_OPTIONAL
            kind = kind.lstrip("*")
            added = one.field.add(name=word, number=int(number), label=label, json_name=_camel(word))
            if "." in kind:
                added.type, added.type_name = kinds.TYPE_MESSAGE, f".{kind}"
            else:
                added.type = getattr(kinds, f"TYPE_{kind.upper()}")
    if name == "traffic":
        made.dependency.append("common.proto")
        within["TrafficModuleMetadata"].reserved_range.add(start=3, end=4)
        within["TrafficModuleMetadata"].reserved_name.append("supported_map_ids")
    for full, methods in ((SERVICE, METHODS), (DRIVER, DRIVER_METHODS)):
        package, _, own = full.partition(".")
        if package != name:
            continue
        service = made.service.add(name=own)
        for method, (asked, given) in methods.items():
            service.method.add(name=method, input_type=f".{asked}", output_type=f".{given}")
    return made


@functools.cache
def _pool() -> Any:
    from google.protobuf import descriptor_pool

    pool = descriptor_pool.DescriptorPool()
    for name in FILES:
        pool.AddSerializedFile(file_descriptor(name).SerializeToString())
    return pool


def _camel(word: str) -> str:
    first, *rest = word.split("_")
    return first + "".join(part.capitalize() for part in rest)


__all__ = ["DRIVER", "DRIVER_METHODS", "FILES", "METHODS", "SERVICE", "file_descriptor", "grpc", "message"]
