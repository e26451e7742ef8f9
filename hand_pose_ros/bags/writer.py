"""Write depth images, hands and other messages to a new ROS 2 bag."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer

from hand_pose_ros.bags.bag import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    HAND,
    HANDS,
    IMAGE,
    SKELETON,
    PathForSqlite,
    typestore,
)
from hand_pose_ros.conventions import camera_info_beside, join_transport
from hand_pose_ros.depth import encode_compressed, to_units
from hand_pose_ros.errors import InputError
from hand_pose_ros.files import naming_full_disk
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.hand import SIDES, HandEstimate
from hand_pose_ros.markers import Marker
from hand_pose_ros.skeleton import HAND21, Skeleton

MARKERS = 'visualization_msgs/msg/MarkerArray'
_FOREVER = QosTime(2147483647, 4294967295)  # rosbag2 writes this for "no limit"


class BagWriter:
    """Writes a bag: `with BagWriter(path) as bag: ...`. The bag appears at `path` when it is complete.

    After an error, `path` is as it was before.

    Args:
        path: if it ends in .mcap or .db3, a single file; an existing file is replaced. Otherwise the folder of a ROS 2
            bag, which must not exist yet.
        storage: 'mcap' or 'sqlite3', for a folder.

    Raises:
        InputError: the folder exists already, the bag cannot be written, or the storage is unknown.
    """

    def __init__(self, path: str | os.PathLike[str], storage: str = 'mcap') -> None:
        self.path = Path(path)
        self._is_file = self.path.suffix in ('.mcap', '.db3')
        if self._is_file:
            storage = 'mcap' if self.path.suffix == '.mcap' else 'sqlite3'
        if storage not in ('mcap', 'sqlite3'):
            raise InputError(f"{self.path}: unknown storage '{storage}': choose mcap or sqlite3")
        if self.path.exists() and not (self._is_file and self.path.is_file()):
            raise InputError(f'{self.path}: there is something already: give another name for the bag, or remove it')
        self._target = Path(os.path.realpath(self.path))  # a link stays a link
        try:
            self._target.parent.mkdir(parents=True, exist_ok=True)
            self._work = Path(tempfile.mkdtemp(prefix=f'.{self.path.name}.', dir=self._target.parent))
        except OSError as error:
            raise InputError(f'{self.path}: the bag cannot be written ({error.strerror}): choose another place'
                             ) from None
        self._writer = Writer(self._work / self.path.stem, version=9, storage_plugin=StoragePlugin[storage.upper()])
        self._writer.path = PathForSqlite(self._writer.path)
        try:
            with naming_full_disk(self.path):
                self._writer.open()
        except BaseException:
            self.abort()
            raise
        self._connections: dict[str, Connection] = {}
        self._types = typestore().types

    def write(self, topic: str, msgtype: str, message: Any, stamp_ns: int, *, latched: bool = False) -> None:
        """Write a message that is made of the types of rosbags (`hand_pose_ros.bags.bag.typestore().types`).

        The other arguments are those of `write_serialized`.
        """
        self.write_serialized(topic, msgtype, typestore().serialize_cdr(message, msgtype), stamp_ns, latched=latched)

    def write_serialized(self, topic: str, msgtype: str, data: bytes | memoryview, stamp_ns: int, *,
                         latched: bool = False) -> None:
        """Write CDR bytes, for example those of rclpy.serialization.serialize_message.

        Args:
            msgtype: for example 'sensor_msgs/msg/Image'.
            stamp_ns: time of recording.
            latched: bag players offer the topic as transient local.
        """
        with naming_full_disk(self.path):
            if topic not in self._connections:
                qos = Qos(QosHistory.KEEP_LAST, 1 if latched else 10, QosReliability.RELIABLE,
                          QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
                          _FOREVER, _FOREVER, QosLiveliness.AUTOMATIC, _FOREVER, avoid_ros_namespace_conventions=False)
                self._connections[topic] = self._writer.add_connection(
                    topic, msgtype, typestore=typestore(), offered_qos_profiles=[qos])
            self._writer.write(self._connections[topic], int(stamp_ns), data)  # rosbags takes no integers of numpy

    def write_depth(self, stamp_ns: int, frame_id: str, depth: NDArray[np.float32], intrinsics: Intrinsics, *,
                    topic: str = '/depth/image_rect', codec: str | None = 'png') -> None:
        """Write a depth image as 16UC1, in millimetres, and its camera_info on the topic beside it.

        Args:
            depth: (H, W), metres, 0 = no reading.
            topic: of the raw image; with a codec, `/compressedDepth` is added.
            codec: 'png' or 'rvl' for compressedDepth, None for raw images.
        """
        header = self._header(stamp_ns, frame_id)
        info = self._camera_info(header, intrinsics)
        self.write(camera_info_beside(topic), CAMERA_INFO, info, stamp_ns)
        if codec is None:
            units = to_units(depth).astype('<u2', order='C')
            height, width = units.shape
            self.write(topic, IMAGE, self._types[IMAGE](
                header=header, height=height, width=width, encoding='16UC1', is_bigendian=0, step=2 * width,
                data=units.view(np.uint8).ravel()), stamp_ns)
        else:
            name, data = encode_compressed(depth, codec)
            self.write(join_transport(topic, 'compressedDepth'), COMPRESSED_IMAGE, self._types[COMPRESSED_IMAGE](
                header=header, format=name, data=np.frombuffer(data, np.uint8)), stamp_ns)

    def write_hands(self, stamp_ns: int, frame_id: str, hands: Sequence[HandEstimate], skeleton: Skeleton = HAND21,
                    topic: str = '/hand/joints', *, recorded_ns: int | None = None) -> None:
        """Write a HandJointsArray: all hands of one image, even if there are none.

        Args:
            recorded_ns: time of recording, if it is not the stamp.
        """
        self.write(topic, HANDS, self._types[HANDS](
            header=self._header(stamp_ns, frame_id), skeleton=skeleton.name,
            hands=[self._hand(hand) for hand in hands]), stamp_ns if recorded_ns is None else recorded_ns)

    def write_skeleton(self, stamp_ns: int, frame_id: str, skeleton: Skeleton, model: str, model_version: str, *,
                       recorded_ns: int | None = None) -> None:
        """Write what the joints mean (HandSkeleton) on /hand/skeleton, latched. Call this once."""
        self.write('/hand/skeleton', SKELETON, self._types[SKELETON](
            header=self._header(stamp_ns, frame_id), name=skeleton.name, joint_names=list(skeleton.joint_names),
            parents=np.array(skeleton.parents, np.int8), model=model, model_version=model_version),
            stamp_ns if recorded_ns is None else recorded_ns, latched=True)

    def write_markers(self, stamp_ns: int, frame_id: str, markers: Sequence[Marker], *,
                      recorded_ns: int | None = None) -> None:
        """Write a MarkerArray on /hand/markers (see `hand_pose_ros.markers`). Viewers show it until it is deleted."""
        header = self._header(stamp_ns, frame_id)
        message = self._types[MARKERS](markers=[self._marker(header, marker) for marker in markers])
        self.write('/hand/markers', MARKERS, message, stamp_ns if recorded_ns is None else recorded_ns)

    def close(self) -> None:
        """Complete the bag and move it to its path."""
        if not self._work.exists():  # it was closed or aborted before
            return
        made = self._writer.path
        try:
            with naming_full_disk(self.path):
                self._writer.close()
            os.replace(next(made.glob(f'*{self.path.suffix}')) if self._is_file else made, self._target)
        finally:
            shutil.rmtree(self._work, ignore_errors=True)

    def abort(self) -> None:
        """Abort the bag and leave nothing."""
        with suppress(Exception):  # for example a full disk, which has been reported
            self._writer.abort()
        shutil.rmtree(self._work, ignore_errors=True)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        return self._types['std_msgs/msg/Header'](
            stamp=self._types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec), frame_id=frame_id)

    def _point(self, xyz: Sequence[float]) -> Any:
        x, y, z = (float(value) for value in xyz)
        return self._types['geometry_msgs/msg/Point'](x=x, y=y, z=z)

    def _hand(self, hand: HandEstimate) -> Any:
        return self._types[HAND](
            id=hand.id, side=SIDES.index(hand.side), score=float(hand.score),
            joints=[self._point(joint) for joint in hand.joints], confidence=np.asarray(hand.confidence, np.float32),
            cube_center=self._point(hand.cube.center), cube_size=float(hand.cube.side))

    def _marker(self, header: Any, marker: Marker) -> Any:
        t, colors = self._types, 'std_msgs/msg/ColorRGBA'
        image = t['sensor_msgs/msg/CompressedImage'](header=header, format='', data=np.empty(0, np.uint8))
        identity = t['geometry_msgs/msg/Quaternion'](x=0.0, y=0.0, z=0.0, w=1.0)
        return t['visualization_msgs/msg/Marker'](
            header=header, ns=marker.namespace, id=0, type=marker.type, action=marker.action,
            pose=t['geometry_msgs/msg/Pose'](position=self._point((0, 0, 0)), orientation=identity),
            scale=t['geometry_msgs/msg/Vector3'](*marker.scale), color=t[colors](0.0, 0.0, 0.0, 0.0),
            lifetime=t['builtin_interfaces/msg/Duration'](sec=0, nanosec=0), frame_locked=False,
            points=[self._point(point) for point in marker.points], colors=[t[colors](*c) for c in marker.colors],
            texture_resource='', texture=image, uv_coordinates=[], text='', mesh_resource='',
            mesh_file=t['visualization_msgs/msg/MeshFile'](filename='', data=np.empty(0, np.uint8)),
            mesh_use_embedded_materials=False)

    def _camera_info(self, header: Any, intrinsics: Intrinsics) -> Any:
        k = np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]], np.float64)
        whole = self._types['sensor_msgs/msg/RegionOfInterest'](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self._types[CAMERA_INFO](
            header=header, height=intrinsics.height, width=intrinsics.width, distortion_model='plumb_bob',
            d=np.zeros(5), k=k.ravel(), r=np.eye(3).ravel(), p=np.hstack([k, np.zeros((3, 1))]).ravel(),
            binning_x=0, binning_y=0, roi=whole)
