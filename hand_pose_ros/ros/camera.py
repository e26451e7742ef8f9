"""The newest camera_info, and the intrinsics that go with an image."""

from __future__ import annotations

import threading

from sensor_msgs.msg import CameraInfo

from hand_pose_ros.errors import InputError, naming
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.ros.params import Params


class Closed(Exception):
    """Raised when waiting for a camera_info is ended."""


class Camera:
    """Intrinsics from parameters or from the newest camera_info.

    Images and camera_info are not synchronised by their stamps: some drivers publish the camera_info once, or late, or
    with another stamp. Instead, the newest camera_info is used. It must have the size of the image.

    Args:
        topic: of the camera_info.
        remedy: what else the user can do if there is no camera_info that can be used; for the error message.

    Attributes:
        waiting: whether an image is waiting for its camera_info at this moment.
    """

    def __init__(self, topic: str, remedy: str = 'set the parameters intrinsics.fx, .fy, .cx and .cy') -> None:
        self.topic, self._remedy = topic, remedy
        self._info: CameraInfo | None = None
        self._closed = self.waiting = False
        self._changed = threading.Condition()

    def update(self, info: CameraInfo) -> None:
        """Take a new camera_info."""
        with self._changed:
            self._info = info
            self._changed.notify_all()

    def open(self) -> None:
        """Wait again if there is no camera_info. An earlier one is still used: some drivers publish it only once."""
        self._closed = False

    def close(self) -> None:
        """End all waiting."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def intrinsics(self, width: int, height: int, params: Params) -> Intrinsics:
        """The intrinsics for an image of this size. Waits up to `camera_info_timeout` for a camera_info that is late.

        Raises:
            InputError: there is no camera_info, it is not calibrated, it is for another image size, no lens can have
                these intrinsics, or only some of the parameters intrinsics.* are set.
            Closed: the waiting was ended before a camera_info arrived.
        """
        if params.has_intrinsics:
            given = params.intrinsics_fx, params.intrinsics_fy, params.intrinsics_cx, params.intrinsics_cy
            if 0 in given:
                raise InputError('parameters intrinsics.fx, .fy, .cx and .cy go together: set all four, or none')
            intrinsics = Intrinsics(*given, width, height)
            with naming('parameters intrinsics.*'):
                intrinsics.check_lens()
            return intrinsics
        wanted = width, height, params.use_rectified
        with self._changed:
            self.waiting = True
            self._changed.wait_for(lambda: self._closed or self._fits(*wanted), params.camera_info_timeout)
            self.waiting = False
            if self._closed and not self._fits(*wanted):
                raise Closed
            info = self._info
        if info is None:
            raise InputError(f'no camera_info arrived on {self.topic}: publish it beside the depth image, remap '
                             f'depth/camera_info, or {self._remedy}')
        with naming(self.topic):
            try:
                intrinsics = Intrinsics.from_camera_info(info, rectified=params.use_rectified)
            except InputError as error:
                raise InputError(f'{error}, or {self._remedy}') from error
            intrinsics.check_size(width, height)
            intrinsics.check_lens()
        return intrinsics

    def source(self, params: Params) -> str:
        """Where the intrinsics come from, in words."""
        if params.has_intrinsics:
            return 'parameters'
        return self.topic if self._info is not None else f'none yet on {self.topic}'

    def frame_problem(self, frame_id: str, params: Params) -> str:
        """What is suspicious about the frame of an image; empty if nothing is.

        The camera_info may be that of another camera whose images have the same size.
        """
        info = self._info
        if params.has_intrinsics or info is None or info.header.frame_id in ('', frame_id):
            return ''
        return (f'its frame_id is {frame_id!r:.80} but that of {self.topic} is {info.header.frame_id!r:.80}: if they '
                'are different cameras, the joints are wrong; remap depth/camera_info to the one of the depth image')

    def _fits(self, width: int, height: int, rectified: bool) -> bool:
        if self._info is None:
            return False
        try:
            Intrinsics.from_camera_info(self._info, rectified=rectified).check_size(width, height)
        except InputError:
            return False
        return True
