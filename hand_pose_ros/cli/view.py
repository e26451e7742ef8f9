"""`hand-pose view`: depth images and hands in 3D, live or from a bag, for people without RViz and Foxglove."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.bags import DepthBag
from hand_pose_ros.cli.arguments import (
    ESTIMATOR,
    add_bag,
    add_estimator,
    bag_options,
    check_intrinsics,
    count,
    keep_input,
    make_estimator,
    refuse,
)
from hand_pose_ros.cli.estimate import from_bag
from hand_pose_ros.conventions import TRANSPORTS
from hand_pose_ros.depth import to_units
from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.files import in_one_step
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.markers import DELETE, SPHERE_LIST, HandMarkers, Marker
from hand_pose_ros.skeleton import Skeleton

DESCRIPTION = 'Show depth images and hands in 3D with Rerun: those of a bag, or of live topics.'

EXAMPLES = """examples:
  hand-pose view recording.mcap
  hand-pose view recording.mcap --save recording.rrd     (open it later, or elsewhere, with: rerun recording.rrd)
  hand-pose view --ros-args -r depth/image_rect:=/camera/camera/depth/image_rect_raw

Without a bag it shows what a camera and the node `estimator` publish, until Ctrl-C.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('bag', metavar='BAG', type=Path, nargs='?', help='a .bag, .mcap or .db3 file, or a ROS 2 '
                        'folder: its hands are estimated and shown; without it, live topics are shown')
    parser.add_argument('--save', metavar='FILE', type=Path, help='write an .rrd file instead of opening the viewer')
    bag = parser.add_argument_group('with a bag (live, only --intrinsics and --depth-scale apply)')
    add_bag(bag)
    add_estimator(bag)
    bag.add_argument('--max-hands', type=count, default=2, metavar='N', help='at most N hands per image (2)')
    live = parser.add_argument_group('live')
    live.add_argument('--transport', default='raw', choices=TRANSPORTS, help='how the depth images arrive (raw)')
    live.add_argument('--ros-args', nargs=argparse.REMAINDER, default=[], metavar='...',
                      help='remappings (-r from:=to) and other ROS arguments, as for ros2 run')


def run(args: argparse.Namespace) -> int:
    """Show until the end of the bag, or until Ctrl-C. Returns 1 if an image of the bag could not be used.

    Raises:
        HandPoseError: Rerun is not installed, the bag cannot be read, or there is no ROS for live topics.
    """
    if args.bag is not None:
        refuse(args, ('transport', 'ros_args'), 'is for live topics')
        return _view_bag(args)
    refuse(args, ('depth_topic', 'camera_info_topic'), 'is for bags: choose live topics with --ros-args -r from:=to')
    refuse(args, (*ESTIMATOR, 'max_hands'), 'is for bags: live hands come from the node')
    check_intrinsics(args)
    from hand_pose_ros.ros.watch import watch  # without ROS, this says what is missing
    with Scene(args.save) as scene:
        watch(scene.add_depth, scene.add_hands, args.transport, args.depth_scale, args.intrinsics, args.ros_args)
    return 0


def _view_bag(args: argparse.Namespace) -> int:
    failed = shown = 0
    keep_input(args.save, args.bag)
    with DepthBag(args.bag, **bag_options(args)) as bag:
        estimator = make_estimator(args)
        with Scene(args.save) as scene:
            for image in from_bag(bag):
                try:
                    depth, intrinsics = image.load()
                    hands = estimator(depth, intrinsics)
                except InputError as error:
                    failed += 1
                    print(f'hand-pose view: {error}', file=sys.stderr)
                    continue
                scene.add_depth(image.stamp_ns, depth, intrinsics)
                scene.add_hands(image.stamp_ns, hands, estimator.skeleton)
                shown += 1
            if not shown:
                raise InputError(f'{args.bag}: none of its images could be used, so there is nothing to view')
    return 1 if failed else 0


class Scene:
    """Depth images as a cloud of points, and hands as markers among them, in the optical frame of the camera.

    Args:
        path: the .rrd file to write. It appears when the scene is left without an error. None opens the viewer.

    Raises:
        HandPoseError: Rerun is not installed, there is no display, or the file cannot be written.
    """

    def __init__(self, path: Path | None) -> None:
        try:
            import rerun
            from rerun import blueprint
        except ImportError as error:
            raise HandPoseError(f"Rerun is needed ({error}): in the checkout, pip install '.[view]', or "
                                'anywhere pip install rerun-sdk') from error
        if path is None and sys.platform == 'linux' and not {'DISPLAY', 'WAYLAND_DISPLAY'} & os.environ.keys():
            raise HandPoseError('there is no display for the viewer: write a file with --save FILE.rrd and open it '
                                'where there is one, with rerun FILE.rrd')
        self._rerun, self._file = rerun, ExitStack()
        self._markers: HandMarkers | None = None
        views = blueprint.Horizontal(blueprint.Spatial3DView(origin='/', name='hands in 3D'), blueprint.Spatial2DView(
            origin='/camera', contents=['/camera/**', '/hands/**'], name='depth image'))
        layout = blueprint.Blueprint(views, collapse_panels=True)
        self._stream = rerun.RecordingStream('hand_pose_ros')
        if path is None:
            self._stream.spawn(default_blueprint=layout)
        else:
            self._stream.save(self._file.enter_context(in_one_step(path)), default_blueprint=layout)
        self._stream.log('/', rerun.ViewCoordinates.RDF, static=True)

    def add_depth(self, stamp_ns: int, depth: NDArray[np.float32], intrinsics: Intrinsics) -> None:
        """Show a depth image (H, W) in metres."""
        self._at(stamp_ns)
        self._stream.log('camera', self._rerun.Pinhole(
            width=intrinsics.width, height=intrinsics.height, focal_length=(intrinsics.fx, intrinsics.fy),
            principal_point=(intrinsics.cx, intrinsics.cy), camera_xyz=self._rerun.ViewCoordinates.RDF))
        self._stream.log('camera/depth', self._rerun.DepthImage(to_units(depth, 0.001), meter=1000.0))

    def add_hands(self, stamp_ns: int, hands: Sequence[HandEstimate], skeleton: Skeleton) -> None:
        """Show the hands of an image, and remove those that are gone."""
        self._at(stamp_ns)
        if self._markers is None:
            self._markers = HandMarkers(skeleton)
        for marker in self._markers.update(hands):
            self._stream.log(f'hands/{marker.namespace}', self._shape(marker))

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *error: Any) -> None:
        self._stream.flush()
        self._stream.disconnect()
        self._file.__exit__(*error)

    def _at(self, stamp_ns: int) -> None:
        self._stream.set_time('stamp', timestamp=np.datetime64(stamp_ns, 'ns'))

    def _shape(self, marker: Marker) -> Any:
        if marker.action == DELETE:
            return self._rerun.Clear(recursive=False)
        colors = np.rint(np.array(marker.colors) * 255).astype(np.uint8)
        radius = marker.scale[0] / 2
        if marker.type == SPHERE_LIST:
            return self._rerun.Points3D(marker.points, radii=radius, colors=colors)
        return self._rerun.LineStrips3D(marker.points.reshape(-1, 2, 3), radii=radius, colors=colors[::2])
