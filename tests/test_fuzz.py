"""Whatever arrives on a topic is answered or refused in one sentence, with real messages whose fields are checked.

    pytest tests/test_fuzz.py                                          # a glance, in seconds
    HAND_POSE_FUZZ=20000 pytest tests/test_fuzz.py --timeout 0 --hypothesis-show-statistics    # 20,000 cases per test

Half of the cases are sound messages in which some fields or bytes are replaced, for pure noise is refused at the door.
"""

import os
import re
import resource
import struct
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')

import rclpy
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, RegionOfInterest
from visualization_msgs.msg import MarkerArray

from hand_pose_ros.depth import (
    DEPTH_ENCODINGS,
    decode_compressed,
    decode_image,
    encode_rvl,
)
from hand_pose_ros.errors import InputError
from hand_pose_ros.msg import HandJointsArray
from hand_pose_ros.ros.camera import Camera
from hand_pose_ros.ros.node import EstimatorNode
from hand_pose_ros.ros.params import Params

FUZZ = settings(max_examples=int(os.environ.get('HAND_POSE_FUZZ', '200')), deadline=None,
                suppress_health_check=list(HealthCheck))
TOPIC, INFO_TOPIC = '/depth/image_rect', '/depth/camera_info'
ALLOCATION = 512 << 20
"""Bytes that decoding may take: many for the largest image, far from those that a corrupt size can claim."""

UINT32 = st.integers(0, 40) | st.integers(0, 2**32 - 1)
FLOATS = st.floats() | st.sampled_from([0.0, 1.0, 1e-300, 1e-30, 1e30, 1e300])


def harm(draw: st.DrawFn, message: Any, fields: dict[str, st.SearchStrategy]) -> Any:
    """Replace some fields, or none, by anything that fits into them."""
    for name in draw(st.just([]) | st.lists(st.sampled_from(sorted(fields)), max_size=3)):
        setattr(message, name, draw(fields[name]))
    return message


@st.composite
def headers(draw: st.DrawFn, message: Any) -> Any:
    message.header.stamp.sec = draw(st.integers(-2**31, 2**31 - 1) | st.integers(0, 3))
    message.header.stamp.nanosec = draw(UINT32)
    message.header.frame_id = draw(st.sampled_from(['camera', '']) | st.text(max_size=10))
    return message


def scene(draw: st.DrawFn) -> np.ndarray:
    """(H, W) uint16 millimetres: a hand-sized disc, or any pattern."""
    height, width = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    if draw(st.booleans()):
        v, u = np.mgrid[:height, :width]
        z, noise = draw(st.sampled_from([500, 600]) | st.integers(1, 3000)), draw(st.integers(0, 300))
        disc = np.hypot(u - width / 2, v - height / 2) < draw(st.integers(3, 12))
        rng = np.random.default_rng(draw(st.integers(0, 99)))
        return (np.where(disc, z, 3000) + rng.integers(0, noise + 1, disc.shape)).astype(np.uint16)
    pattern = draw(st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=30))
    return np.resize(np.array(pattern, np.uint16), (height, width))


@st.composite
def images(draw: st.DrawFn) -> Image:
    pixels, encoding = scene(draw), draw(st.sampled_from([*DEPTH_ENCODINGS]))
    if encoding == '32FC1':
        pixels = (pixels * np.float32(0.001)).astype(np.float32)
        for value in draw(st.lists(st.floats(width=32), max_size=3)):
            pixels.flat[draw(st.integers(0, pixels.size - 1))] = value
    big = draw(st.integers(0, 255))
    rows = pixels.astype(pixels.dtype.newbyteorder('>' if big else '<')).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, draw(st.sampled_from([0, 0, 1, 3])))), constant_values=0xAB)
    message = Image(height=pixels.shape[0], width=pixels.shape[1], step=rows.shape[1], encoding=encoding,
                    is_bigendian=big, data=array('B', rows.tobytes()))
    return harm(draw, draw(headers(message)), {
        'height': UINT32, 'width': UINT32, 'step': UINT32, 'is_bigendian': st.integers(0, 255),
        'encoding': st.sampled_from([*DEPTH_ENCODINGS, '', 'rgb8', '8UC1', '16SC1', '64FC1', ' 16UC1']) | st.text(),
        'data': st.binary(max_size=500).map(lambda data: array('B', data))})


