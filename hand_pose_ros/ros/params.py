"""The parameters of the node: one table. They are declared with descriptions and ranges, and read into one object."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from hand_pose_ros.conventions import TRANSPORTS
from hand_pose_ros.errors import HandPoseError

if TYPE_CHECKING:
    from hand_pose_ros.estimator import HandPoseEstimator


def _parameter(default: Any, description: str, *, name: str | None = None, low: float | None = None,
               high: float | None = None, choices: tuple[str, ...] = (), fixed: str = '') -> Any:
    """One row of the table. `fixed` says until when a value is fixed; it is empty if the value may change any time."""
    return field(default=default, metadata={'name': name, 'description': description, 'low': low, 'high': high,
                                            'choices': choices, 'fixed': fixed})


_CONFIGURED = 'until cleanup'
_ALWAYS = 'for good'


@dataclass(frozen=True)
class Params:
    """Values of all parameters (metres and seconds). A change at run time makes a new object, used from the next image.

    Raises:
        HandPoseError: a value is not among its choices, or two values contradict each other.
    """

    model: str = _parameter('', 'Name of weights that ship, or path of a checkpoint; empty = the default weights.',
                            fixed=_CONFIGURED)
    device: str = _parameter('auto', 'Where the network runs: auto (CUDA if available), cpu, cuda or cuda:N.',
                             fixed=_CONFIGURED)
    num_threads: int = _parameter(0, 'Maximum number of threads for the network on the CPU; 0 = chosen by the number '
                                  'of cores.', low=0, high=256, fixed=_CONFIGURED)
    transport: str = _parameter('raw', 'How depth arrives. raw subscribes to the image topic itself. The others '
                                'subscribe to the topic below it, for example depth/image_rect/compressedDepth '
                                '(sensor_msgs/CompressedImage).', choices=TRANSPORTS, fixed=_CONFIGURED)
    depth_scale: float = _parameter(0.001, 'Metres per unit of 16-bit depth. 32FC1 is always in metres.', low=1e-5,
                                    high=1.0)
    use_rectified: bool = _parameter(True, 'Take the intrinsics from P of camera_info (for rectified images) instead '
                                     'of K.')
    camera_info_timeout: float = _parameter(0.5, 'Seconds that an image waits for a matching camera_info.', low=0.0,
                                            high=10.0)
    intrinsics_fx: float = _parameter(0.0, 'Focal length in pixels. If all four intrinsics.* are set, camera_info is '
                                      'not used. If all are 0, it is used.', name='intrinsics.fx', low=0.0, high=1e5)
    intrinsics_fy: float = _parameter(0.0, 'Focal length in pixels.', name='intrinsics.fy', low=0.0, high=1e5)
    intrinsics_cx: float = _parameter(0.0, 'Principal point in pixels.', name='intrinsics.cx', low=-1e5, high=1e5)
    intrinsics_cy: float = _parameter(0.0, 'Principal point in pixels.', name='intrinsics.cy', low=-1e5, high=1e5)
    min_depth: float = _parameter(0.1, 'The node looks for hands from this distance on, in metres.', low=0.01,
                                  high=10.0)
    max_depth: float = _parameter(1.5, 'The node looks for hands up to this distance, in metres. The network that '
                                  'finds hands knows none beyond about 1.5 m. For hands further away, set detector to '
                                  'nearest.', low=0.05, high=10.0)
    cube_size: float = _parameter(0.0, 'Side of the cube around a hand, in metres; 0 = what the model was trained for.',
                                  low=0.0, high=1.0)
    side: str = _parameter('auto', 'Whether hands are left or right; auto finds out.',
                           choices=('auto', 'left', 'right'))
    max_hands: int = _parameter(2, 'Maximum number of hands per image. While at least one, but fewer than this, are '
                                'tracked, every fifth image takes longer, because the node searches it for more hands.',
                                low=1, high=8)
    min_score: float = _parameter(0.4, 'Hands with a lower score are not reported. If there is another hand already, a '
                                  'new hand must reach the square root of this value at first (0.63 for 0.4).', low=0.0,
                                  high=1.0)
    detector: str = _parameter('network', 'How new hands are found. network: a small network finds them. nearest: the '
                               'object nearest to the camera is taken, as in the paper. region: the network finds them '
                               'in the newest region of hand/region (sensor_msgs/RegionOfInterest, in pixels of the '
                               'depth image; a region without width or height means that there is no hand). Hands that '
                               'are already tracked stay tracked.', choices=('network', 'nearest', 'region'),
                               fixed=_CONFIGURED)
    tracking: bool = _parameter(True, 'Look first where the hands of the last image were. If false, the node searches '
                                'every image, hands get a new id in each image, and smoothing has no effect.')
    smoothing: float = _parameter(0.0, 'Cutoff in Hz of the filter on the joints, for a hand at rest; 0 = no filter.',
                                  low=0.0, high=30.0)
    target_frame: str = _parameter('', 'Frame of hand/joints and hand/poses; empty = the frame of the depth image. '
                                   'Needs tf2_ros. Markers and tf stay in the frame of the camera.', fixed=_CONFIGURED)
    publish_markers: bool = _parameter(True, 'Publish hand/markers (only while somebody subscribes to it).')
    marker_lifetime: float = _parameter(0.5, 'Seconds after which a viewer removes the markers if the node has died; 0 '
                                        '= never. The markers of a lost hand are deleted at once.', low=0.0, high=60.0)
    publish_poses: bool = _parameter(False, 'Publish hand/poses (geometry_msgs/PoseArray): the joints of all hands, in '
                                     'the order of the skeleton, without rotation.', fixed=_CONFIGURED)
    publish_joint_states: bool = _parameter(False, 'Publish hand/joint_states (sensor_msgs/JointState) while there are '
                                            'hands: finger angles in radians, for example of r_index_mcp_flexion. '
                                            'Needs a model with the joints of hand21.', fixed=_CONFIGURED)
    publish_tf: bool = _parameter(False, 'Publish a frame for each joint on /tf, for example r_index_tip. Needs '
                                  'tf2_msgs.', fixed=_CONFIGURED)
    publish_diagnostics: bool = _parameter(True, 'Publish /diagnostics once a second.')
    autostart: bool = _parameter(True, 'Configure and activate at start. If false, the node waits for lifecycle '
                                 'transitions.', fixed=_ALWAYS)

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
        """Whether the user sets any of the intrinsics. `ros2 param set` can only set them one after the other."""
        return any((self.intrinsics_fx, self.intrinsics_fy, self.intrinsics_cx, self.intrinsics_cy))

    def make_estimator(self) -> HandPoseEstimator:
        """Load the network and warm it up.

        Raises:
            HandPoseError: the weights or the device do not exist.
        """
        from hand_pose_ros.estimator import HandPoseEstimator  # imports torch, which neither help nor the viewer needs
        estimator = HandPoseEstimator.from_pretrained(
            self.model or None, device=self.device, num_threads=self.num_threads or None,
            detector='nearest' if self.detector == 'nearest' else 'network')
        estimator.warm_up()
        return estimator

    def apply(self, estimator: HandPoseEstimator) -> None:
        """Pass on the parameters that may change between two images."""
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
        HandPoseError: a value has another type, is out of range or not among the choices, or two values contradict
            each other.
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
    """Names of the parameters that were given at start, but that nobody has declared so far."""
    return [name for name in _overrides(node) if not node.has_parameter(name)]


def _overrides(node: Node) -> dict[str, Parameter]:
    """The parameters that were given at start. rclpy has no public way to get them."""
    return getattr(node, '_parameter_overrides', {})


def changed(params: Params, changes: Sequence[Parameter], *, configured: bool) -> Params:
    """The parameters after a change at run time. Names that are not ours (qos_overrides, use_sim_time) are ignored.

    Raises:
        HandPoseError: the change is refused. The message says why.
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
    """All parameters with their defaults, as a ROS 2 parameter file: the content of config/estimator.yaml."""
    lines = ['# Parameters of the node `estimator` with their defaults. Ranges: hand-pose estimator --parameters',
             '/**:', '  ros__parameters:']
    for row in fields(Params):
        value = json.dumps(row.default)  # JSON is also YAML
        lines += textwrap.wrap(row.metadata['description'], 100, initial_indent='    # ', subsequent_indent='    # ')
        lines += [f'    {ros_name(row)}: {value}']
    return '\n'.join(lines) + '\n'
