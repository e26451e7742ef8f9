"""Conventions of ROS that this package also needs without ROS: image transports, camera_info topics, and stamps."""

from __future__ import annotations

from typing import Any

TRANSPORTS = ('raw', 'compressedDepth', 'compressed')
"""The better transports first. All but raw have a topic below that of the image (image_transport)."""
ZSTD = 'zstd'
"""A transport that is not read."""
ZSTD_REMEDY = (f'the transport {ZSTD} is not read: convert it with ros2 run image_transport republish '
               f'(in_transport {ZSTD}, out_transport raw), or publish or record another transport')
CROP = 'debug/crop'
"""The topic, below the name of the node, of what the network sees. It has an encoding of depth, but is not depth."""


def split_transport(topic: str) -> tuple[str, str]:
    """The topic of the image, and the transport: /depth/image/compressedDepth -> /depth/image, compressedDepth."""
    image, _, last = topic.rpartition('/')
    return (image, last) if last in TRANSPORTS[1:] else (topic, 'raw')


def join_transport(image_topic: str, transport: str) -> str:
    """The inverse of `split_transport`."""
    return image_topic if transport == 'raw' else f'{image_topic}/{transport}'


def camera_info_beside(image_topic: str) -> str:
    """The topic where the camera_info of an image is expected: /depth/image -> /depth/camera_info."""
    return f'{image_topic.rpartition("/")[0]}/camera_info'


def stamp_ns(header: Any) -> int:
    """The stamp of a header in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
