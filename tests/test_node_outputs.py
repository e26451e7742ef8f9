"""What the node publishes besides joints and markers when asked to, and hands that are looked for where it is told."""

# ruff: noqa: F811 (a fixture from another file is imported, and then an argument)

import sys
from array import array
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')

import rclpy
from geometry_msgs.msg import Point, PoseArray, TransformStamped
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState, RegionOfInterest
from std_msgs.msg import Header
from std_srvs.srv import SetBool
from test_node import (  # noqa: F401 (fixtures)
    FOCAL,
    HEIGHT,
    LATCHED,
    RELIABLE,
    WIDTH,
    Rig,
    camera_info,
    depth_with_hand,
    image,
    rig,
    stamp_of,
    stamped,
)
from visualization_msgs.msg import MarkerArray

from hand_pose_ros.angles import ANGLES, finger_angles
from hand_pose_ros.depth import decode_image, encode_compressed
from hand_pose_ros.estimator import HandEstimate
from hand_pose_ros.geometry import Cube, Intrinsics, crop
from hand_pose_ros.models import build
from hand_pose_ros.models.checkpoints import save_checkpoint
from hand_pose_ros.msg import HandJoints, HandJointsArray
from hand_pose_ros.ros.conversions import (
    hands_to_msg,
    in_frame,
    joint_states_to_msg,
    prefixes,
    transforms_to_msgs,
)
from hand_pose_ros.ros.outputs import Outputs
from hand_pose_ros.ros.params import Params
from hand_pose_ros.ros.watch import _Watcher, watch
from hand_pose_ros.skeleton import HAND21

pytestmark = pytest.mark.usefixtures('ros_domain', 'load_once')


def xyz(points) -> np.ndarray:
    return np.array([(p.x, p.y, p.z) for p in points])


def listen(rig: Rig, kind: type, topic: str) -> list:
    """The list of what will be received, connected: what is published before that is lost."""
    rig.listen(kind, topic, RELIABLE)
    outputs = [pub for pub in rig.node._outputs._publishers if pub.topic_name == '/' + topic.removeprefix('/')]
    rig.until(lambda: outputs[0].get_subscription_count() == 1, topic)
    return rig.received[kind]