@st.composite
def compressed_images(draw: st.DrawFn) -> CompressedImage:
    units, codec = scene(draw), draw(st.sampled_from(['png', 'rvl', 'tiff']))
    payload = bytearray(encode_rvl(units) if codec == 'rvl' else cv2.imencode(f'.{codec}', units)[1].tobytes())
    for _ in range(draw(st.sampled_from([0, 0, 0, 1, 2]))):  # damage, from single bits to sizes that claim memory
        at, change = draw(st.integers(0, len(payload) - 1)), draw(st.binary(min_size=1, max_size=8))
        payload[at:at + len(change)] = change
    if draw(st.integers(0, 5)) == 0:
        payload = payload[:draw(st.integers(0, len(payload)))] + draw(st.binary(max_size=20))
    sound = struct.pack('<iff', 0, 10100.0, -1009.0)
    header = draw(st.sampled_from([b''] if codec == 'tiff' else [b'', sound, sound, sound])
                  | st.tuples(*[st.floats(width=32)] * 2).map(lambda values: struct.pack('<iff', 0, *values)))
    formats = [f'{encoding}; {transport}' for encoding in DEPTH_ENCODINGS for transport in (
        f'{codec} compressed' if codec == 'tiff' else f'compressedDepth {codec}',
        'compressedDepth', 'compressedDepth ', f'{codec} compressed ', '')]
    message = CompressedImage(format=draw(st.just(formats[0]) | st.sampled_from(formats)),
                              data=array('B', header + payload))
    return harm(draw, draw(headers(message)), {
        'format': st.text() | st.sampled_from(['', 'jpeg', ';', '16UC1', 'rgb8; jpeg compressed bgr8', *formats]),
        'data': st.binary(max_size=200).map(lambda data: array('B', data))})


@st.composite
def camera_infos(draw: st.DrawFn, height: int, width: int) -> CameraInfo:
    """For an image of this size, more or less."""
    k, focal = [0.0] * 9, draw(st.sampled_from([50.0, 80.0]) | st.floats(5, 500))
    k[0], k[2], k[4], k[5], k[8] = focal, width / 2, focal, height / 2, 1.0
    binning = draw(st.integers(0, 3))
    scale = max(binning, 1)
    message = CameraInfo(height=height * scale, width=width * scale, k=k, binning_x=binning, binning_y=binning)
    if draw(st.booleans()):
        message.p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    return harm(draw, draw(headers(message)), {
        'height': UINT32, 'width': UINT32, 'binning_x': UINT32, 'binning_y': UINT32,
        'k': st.lists(FLOATS, min_size=9, max_size=9), 'p': st.lists(FLOATS, min_size=12, max_size=12),
        'd': st.lists(FLOATS, max_size=8), 'distortion_model': st.text(max_size=8),
        'roi': st.builds(RegionOfInterest, x_offset=UINT32, y_offset=UINT32, width=UINT32, height=UINT32,
                         do_rectify=st.booleans())})


def is_explained(error: str, *topics: str) -> bool:
    """One sentence that begins with the topic that it is about, and says more than that."""
    return '\n' not in error.strip() and any(re.match(rf'{topic}: .{{20}}|.*{topic}.{{20}}', error) for topic in topics)


def assert_clean(depth: np.ndarray) -> None:
    assert depth.dtype == np.float32 and depth.flags.c_contiguous and depth.flags.writeable
    assert np.isfinite(depth).all() and (depth >= 0).all()


def decoded_or_explained(decode: Callable[..., np.ndarray], message: Any) -> np.ndarray | None:
    try:
        depth = decode(message, source=TOPIC)
    except InputError as error:
        assert is_explained(str(error), TOPIC)
        event('refused')
        return None
    event('decoded')
    assert_clean(depth)
    return depth


