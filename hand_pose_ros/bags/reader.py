"""Read depth images with their intrinsics, and recorded hands, from a bag."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection

from hand_pose_ros.bags.bag import CAMERA_INFO, COMPRESSED_IMAGE, HANDS, IMAGE, Bag
from hand_pose_ros.conventions import (
    CROP,
    TRANSPORTS,
    ZSTD,
    ZSTD_REMEDY,
    camera_info_beside,
    join_transport,
    split_transport,
    stamp_ns,
)
from hand_pose_ros.depth import DEPTH_ENCODINGS, decode_compressed, decode_image
from hand_pose_ros.errors import BagOptionError, InputError, naming
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.hand import Side, side_of
from hand_pose_ros.skeleton import SKELETONS


@dataclass(frozen=True)
class Frame:
    """One depth image of a bag. `depth` and `intrinsics` are computed at first use, and may raise InputError.

    Attributes:
        stamp_ns: of the header.
        frame_id: of the header.
        topic: the topic on which the image was recorded.
        recorded_ns: the time at which the image was recorded.
    """

    stamp_ns: int
    frame_id: str
    topic: str
    recorded_ns: int
    _message: Any
    _camera: Intrinsics | Sequence[float]
    _depth_scale: float

    @cached_property
    def depth(self) -> NDArray[np.float32]:
        """(H, W) float32, metres, 0 = no reading."""
        decode = decode_compressed if hasattr(self._message, 'format') else decode_image
        return decode(self._message, self._depth_scale, source=self.topic)

    @cached_property
    def intrinsics(self) -> Intrinsics:
        """The intrinsics of this image. The camera_info must have the size of the image."""
        height, width = self.depth.shape
        if isinstance(self._camera, Intrinsics):
            with naming(self.topic):
                self._camera.check_size(width, height)
            return self._camera
        fx, fy, cx, cy = self._camera
        return Intrinsics(fx, fy, cx, cy, width, height)


class DepthBag(Bag):
    """The depth images of a bag, each with the intrinsics of its camera: `for frame in DepthBag(path)`.

    Args:
        path: a bag of any kind.
        depth_topic: a topic of sensor_msgs/Image or CompressedImage; not needed if only one topic carries depth.
        camera_info_topic: by default `camera_info` beside the depth topic.
        intrinsics: (fx, fy, cx, cy) in pixels, used instead of the camera_info.
        depth_scale: metres per unit of 16-bit depth.

    Raises:
        InputError: the bag cannot be read, has no depth topic, or several to choose from, or has no camera_info.
    """

    def __init__(self, path: str | os.PathLike[str], depth_topic: str | None = None,
                 camera_info_topic: str | None = None, intrinsics: tuple[float, float, float, float] | None = None,
                 depth_scale: float = 0.001) -> None:
        super().__init__(path)
        try:
            self.depth_topic = depth_topic or self._find_depth_topic()
            self._images = self._on_topic(self.depth_topic, (IMAGE, COMPRESSED_IMAGE), 'another depth topic')
            self._infos: list[Connection] = []
            if intrinsics is None:
                beside = camera_info_beside(split_transport(self.depth_topic)[0])
                self._infos = self._on_topic(camera_info_topic or beside, (CAMERA_INFO,),
                                             'the topic of the camera_info (--camera-info-topic), or the '
                                             'intrinsics (--intrinsics FX FY CX CY)')
        except InputError:
            self.close()
            raise
        self._intrinsics, self._depth_scale = intrinsics or (), depth_scale
        self._unusable = ''

    def __len__(self) -> int:
        """The number of depth images."""
        return sum(connection.msgcount for connection in self._images)

    def __iter__(self) -> Iterator[Frame]:
        """The frames in the order of recording, each with the newest camera_info that has its frame_id.

        Raises:
            InputError: the bag is damaged, or no camera_info can be used. The frames before the damage come first.
        """
        cameras: dict[str, Intrinsics] = {}
        count = 0
        try:
            for connection in self._infos:  # images that were recorded before their camera_info use the first one
                for _, _, data in self.messages([connection]):
                    if self._remember(connection, self.deserialize(connection, data), cameras):
                        break
            for connection, recorded_ns, data in self.messages([*self._images, *self._infos]):
                message = self.deserialize(connection, data)
                if connection.msgtype == CAMERA_INFO:
                    self._remember(connection, message, cameras)
                    continue
                header = message.header
                if not cameras and not self._intrinsics:
                    raise BagOptionError(
                        self._unusable or f'{self.path}: the bag counts messages of camera_info that are not there: '
                        'copy it again, or give --intrinsics FX FY CX CY')
                camera = self._intrinsics if not cameras else cameras.get(header.frame_id, cameras[''])
                yield Frame(stamp_ns(header), header.frame_id, self.depth_topic, recorded_ns, message, camera,
                            self._depth_scale)
                count += 1
        except InputError as error:
            raise type(error)(f'{error} ({count} of {len(self)} depth images were read)') from error

    def _remember(self, connection: Connection, info: Any, cameras: dict[str, Intrinsics]) -> bool:
        """Keep the intrinsics as the newest for their frame_id, and under '' as the newest. False if unusable."""
        if self.is_ros1:  # K, D, R and P are lower-case in ROS 2
            info = SimpleNamespace(**{name.lower(): value for name, value in vars(info).items()})
        try:
            cameras[info.header.frame_id] = cameras[''] = Intrinsics.from_camera_info(info)
        except InputError as error:  # the first camera_info of some drivers is empty
            self._unusable = f'{self.path}: {connection.topic}: {error}, or give --intrinsics FX FY CX CY'
            return False
        return True

    def _find_depth_topic(self) -> str:
        depth = {connection.topic for connection in self.connections if self._carries_depth(connection)}
        # All transports of an image are one candidate. The raw one comes first: it needs the least work, and the
        # compressed ones may have lost something.
        images = {split_transport(topic)[0] for topic in depth}
        ways = ([join_transport(image, transport) for transport in TRANSPORTS] for image in images)
        topics = sorted(next(topic for topic in way if topic in depth) for way in ways)
        if len(topics) == 1:
            return topics[0]
        if topics:
            raise BagOptionError(f'{self.path}: several topics carry depth: choose one with --depth-topic: '
                                 + ', '.join(topics))
        if zstd := sorted(c.topic for c in self.connections if c.topic.endswith(f'/{ZSTD}')):
            raise InputError(f'{self.path}: no topic carries depth that can be read, and of {", ".join(zstd)} '
                             f'{ZSTD_REMEDY}')
        raise InputError(f'{self.path}: no topic carries depth, as images in {", ".join(DEPTH_ENCODINGS)} or '
                         f'compressedDepth do: choose another bag (this one has {self._topics()})')

    def _carries_depth(self, connection: Connection) -> bool:
        if connection.topic.endswith(f'/{CROP}'):  # in a recording of all topics of the node
            return False
        if connection.msgtype not in (IMAGE, COMPRESSED_IMAGE) or (message := self.first(connection)) is None:
            return False
        described = message.encoding if connection.msgtype == IMAGE else message.format.replace(';', ' ')
        return described.split(' ')[0] in DEPTH_ENCODINGS

    def _on_topic(self, topic: str, types: Sequence[str], remedy: str) -> list[Connection]:
        found = [c for c in self.connections if c.topic == topic and c.msgtype in types and c.msgcount]
        if not found:
            kinds = ' or '.join(map(_ros_name, types))
            raise BagOptionError(f'{self.path}: there is no {kinds} on {topic}: give {remedy} '
                                 f'(the bag has {self._topics()})')
        return found

    def _topics(self) -> str:
        return ', '.join(sorted({f'{c.topic} [{_ros_name(c.msgtype)}]' for c in self.connections if c.msgcount})
                         ) or 'no messages'


@dataclass(frozen=True)
class RecordedHands:
    """The hands of one image, as they were recorded.

    Attributes:
        stamp_ns: of the header; this is the stamp of the depth image.
        frame_id: of the header.
        skeleton: name of the joint set.
        joints: (hands, J, 3) float64, metres.
        confidence: (hands, J) float32.
        scores: (hands,) float32.
        sides: 'left', 'right' or 'unknown', one per hand.
        ids: one per hand.
    """

    stamp_ns: int
    frame_id: str
    skeleton: str
    joints: NDArray[np.float64]
    confidence: NDArray[np.float32]
    scores: NDArray[np.float32]
    sides: tuple[Side, ...]
    ids: tuple[str, ...]


def read_hands(path: str | os.PathLike[str], topic: str | None = None, *, partly: bool = False) -> list[RecordedHands]:
    """All HandJointsArray messages of a bag, in the order of recording.

    Args:
        topic: by default the only topic of this type.
        partly: if the bag is damaged, return the messages before the damage, unless there are none.

    Raises:
        InputError: there is no such topic, there are several to choose from, or the bag is damaged.
    """
    with Bag(path) as bag:
        hands = [c for c in bag.connections if c.msgtype == HANDS]
        found = [c for c in hands if topic in (None, c.topic)]
        topics = sorted({c.topic for c in found})
        if len(topics) != 1:
            there = ', '.join(sorted({c.topic for c in hands}))
            what = f'several topics carry {_ros_name(HANDS)}' if topics else \
                f'there is no {_ros_name(HANDS)} on {topic or "any topic"}'
            raise InputError(f'{path}: {what}: ' + (f'choose one of {there}' if there else 'choose another bag'))
        recorded: list[RecordedHands] = []
        try:
            for connection, _, data in bag.messages(found):
                recorded.append(_recorded_hands(bag.deserialize(connection, data), f'{path}: {topics[0]}'))
        except InputError:
            if not (partly and recorded):
                raise
        return recorded


def check_frame(source: str, hands: str, images: str) -> None:
    """Raise InputError if hands and images are in different frames. A frame without a name may be any frame."""
    if hands and images and hands != images:
        raise InputError(f"{source}: its joints are in frame '{hands}', but the images in '{images}': leave the "
                         'parameter target_frame of the node empty')


def _recorded_hands(message: Any, source: str) -> RecordedHands:
    counts = {count for hand in message.hands for count in (len(hand.joints), len(hand.confidence))}
    known = SKELETONS.get(message.skeleton)
    count = len(known) if known else max(counts, default=0)
    if counts - {count}:
        raise InputError(f'{source}: the hands of one message have {sorted(counts)} joints and confidences, but all '
                         f'must have {count} ({message.skeleton}): record as many, or name another skeleton')
    shape = (len(message.hands), count)
    joints = [[(point.x, point.y, point.z) for point in hand.joints] for hand in message.hands]
    return RecordedHands(
        stamp_ns(message.header), message.header.frame_id, message.skeleton,
        np.array(joints, np.float64).reshape(*shape, 3),
        np.array([hand.confidence for hand in message.hands], np.float32).reshape(shape),
        np.array([hand.score for hand in message.hands], np.float32),
        tuple(side_of(hand.side) for hand in message.hands),
        tuple(hand.id for hand in message.hands))


def _ros_name(msgtype: str) -> str:
    return msgtype.replace('/msg/', '/')