def two_hands(left: float, right: float) -> np.ndarray:
    """(H, W) metres: two hand-sized discs at these distances, 0.3 m apart."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    depth = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    for z, x in ((left, -0.17), (right, 0.17)):
        depth[np.hypot(u - WIDTH / 2 - x * FOCAL / z, v - HEIGHT / 2) < 0.05 * FOCAL / z] = z
    return depth


def estimate(side: str = 'right', name: str = 'hand_1', seed: int = 0) -> HandEstimate:
    joints = np.random.default_rng(seed).normal((0, 0, 0.5), 0.05, (21, 3)).astype(np.float32)
    return HandEstimate(joints, HAND21.joint_names, np.ones(21, np.float32), 0.9, side, Cube((0, 0, 0.5), 0.3), name)


# ------------------------------------------------------------------------------------------------------------ messages

def test_names_tell_the_side_and_are_never_the_same() -> None:
    hands = [estimate('right', 'a'), estimate('left', 'b'), estimate('right', 'c'), estimate('unknown', 'd')]
    assert prefixes(hands) == ['r_', 'l_', 'c_', 'd_']
    states = joint_states_to_msg(Header(), hands)
    assert len(states.name) == len(set(states.name)) == len(states.position) == 3 * len(ANGLES)
    assert states.position[states.name.index('l_index_mcp_flexion')] == pytest.approx(
        finger_angles(hands[1].joints, 'left')[ANGLES.index('index_mcp_flexion')])
    assert not any(name.startswith('d_') for name in states.name)


def test_a_frame_for_each_joint() -> None:
    hand = estimate('left')
    messages = {m.child_frame_id: m for m in transforms_to_msgs(Header(frame_id='camera'), [hand])}
    assert list(messages) == [f'l_{name}' for name in HAND21.joint_names]
    tip = messages['l_index_tip']
    assert tip.header.frame_id == 'camera' and tip.transform.rotation.w == 1
    beside = transforms_to_msgs(Header(), [hand], '/left')  # two nodes must not be two parents of one frame
    assert beside[0].child_frame_id == 'left/l_wrist'
    np.testing.assert_allclose(xyz([tip.transform.translation])[0], hand.joints[8])


def turned() -> TransformStamped:
    """From the camera into a frame in which its z is x, its x is -y and its y is -z (REP-103), 2 m up."""
    transform = TransformStamped(header=Header(frame_id='base_link'))
    transform.transform.translation.z = 2.0
    q = transform.transform.rotation
    q.x, q.y, q.z, q.w = -0.5, 0.5, -0.5, 0.5
    return transform


def test_hands_in_another_frame() -> None:
    before = hands_to_msg(Header(frame_id='camera'), [estimate()], HAND21)
    before.header.stamp.sec = 5
    after = in_frame(before, turned())
    x, y, z = xyz(before.hands[0].joints).T
    np.testing.assert_allclose(xyz(after.hands[0].joints), np.stack([z, -x, 2 - y], 1), atol=1e-12)
    np.testing.assert_allclose(xyz([after.hands[0].cube_center]), [(0.5, 0, 2)], atol=1e-12)
    assert (after.header.frame_id, after.header.stamp.sec, before.header.frame_id) == ('base_link', 5, 'camera')
    assert after.skeleton == 'hand21'
    for field in ('id', 'side', 'score', 'confidence', 'cube_size'):
        assert getattr(after.hands[0], field) == getattr(before.hands[0], field)


# ------------------------------------------------------------------------------------------------------------ the node

def test_nothing_else_is_offered_unless_asked_for(rig: Rig) -> None:
    rig.start()
    topics = {topic for topic, _ in rig.node.get_publisher_names_and_types_by_node('estimator', '/')}
    assert not topics & {'/hand/poses', '/hand/joint_states', '/tf'} and '/hand/joints' in topics


def test_poses_angles_and_the_crop(rig: Rig) -> None:
    rig.start(publish_poses=True, publish_joint_states=True, side='right')
    all_poses, all_states = listen(rig, PoseArray, 'hand/poses'), listen(rig, JointState, 'hand/joint_states')
    publish = rig.camera(info=camera_info())
    hand = rig.answer(publish, image(depth_with_hand(), 5)).hands[0]
    rig.until(lambda: all_poses and all_states, 'poses and angles')
    poses, states = all_poses[0], all_states[0]
    assert stamp_of(poses) == stamp_of(states) == 5 and poses.header.frame_id == 'camera_optical'
    np.testing.assert_array_equal(xyz(pose.position for pose in poses.poses), xyz(hand.joints))
    assert {pose.orientation.w for pose in poses.poses} == {1.0}
    assert list(states.name) == [f'r_{angle}' for angle in ANGLES]
    np.testing.assert_allclose(states.position, finger_angles(xyz(hand.joints), 'right'), atol=1e-6)

    crops = listen(rig, Image, 'estimator/debug/crop')
    hand = rig.answer(publish, image(depth_with_hand(), 6)).hands[0]
    rig.until(lambda: crops and stamp_of(crops[-1]) == 6, 'the crop')
    patch = crops[-1]
    assert (patch.width, patch.height, patch.encoding, patch.step) == (128, 128, '32FC1', 4 * 128)
    assert patch.is_bigendian == (sys.byteorder == 'big')
    cube = Cube(tuple(xyz([hand.cube_center])[0].tolist()), hand.cube_size)
    intrinsics = Intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    seen = crop(decode_image(image(depth_with_hand())), cube, intrinsics)
    np.testing.assert_allclose(np.frombuffer(patch.data, np.float32).reshape(seen.shape), seen, atol=1e-5)

    empty = rig.answer(publish, image(np.full((HEIGHT, WIDTH), 3.0), 7))
    rig.until(lambda: stamp_of(all_poses[-1]) == 7, 'no poses')
    assert empty.hands == [] and all_poses[-1].poses == []
    rig.answer(publish, image(depth_with_hand(), 8))
    rig.until(lambda: stamp_of(crops[-1]) == stamp_of(all_states[-1]) == 8, 'the next crop and angles')
    assert not {7} & {stamp_of(message) for message in (*crops, *all_states)}
    assert not rig.node._statistics._totals['refused']


@pytest.mark.parametrize('skeleton, joints', [('nyu14', 14), ('msra21', 21)])
def test_angles_need_the_joints_of_hand21(rig: Rig, tmp_path, skeleton: str, joints: int) -> None:
    path = tmp_path / 'other.safetensors'
    save_checkpoint(path, build('deep_prior', joints=joints), {'skeleton': skeleton, 'cube_side': 0.3})
    rig.start(publish_joint_states=True, model=str(path))
    rig.until_said('publish_joint_states', 'hand21', skeleton)
    assert rig.state() == 'unconfigured' and rig.set_parameter('publish_joint_states', False)[0]
    assert rig.transition('configure') and rig.transition('activate')
    answer = rig.answer(rig.camera(info=camera_info()), image(depth_with_hand()))
    assert (answer.skeleton, len(answer.hands[0].joints)) == (skeleton, joints)


@pytest.mark.parametrize('parameter, value, package', [
    ('target_frame', 'base_link', 'tf2_ros'), ('publish_tf', True, 'tf2_msgs')])
def test_where_there_is_no_tf_it_is_said_and_the_rest_works(
        rig: Rig, monkeypatch: pytest.MonkeyPatch, parameter: str, value: object, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)  # also where it is installed
    rig.start(**{parameter: value})
    rig.until_said(parameter, package, 'not installed')
    assert rig.state() == 'unconfigured'
    assert rig.set_parameter(parameter, type(value)())[0]
    assert rig.transition('configure') and rig.transition('activate')
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands


def test_frames_of_the_joints_on_tf(rig: Rig) -> None:
    tf2_msgs = pytest.importorskip('tf2_msgs.msg', reason='ROS from wheels has no tf2_msgs')
    rig.start(publish_tf=True, side='left')
    frames = listen(rig, tf2_msgs.TFMessage, '/tf')
    publish = rig.camera(info=camera_info())
    hand = rig.answer(publish, image(depth_with_hand(), 5)).hands[0]
    rig.until(lambda: frames, 'frames')
    transforms = frames[0].transforms
    assert [t.child_frame_id for t in transforms] == [f'l_{name}' for name in HAND21.joint_names]
    assert {(stamp_of(t), t.header.frame_id) for t in transforms} == {(5, 'camera_optical')}
    np.testing.assert_array_equal(xyz(t.transform.translation for t in transforms), xyz(hand.joints))
    rig.answer(publish, image(depth_with_hand(), 6, frame=''))
    rig.until_said('frame_id', 'empty', 'tf')


def test_what_goes_to_tf_and_when(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in for tf2_msgs, which has no wheels, and for the node."""
    sent: dict[str, list] = {}
    stand_in = ModuleType('tf2_msgs.msg')
    stand_in.TFMessage = SimpleNamespace
    monkeypatch.setitem(sys.modules, 'tf2_msgs', ModuleType('tf2_msgs'))
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', stand_in)

    def create(kind: type, topic: str, _: object) -> SimpleNamespace:
        return SimpleNamespace(publish=sent.setdefault(topic, []).append, msg_type=kind,
                               get_subscription_count=lambda: 1)

    said: list[str] = []
    params = Params(publish_tf=True, publish_markers=False)
    outputs = Outputs(SimpleNamespace(create_lifecycle_publisher=create, get_namespace=lambda: '/left'),
                      SimpleNamespace(skeleton=HAND21, metadata={}), params, said.append)
    for frame, hands in (('camera', [estimate()]), ('camera', []), ('', []), ('', [estimate()])):
        outputs.publish_others(Header(frame_id=frame), hands, np.zeros((HEIGHT, WIDTH), np.float32),
                               Intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT), params)
        assert len(said) == (frame == '' and len(hands))
    assert 'frame_id of the depth image is empty' in said[0]
    [frames] = sent['/tf']  # of all nodes, whatever their namespace
    assert [t.child_frame_id for t in frames.transforms] == [f'left/r_{name}' for name in HAND21.joint_names]
    assert len(sent['~/debug/crop']) == 2 and not sent['hand/markers']


