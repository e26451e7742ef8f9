"""A bag with the messages that the node would publish. It can be played beside the bag of the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

from hand_pose_ros.bags import Bag, BagWriter
from hand_pose_ros.errors import InputError
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.markers import HandMarkers
from hand_pose_ros.skeleton import Skeleton

TOPICS = ('/hand/joints', '/hand/markers', '/hand/skeleton')


class Stamped(Protocol):
    """What is needed of an image: its stamp, its frame and the time of its recording."""

    @property
    def stamp_ns(self) -> int: ...
    @property
    def frame_id(self) -> str: ...
    @property
    def recorded_ns(self) -> int: ...


class HandBag:
    """/hand/joints, /hand/markers and /hand/skeleton: `with HandBag(...) as bag`.

    Args:
        path: a file (.mcap, .db3), or the folder of a ROS 2 bag.
        metadata: of the estimator. It names the model.

    Raises:
        InputError: the bag cannot be written, or would replace one with other topics.
    """

    def __init__(self, path: str | PathLike[str], skeleton: Skeleton, metadata: Mapping[str, Any]) -> None:
        self._skeleton, self._metadata = skeleton, metadata
        self._begun = False
        self._markers = HandMarkers(skeleton)
        _keep_recording(Path(path))
        self._writer = BagWriter(path)

    def __enter__(self) -> HandBag:
        return self

    def __exit__(self, *error: Any) -> None:
        self._writer.__exit__(*error)

    def add(self, image: Stamped, hands: Sequence[HandEstimate]) -> None:
        """Write the hands of an image, even if there are none. Their time of recording is that of the image."""
        header, time = (image.stamp_ns, image.frame_id), image.recorded_ns
        if not self._begun:
            from hand_pose_ros.models.checkpoints import described  # imports torch: not for --help
            self._writer.write_skeleton(*header, self._skeleton, *described(self._metadata), recorded_ns=time)
            self._begun = True
        self._writer.write_hands(*header, hands, self._skeleton, recorded_ns=time)
        self._writer.write_markers(*header, self._markers.update(hands), recorded_ns=time)


def _keep_recording(path: Path) -> None:
    """Raise InputError if there is a bag with topics that a HandBag does not write. They would be lost."""
    topics: set[str] = set()
    if path.is_file():  # reading a FIFO may take for ever
        with suppress(InputError), Bag(path) as bag:
            topics = {connection.topic for connection in bag.connections} - set(TOPICS)
    if topics:
        raise InputError(f'{path}: this is a recording of {min(topics)}, which would be lost: choose another name')