@pytest.fixture
def limited_memory() -> Iterator[None]:
    """Not a limit of the system: OpenCV would report that as a damaged image, and hide who asked for so much."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < ALLOCATION


@FUZZ
@given(message=images())
def test_images(limited_memory: None, message: Image) -> None:
    depth = decoded_or_explained(decode_image, message)
    if depth is None:
        return
    assert depth.shape == (message.height, message.width)
    kind = ('>' if message.is_bigendian else '<') + ('f' if message.encoding == '32FC1' else 'H')
    for v, u in ((0, 0), (message.height // 2, message.width // 2), (message.height - 1, message.width - 1)):
        [value] = struct.unpack_from(kind, message.data, v * message.step + u * struct.calcsize(kind))
        value = value * 0.001 if kind[1] == 'H' else value if np.finfo(np.float32).tiny <= value < np.inf else 0
        assert depth[v, u] == pytest.approx(value, rel=1e-6)


@FUZZ
@given(message=compressed_images())
def test_compressed_images(limited_memory: None, message: CompressedImage) -> None:
    depth = decoded_or_explained(decode_compressed, message)
    if depth is None:
        return
    words, data = message.format.replace(';', ' ').split(), bytes(message.data)
    if 'tiff' in words:  # which tells its size anywhere
        return
    start = 0 if data[:8] == b'\x89PNG\r\n\x1a\n' else 12
    kind, start = ('<II', start) if 'rvl' in words else ('>II', start + 16)
    width, height = struct.unpack_from(kind, data, start)
    assert depth.shape == (height, width), 'another size than the image itself says'


@FUZZ
@given(message=camera_infos(480, 640), rectified=st.booleans())
def test_camera_infos(message: CameraInfo, rectified: bool) -> None:
    camera = Camera(INFO_TOPIC)
    camera.update(message)
    try:
        intrinsics = camera.intrinsics(640, 480, Params(camera_info_timeout=0.0, use_rectified=rectified))
    except InputError as error:
        assert is_explained(str(error), INFO_TOPIC)
        event('refused')
        return
    event('used')
    assert (intrinsics.width, intrinsics.height) == (640, 480) and intrinsics.fx > 0 and intrinsics.fy > 0
    assert np.isfinite([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]).all()


@pytest.fixture(params=['raw', 'compressedDepth'])
def node(request: pytest.FixtureRequest, weights: Path, ros_domain: int) -> Iterator[EstimatorNode]:
    """A node that is called directly, as DDS would not let half of the messages through, and answers into `said`."""
    context = rclpy.Context()
    context.init(domain_id=ros_domain)
    values = {'model': str(weights), 'min_score': 0.0, 'camera_info_timeout': 0.0, 'max_hands': 2, 'smoothing': 1.0,
              'num_threads': 1, 'publish_poses': True, 'publish_joint_states': True, 'transport': request.param}
    node = EstimatorNode(context=context, namespace='/fuzz',
                         parameter_overrides=[Parameter(name, value=value) for name, value in values.items()])
    for kind, topic in ((MarkerArray, 'hand/markers'), (Image, '~/debug/crop')):  # made for listeners only
        node.create_subscription(kind, topic, lambda _: None, 1)
    node.said = []
    publish = node._outputs._joints_pub.publish
    node._outputs._joints_pub.publish = lambda message: (node.said.append(message), publish(message))
    yield node
    node.destroy_node()
    context.shutdown()


@FUZZ
@given(data=st.data())
def test_the_node(node: EstimatorNode, data: st.DataObject) -> None:
    """Each image is answered or refused, and never by an error that nobody thought of."""
    message = data.draw(images() if node._image_type is Image else compressed_images())
    if data.draw(st.integers(0, 9)):
        try:
            size = node._decode(message).shape
        except InputError:
            size = 20, 20
        node._on_camera_info(data.draw(camera_infos(*size)))
    node._estimator.reset()
    node.said.clear()
    for _ in range(2):  # a hand that was found is tracked in the second
        before, totals = dict(node._statistics._totals), node._statistics._totals
        node._statistics._window.problem = ''
        node._answer(message)
        problem = node._statistics._window.problem
        assert totals['answered'] + totals['refused'] == before.get('answered', 0) + before.get('refused', 0) + 1
        assert not problem or is_explained(problem, node._image_topic, node._camera.topic), problem
    event(f'{len(node.said[0].hands)} hands' if node.said else 'refused')
    assert len(node.said) in (0, 2)
    for answer in node.said:
        assert isinstance(answer, HandJointsArray) and answer.header == message.header
        for hand in answer.hands:
            joints = np.array([(joint.x, joint.y, joint.z) for joint in hand.joints])
            assert joints.shape == (21, 3) and np.isfinite(joints).all() and np.abs(joints).max() < 500
            assert len(hand.confidence) == 21 and all(0 <= c <= 1 for c in hand.confidence) and 0 <= hand.score <= 1
