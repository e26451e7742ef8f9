"""The parameters of the node: one table, declared with descriptions and ranges, read into one typed object."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from hand_pose_ros.conventions import TRANSPORTS
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.estimator import HandPoseEstimator


def _parameter(default: Any, description: str, *, name: str | None = None, low: float | None = None,
               high: float | None = None, choices: tuple[str, ...] = (), fixed: str = '') -> Any:
    """One row of the table; `fixed` says until when a value holds, and is empty for one that may change at any time."""
    return field(default=default, metadata={'name': name, 'description': description, 'low': low, 'high': high,
                                            'choices': choices, 'fixed': fixed})


_CONFIGURED = 'until cleanup'
_ALWAYS = 'for good'


@dataclass(frozen=True)
class Params:
    """Values of all parameters (metres and seconds). A change at run time gives a new object, between two images."""

    model: str = _parameter('', 'Name of weights that ship, or path of a checkpoint; empty = the default.',
                            fixed=_CONFIGURED)
    device: str = _parameter('auto', 'Where the network runs: auto (CUDA when it is there), cpu, cuda or cuda:N.',
                             fixed=_CONFIGURED)
    num_threads: int = _parameter(0, 'Threads for the network on the CPU, at most; 0 = by the number of cores.', low=0,
                                  high=256, fixed=_CONFIGURED)
    transport: str = _parameter('raw', 'How depth arrives: raw takes the image topic itself, the others take '
                                '<image topic>/<transport> (sensor_msgs/CompressedImage).',
                                choices=TRANSPORTS, fixed=_CONFIGURED)
    depth_scale: float = _parameter(0.001, 'Metres per unit of 16-bit depth; 32FC1 is in metres already.',
                                    low=1e-5, high=1.0)
    use_rectified: bool = _parameter(True, 'Take the intrinsics from P of camera_info (rectified images) instead of K.')
    camera_info_timeout: float = _parameter(0.5, 'Seconds that an image waits for a camera_info that fits it.',
                                            low=0.0, high=10.0)
    intrinsics_fx: float = _parameter(0.0, 'Focal length in pixels. With all four intrinsics.* set, camera_info is not '
                                      'used; all 0 = use it.', name='intrinsics.fx', low=0.0, high=1e5)
    intrinsics_fy: float = _parameter(0.0, 'Focal length in pixels.', name='intrinsics.fy', low=0.0, high=1e5)
    intrinsics_cx: float = _parameter(0.0, 'Principal point in pixels.', name='intrinsics.cx', low=-1e5, high=1e5)
    intrinsics_cy: float = _parameter(0.0, 'Principal point in pixels.', name='intrinsics.cy', low=-1e5, high=1e5)
    min_depth: float = _parameter(0.1, 'Hands are looked for beyond this distance.', low=0.01, high=10.0)
    max_depth: float = _parameter(1.5, 'Hands are looked for up to this distance. The network that finds them '
                              'knows none beyond about 1.5 m: further away, set detector to nearest.',
                              low=0.05, high=10.0)
    cube_size: float = _parameter(0.0, 'Side of the cube around a hand; 0 = what the model was trained for.',
                                  low=0.0, high=1.0)
    side: str = _parameter('auto', 'Which hands there are; auto finds out.', choices=('auto', 'left', 'right'))
    max_hands: int = _parameter(2, 'At most this many hands per image. While there are fewer, every fifth image takes '
                                'longer, for it is searched for more.', low=1, high=8)
    min_score: float = _parameter(0.4, 'Hands with a lower score are not reported; a new one beside another must '
                                   'begin with its square root (0.63 for 0.4).', low=0.0, high=1.0)
    detector: str = _parameter('network', 'How new hands are found: by a small network; as what is nearest to the '
                               'camera, as in the paper; or by the network within the newest region of hand/region '
                               '(sensor_msgs/RegionOfInterest, in pixels of the depth image; one without width or '
                               'height says that there is no hand). Hands that are tracked stay.',
                               choices=('network', 'nearest', 'region'), fixed=_CONFIGURED)
    tracking: bool = _parameter(True, 'Look first where the hands of the last image were. Without it every image is '
                                'searched, and hands have no history: a new id in each, and no smoothing.')
    smoothing: float = _parameter(0.0, 'Cutoff in Hz of the filter on the joints of a hand at rest; 0 = none.',
                                  low=0.0, high=30.0)
    target_frame: str = _parameter('', 'Frame of hand/joints and hand/poses; empty = that of the depth image. Needs '
                                   'tf2_ros. Markers and tf stay in the frame of the camera.', fixed=_CONFIGURED)
    publish_markers: bool = _parameter(True, 'Publish hand/markers (only built while somebody listens).')
    marker_lifetime: float = _parameter(0.5, 'Seconds after which a viewer removes the markers of a node that died; '
                                        '0 = never. Lost hands are deleted at once.', low=0.0, high=60.0)
    publish_poses: bool = _parameter(False, 'Publish hand/poses (geometry_msgs/PoseArray), the joints of all hands in '
                                     'the order of the skeleton; not turned.', fixed=_CONFIGURED)
    publish_joint_states: bool = _parameter(False, 'Publish hand/joint_states (sensor_msgs/JointState) while there '
                                            'are hands: angles of the fingers in radians, e.g. of '
                                            'r_index_mcp_flexion. Needs a model with the joints of hand21.',
                                            fixed=_CONFIGURED)
    publish_tf: bool = _parameter(False, 'Publish a frame for each joint to /tf, e.g. r_index_tip. Needs tf2_msgs.',
                                  fixed=_CONFIGURED)
    publish_diagnostics: bool = _parameter(True, 'Publish /diagnostics once a second.')
    autostart: bool = _parameter(True, 'Configure and activate at start; false waits for lifecycle transitions.',
                                 fixed=_ALWAYS)

    def __post_init__(self) -> None:
        for row in fields(self):
            choices = row.metadata['choices']
            if choices and getattr(self, row.name) not in choices:
                raise HandPoseError(f"parameter {ros_name(row)} is '{getattr(self, row.name)}': "
                                    f'choose one of {", ".join(choices)}')
        if not re.fullmatch(r'auto|cpu|cuda(:\d+)?', self.device):
            raise HandPoseError(f"parameter device is '{self.device}': choose auto, cpu, cuda or cuda:N")
        if self.min_depth >= self.max_depth:
            raise HandPoseError(f'parameter min_depth ({self.min_depth} m) must be smaller than max_depth '
                                f'({self.max_depth} m)')
        if 0 < self.cube_size < 0.05:
            raise HandPoseError(f'parameter cube_size is {self.cube_size} m, smaller than any hand: give 0.05 to 1.0, '
                                'or 0 for the size that the model was trained for')

    @property
    def has_intrinsics(self) -> bool:
        """Whether the user gives the intrinsics. `ros2 param set` can only give them one after the other."""
        return any((self.intrinsics_fx, self.intrinsics_fy, self.intrinsics_cx, self.intrinsics_cy))

    def make_estimator(self) -> HandPoseEstimator:
        """Load the network, ready to answer.

        Raises:
            HandPoseError: there are no such weights, or no such device.
        """
        estimator = HandPoseEstimator.from_pretrained(
            self.model or None, device=self.device, num_threads=self.num_threads or None,
            detector='nearest' if self.detector == 'nearest' else 'network')
        estimator.warm_up()
        return estimator

    def apply(self, estimator: HandPoseEstimator) -> None:
        """Set what may change between two images."""
        estimator.side = self.side  # type: ignore[assignment]
        estimator.max_hands = self.max_hands
        estimator.min_score = self.min_score
        estimator.near, estimator.far = self.min_depth, self.max_depth
        estimator.cube_side = self.cube_size or estimator.metadata['cube_side']
        estimator.tracking, estimator.smoothing = self.tracking, self.smoothing


def ros_name(row: Any) -> str:
    """The name of a field of Params as a ROS parameter."""
    return row.metadata['name'] or row.name


def declare(node: Node) -> Params:
    """Declare all parameters on a node, and read them.

    Raises:
        HandPoseError: a value of another type, out of range or not among the choices, or two that contradict each
            other.
    """
    return Params(**{row.name: _declare(node, row) for row in fields(Params)})


def _declare(node: Node, row: Any) -> Any:
    name, low = ros_name(row), row.metadata['low']
    try:
        return node.declare_parameter(name, row.default, _descriptor(row)).value
    except ParameterException as error:
        given = _overrides(node)[name].value
        wanted = {bool: 'true or false', int: 'a whole number', float: 'a number with a point, as 1.0,',
                  str: 'a text'}[type(row.default)]
        span = '' if low is None else f' from {low:g} to {row.metadata["high"]:g}'
        raise HandPoseError(f'parameter {name} is {given!r:.80}: give {wanted}{span}') from error


def unknown(node: Node) -> list[str]:
    """Names of parameters that were given at start and that nobody has declared so far."""
    return [name for name in _overrides(node) if not node.has_parameter(name)]


def _overrides(node: Node) -> dict[str, Parameter]:
    """What was given at start; rclpy tells nobody."""
    return getattr(node, '_parameter_overrides', {})


def changed(params: Params, changes: Sequence[Parameter], *, configured: bool) -> Params:
    """The parameters after a change at run time; names that are not ours (qos_overrides, use_sim_time) are passed over.

    Raises:
        HandPoseError: the change is refused; the message is the reason.
    """
    rows = {ros_name(row): row for row in fields(Params)}
    ours = [(rows[change.name], change.value) for change in changes if change.name in rows]
    for row, value in ours:
        if configured and row.metadata['fixed'] == _CONFIGURED and value != getattr(params, row.name):
            raise HandPoseError(f'parameter {ros_name(row)} is read when the node is configured: deactivate and clean '
                                'up the node first, then set it and configure again')
    return replace(params, **{row.name: value for row, value in ours})


def _descriptor(row: Any) -> ParameterDescriptor:
    meta = row.metadata
    descriptor = ParameterDescriptor(
        description=meta['description'], read_only=meta['fixed'] == _ALWAYS,
        additional_constraints=f'one of {", ".join(meta["choices"])}' if meta['choices'] else '')
    if meta['low'] is not None:
        if isinstance(row.default, int):
            descriptor.integer_range = [IntegerRange(from_value=meta['low'], to_value=meta['high'], step=0)]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=meta['low'], to_value=meta['high'])]
    return descriptor


def markdown_table() -> str:
    """All parameters as a Markdown table, for the documentation."""
    lines = ['| parameter | default | range | may change | meaning |', '|---|---|---|---|---|']
    for row in fields(Params):
        meta = row.metadata
        span = ', '.join(meta['choices']) or ('' if meta['low'] is None else f'{meta["low"]:g} to {meta["high"]:g}')
        when = {'': 'any time', _CONFIGURED: 'before configure', _ALWAYS: 'at start only'}[meta['fixed']]
        default = str(row.default).lower() if isinstance(row.default, bool) else repr(row.default)
        lines.append(f'| `{ros_name(row)}` | {default} | {span} | {when} | {meta["description"]} |')
    return '\n'.join(lines)


def yaml_file() -> str:
    """All parameters with their defaults as a parameter file of ROS 2; the content of config/estimator.yaml."""
    lines = ['# Parameters of the node `estimator` with their defaults. Ranges: hand-pose estimator --parameters',
             '/**:', '  ros__parameters:']
    for row in fields(Params):
        value = json.dumps(row.default)  # which is YAML, too
        lines += textwrap.wrap(row.metadata['description'], 100, initial_indent='    # ', subsequent_indent='    # ')
        lines += [f'    {ros_name(row)}: {value}']
    return '\n'.join(lines) + '\n'