def test_joints_in_the_target_frame(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in for tf2_ros, which has no wheels: what it is asked, and what is made of its answer."""
    asked: list[tuple] = []
    stand_in = ModuleType('tf2_ros')
    stand_in.TransformException = type('TransformException', (Exception,), {})

    class Buffer:
        def lookup_transform(self, target, source, when, timeout):
            assert timeout.nanoseconds > 0  # the transform may come a little later than the image
            asked.append((target, source, when.nanoseconds))
            if source == 'lost':
                raise stand_in.TransformException('two unconnected trees')
            return turned()

        def clear(self):
            asked.append(('cleared',))

    stand_in.Buffer = Buffer
    stand_in.TransformListener = lambda buffer, node: SimpleNamespace(unregister=lambda: asked.append(('closed',)))
    monkeypatch.setitem(sys.modules, 'tf2_ros', stand_in)
    rig.start(target_frame='base_link', tracking=False, publish_poses=True)
    poses = listen(rig, PoseArray, 'hand/poses')
    publish = rig.camera(RELIABLE, info=camera_info())
    there = rig.answer(publish, image(depth_with_hand(), 207))
    assert asked == [('base_link', 'camera_optical', 207_000_000)] and there.header.frame_id == 'base_link'
    center = xyz([there.hands[0].cube_center])[0]
    assert center == pytest.approx((0.6, 0, 2), abs=0.15)
    rig.until(lambda: poses, 'poses')
    assert poses[0].header.frame_id == 'base_link'
    markers = rig.received[MarkerArray]
    rig.until(lambda: markers, 'markers')
    shown = len(markers)
    publish(image(depth_with_hand(), 208, frame='lost'))
    rig.until_said('lost', 'base_link', 'two unconnected trees')
    rig.until(lambda: len(markers) > shown, 'markers, which are in the frame of the camera')
    assert stamp_of(rig.answer(publish, image(depth_with_hand(), 209))) == 209
    assert [stamp_of(answer) for answer in rig.received[HandJointsArray]] == [207, 209]
    assert ('cleared',) not in asked
    assert stamp_of(rig.answer(publish, image(depth_with_hand(), 3))) == 3  # a bag began again
    assert asked.count(('cleared',)) == 1
    assert stamp_of(rig.answer(publish, image(depth_with_hand(), 210))) == 210
    for enabled in (False, True):  # and once more, while nobody looked
        assert rig.call(SetBool, 'enable', data=enabled).success
    assert stamp_of(rig.answer(rig.camera(RELIABLE, info=camera_info()), image(depth_with_hand(), 4))) == 4
    assert asked.count(('cleared',)) == 2
    assert rig.transition('deactivate') and rig.transition('cleanup') and asked[-1] == ('closed',)


def test_hands_are_looked_for_in_the_region_that_is_given(rig: Rig) -> None:
    rig.start('hand/region:=/where/hands/are', detector='region', tracking=False)
    publish = rig.camera(info=camera_info())
    scene = image(two_hands(left=0.55, right=0.65))
    assert rig.answer(publish, scene).hands == []
    rig.until_said('no region arrived on /where/hands/are', 'detector')
    regions = rig.client.create_publisher(RegionOfInterest, '/where/hands/are', RELIABLE)
    rig.connected(regions)

    def found(region: RegionOfInterest) -> list[float]:
        regions.publish(region)
        wanted = [(region.x_offset, region.y_offset, region.width, region.height)]
        rig.until(lambda: rig.node._regions == wanted, 'the region')
        return [hand.cube_center.x for hand in rig.answer(publish, scene).hands]

    half = WIDTH // 2
    [x] = found(RegionOfInterest(x_offset=half, width=half, height=HEIGHT))
    assert x > 0.1
    [x] = found(RegionOfInterest(width=half, height=HEIGHT))
    assert x < -0.1
    assert found(RegionOfInterest()) == [] and not any('begins at' in text for text in rig.said())
    assert found(RegionOfInterest(x_offset=WIDTH, width=half, height=HEIGHT)) == []
    rig.until_said(f'the region on /where/hands/are begins at pixel ({WIDTH}, 0), outside of the image')
    assert found(RegionOfInterest(x_offset=2**32 - 1, y_offset=2**32 - 1, width=2**32 - 1, height=2**32 - 1)) == []
    assert len(found(RegionOfInterest(width=2**32 - 1, height=2**32 - 1))) == 2
    for enabled in (False, True):  # the newest holds until the next, also then
        assert rig.call(SetBool, 'enable', data=enabled).success
    assert len(rig.answer(rig.camera(), scene).hands) == 2
    assert not rig.set_parameter('detector', 'nearest')[0]


def test_two_hands_keep_their_ids_whichever_is_nearer(rig: Rig) -> None:
    rig.start(max_hands=2)
    publish = rig.camera(info=camera_info())
    names = []
    for i, (left, right) in enumerate([(0.60, 0.64), (0.61, 0.62), (0.62, 0.60), (0.64, 0.59)]):
        hands = rig.answer(publish, image(two_hands(left, right), 1000 + 33 * i)).hands
        assert len(hands) == 2
        names.append([hand.id for hand in sorted(hands, key=lambda hand: hand.cube_center.x)])
    assert len(set(names[0])) == 2 and names == [names[0]] * 4
    one = rig.answer(publish, image(np.where(np.arange(WIDTH) < WIDTH / 2, two_hands(0.64, 0.59), 3.0), 1200)).hands
    assert [hand.id for hand in one] == names[0][:1]
    back = rig.answer(publish, image(two_hands(0.64, 0.59), 1233)).hands
    assert len(back) == 2 and back[0].id == names[0][0] and back[1].id not in names[0]


def test_what_is_live_is_shown_with_a_camera_info_that_was_published_once_before(rig: Rig) -> None:
    rig.client.create_publisher(CameraInfo, 'depth/camera_info', LATCHED).publish(camera_info())
    publish = rig.client.create_publisher(Image, 'depth/image_rect', RELIABLE).publish
    cameras: list[Intrinsics] = []
    rclpy.init()
    try:
        watcher = _Watcher(lambda _, __, camera: cameras.append(camera), lambda *_: None, 'raw', 0.001)

        def shown() -> bool:  # the first images may come before it
            publish(image(depth_with_hand()))
            rclpy.spin_once(watcher._node, timeout_sec=0.05)
            return bool(cameras)
        rig.until(shown, 'a depth image')
        listeners = len(list(watcher._node.subscriptions))
        watcher._listen_to_latched()  # which it does each second
        assert len(list(watcher._node.subscriptions)) == listeners
        watcher._node.destroy_node()
    finally:
        rclpy.try_shutdown()
    assert cameras[0].fx == FOCAL


def test_what_is_live_is_shown_until_ros_ends(rig: Rig) -> None:
    layout, data = encode_compressed(depth_with_hand())
    picture = stamped(CompressedImage(format=layout, data=array('B', data)), 1234)
    hands = hands_to_msg(picture.header, [estimate()], HAND21)
    topics = {'/front/depth/image/compressedDepth': picture, '/front/depth/camera_info': camera_info(),
              '/hand/joints': hands}
    publishers = [rig.client.create_publisher(type(message), topic, RELIABLE) for topic, message in topics.items()]
    depths, shown, rounds = [], [], iter(range(1200))  # a minute at most

    def publish() -> None:
        for publisher, message in zip(publishers, topics.values(), strict=True):
            publisher.publish(message)
        if (depths and shown) or next(rounds, None) is None:
            rclpy.try_shutdown()

    rig.client.create_timer(0.05, publish)
    watch(lambda *seen: depths.append(seen), lambda *seen: shown.append(seen), 'compressedDepth', 0.002,
          ros_args=['-r', 'depth/image_rect:=/front/depth/image'])
    stamp, depth, camera = depths[0]
    assert (stamp, camera.fx) == (1_234_000_000, FOCAL)
    np.testing.assert_allclose(depth, 2 * depth_with_hand(), atol=0.002)
    stamp, [hand], skeleton = shown[0]
    assert (stamp, skeleton) == (1_234_000_000, HAND21)
    np.testing.assert_array_equal(hand.joints, estimate().joints)


def test_what_is_live_is_shown_with_intrinsics_that_are_given():
    rclpy.init()
    try:
        cameras, said = [], []
        for given in (None, (500.0, 501.0, 80.0, 60.0)):
            watcher = _Watcher(lambda _, __, camera: cameras.append(camera), lambda *_: None, 'raw', 0.001, given)
            watcher._complain = said.append
            watcher._image(image(depth_with_hand()))
            watcher._node.destroy_node()
    finally:
        rclpy.try_shutdown()
    assert [(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras] == [given]
    assert len(said) == 1 and 'no camera_info arrived' in said[0] and 'give --intrinsics' in said[0]


def test_hands_that_do_not_fit_are_not_shown_live():
    rclpy.init()
    try:
        shown, said = [], []
        watcher = _Watcher(lambda *_: None, lambda *hands: shown.append(hands), 'raw', 0.001)
        watcher._node.get_logger = lambda: SimpleNamespace(warning=said.append)
        picture = image(depth_with_hand(), 1000)
        watcher._image(picture)
        message = HandJointsArray(header=picture.header, skeleton='hand21')
        watcher._hands(message)
        message.hands = [HandJoints(joints=[Point()] * 20, confidence=[1.0] * 20, cube_size=0.3)]
        for _ in range(3):  # which is said once
            watcher._hands(message)
        message.header.frame_id = 'base_link'
        watcher._hands(message)
        message.skeleton = 'paw'
        watcher._hands(message)
        watcher._node.destroy_node()
    finally:
        rclpy.try_shutdown()
    assert len(shown) == 1 and len(said) == len(set(said))
    assert 'a hand has 20 joints and 20 confidences, but hand21 has 21' in said[-3]
    assert "in frame 'base_link', but the images in" in said[-2] and 'paw' in said[-1]
