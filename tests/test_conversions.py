"""Messages, markers, camera models, topics and parameters, without a network in between."""

import importlib.util
from array import array
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor, wait
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')

import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from hand_pose_ros import markers as markers_module
from hand_pose_ros.conventions import stamp_ns
from hand_pose_ros.depth import depth_problem
from hand_pose_ros.drawing import FINGER_COLORS
from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.estimator import HandEstimate
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.markers import HandMarkers
from hand_pose_ros.resources import resource
from hand_pose_ros.ros import topics
from hand_pose_ros.ros.camera import Camera, Closed
from hand_pose_ros.ros.conversions import hand_from_msg, hands_to_msg, markers_to_msg, skeleton_to_msg
from hand_pose_ros.ros.diagnostics import MAX_AGE_S, MAX_KINDS, REPEAT_S, Complaints, Statistics
from hand_pose_ros.ros.params import Params, markdown_table, yaml_file
from hand_pose_ros.skeleton import HAND21


def header(seconds: int = 12, frame: str = 'camera') -> Header:
    message = Header(frame_id=frame)
    message.stamp.sec, message.stamp.nanosec = seconds, 34
    return message


def hand(name: str = 'hand_1', side: str = 'left', seed: int = 0) -> HandEstimate:
    rng = np.random.default_rng(seed)
    joints = rng.normal((0, 0, 0.5), 0.05, size=(21, 3)).astype(np.float32)
    return HandEstimate(joints, HAND21.joint_names, rng.random(21, np.float32), 0.75, side,
                        Cube((0.01, -0.02, 0.5), 0.3), name)


def test_an_estimate_survives_the_way_through_a_message() -> None:
    before = hand()
    message = hands_to_msg(header(), [before], HAND21)
    assert stamp_ns(message.header) == 12_000_000_034 and message.header.frame_id == 'camera'
    after = hand_from_msg(message.hands[0], HAND21)
    np.testing.assert_array_equal(after.joints, before.joints)
    np.testing.assert_array_equal(after.confidence, before.confidence)
    assert (after.side, after.id, after.score, after.joint_names) == ('left', 'hand_1', 0.75, HAND21.joint_names)
    assert after.cube.center == before.cube.center and after.cube.side == pytest.approx(0.3)
    message.hands[0].side = 9
    assert hand_from_msg(message.hands[0], HAND21).side == 'unknown'
    message.hands[0].confidence = [1.0] * 20
    with pytest.raises(InputError, match='a hand has 21 joints and 20 confidences'):
        hand_from_msg(message.hands[0], HAND21)


def test_the_skeleton_message_names_every_joint_and_its_parent() -> None:
    message = skeleton_to_msg(header(), HAND21, 'deep_prior', '1.0')
    assert message.joint_names[message.parents[message.joint_names.index('index_pip')]] == 'index_mcp'
    assert message.parents[message.joint_names.index('wrist')] == -1
    assert (message.name, message.model, message.model_version) == ('hand21', 'deep_prior', '1.0')
    assert message.header == header()


def test_markers_are_joints_and_bones_in_the_colours_of_the_fingers() -> None:
    estimate = hand()
    array_ = markers_to_msg(header(), HandMarkers(HAND21).update([estimate]), 0.5)
    markers = {marker.ns: marker for marker in array_.markers}
    joints, bones, cube = (markers[f'hand_1/{part}'] for part in ('joints', 'bones', 'cube'))
    assert all(marker.pose.orientation.w == 1 for marker in array_.markers)  # viewers warn of one that is all zero
    points = np.array([(p.x, p.y, p.z) for p in joints.points])
    np.testing.assert_allclose(points, estimate.joints, atol=1e-6)
    tip = HAND21.joint_names.index('pinky_tip')
    color = joints.colors[tip]
    np.testing.assert_allclose((color.r, color.g, color.b), np.array(FINGER_COLORS['pinky']) / 255, atol=1e-6)
    assert all(color.a > 0 for marker in markers.values() for color in marker.colors)  # else nothing is seen
    scale = joints.scale
    assert 0.005 < scale.x == scale.y == scale.z < 0.02 and 0 < cube.scale.x < bones.scale.x < scale.x
    ends = np.array([(p.x, p.y, p.z) for p in bones.points]).reshape(-1, 2, 3)
    np.testing.assert_allclose(ends, estimate.joints[np.array(HAND21.bones)], atol=1e-6)
    for (_, child), color in zip(HAND21.bones, bones.colors[::2], strict=True):  # of the finger that it leads to
        expected = np.array(FINGER_COLORS[HAND21.fingers[child]]) / 255
        np.testing.assert_allclose((color.r, color.g, color.b), expected, atol=1e-6)
    assert bones.colors[::2] == bones.colors[1::2]
    edges = np.array([(p.x, p.y, p.z) for p in cube.points]).reshape(-1, 2, 3)
    assert len(edges) == 12
    np.testing.assert_allclose(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1), 0.3, atol=1e-6)
    np.testing.assert_allclose(edges.reshape(-1, 3).mean(0), (0.01, -0.02, 0.5), atol=1e-6)
    for marker in markers.values():
        assert marker.pose.orientation.w == 1 and marker.lifetime.nanosec == 500_000_000
        assert len(marker.colors) in (0, len(marker.points)) and marker.header.frame_id == 'camera'


def test_only_the_hand_that_is_gone_is_deleted() -> None:
    markers = HandMarkers(HAND21)
    markers.update([hand('a'), hand('b')])
    second = markers_to_msg(header(), markers.update([hand('b')]), 0.0).markers
    assert {m.ns for m in second if m.action == Marker.DELETE} == {'a/joints', 'a/bones', 'a/cube'}
    assert {m.ns for m in second if m.action == Marker.ADD} == {'b/joints', 'b/bones', 'b/cube'}
    assert {m.namespace for m in markers.clear()} == {'b/joints', 'b/bones', 'b/cube'}
    assert markers.clear() == []


def test_the_constants_of_markers_are_those_of_ros() -> None:
    for name in ('ADD', 'DELETE', 'LINE_LIST', 'SPHERE_LIST'):
        assert getattr(markers_module, name) == getattr(Marker, name)


def info(**fields) -> CameraInfo:
    values = {'width': 640, 'height': 480, 'k': [500.0, 0, 320.0, 0, 510.0, 240.0, 0, 0, 1.0], **fields}
    return CameraInfo(**{name: [float(x) for x in value] if name in 'kp' else value for name, value in values.items()})


def test_rectified_images_take_p_and_raw_ones_k() -> None:
    camera = Camera('/camera_info')
    camera.update(info(p=[400.0, 0, 300.0, 0, 0, 405.0, 200.0, 0, 0, 0, 1.0, 0]))
    assert camera.intrinsics(640, 480, Params()) == Intrinsics(400, 405, 300, 200, 640, 480)
    assert camera.intrinsics(640, 480, Params(use_rectified=False)) == Intrinsics(500, 510, 320, 240, 640, 480)
    given_ = Params(intrinsics_fx=11.0, intrinsics_fy=12.0, intrinsics_cx=3.0, intrinsics_cy=4.0)
    assert camera.intrinsics(10, 20, given_) == Intrinsics(11, 12, 3, 4, 10, 20)


def test_a_bad_projection_matrix_does_not_hold_up_raw_images() -> None:
    camera = Camera('/camera_info')
    camera.update(info(p=[-1.0] * 12))
    assert camera._fits(640, 480, rectified=False) and not camera._fits(640, 480, rectified=True)
    assert camera.intrinsics(640, 480, Params(use_rectified=False)).fx == 500


@pytest.mark.parametrize('k', [
    [1e-300, 0, 320, 0, 1e-300, 240, 0, 0, 1], [1e9, 0, 320, 0, 1e9, 240, 0, 0, 1],
    [500, 0, 1e300, 0, 500, 240, 0, 0, 1], [60, 0, 320, 0, 60, 240, 0, 0, 1]])
def test_intrinsics_of_no_lens_are_refused(k: list[float]) -> None:
    """Found by fuzzing: areas became infinite, and the search for a hand ended in an IndexError."""
    camera = Camera('/camera_info')
    camera.update(info(k=k))
    with pytest.raises(InputError, match=r'^/camera_info: .* no camera of 640x480 pixels'):
        camera.intrinsics(640, 480, Params())


def test_parameters_of_no_lens_are_refused() -> None:
    camera = Camera('/camera_info')
    given_ = Params(intrinsics_fx=1e-5, intrinsics_fy=1e-5, intrinsics_cx=320.0, intrinsics_cy=240.0)
    with pytest.raises(InputError, match=r'^parameters intrinsics\.\*: .* no camera of 640x480 pixels'):
        camera.intrinsics(640, 480, given_)
    given_ = Params(intrinsics_fx=1e5, intrinsics_fy=500.0, intrinsics_cx=320.0, intrinsics_cy=240.0)
    with pytest.raises(InputError, match='focal lengths of 100000 and 500 pixels are not those of one camera'):
        camera.intrinsics(640, 480, given_)


def test_intrinsics_may_be_set_one_after_the_other() -> None:
    camera = Camera('/camera_info')
    for some in ({'intrinsics_fx': 500.0}, {'intrinsics_fx': 500.0, 'intrinsics_fy': 510.0}, {'intrinsics_cx': -3.0}):
        with pytest.raises(InputError, match='go together: set all four'):
            camera.intrinsics(640, 480, Params(**some))
    both = Params(intrinsics_fx=500.0, intrinsics_fy=510.0, intrinsics_cx=320.0, intrinsics_cy=240.0)
    assert camera.intrinsics(640, 480, both) == Intrinsics(500, 510, 320, 240, 640, 480)


def test_where_the_intrinsics_come_from_is_told() -> None:
    camera, given_ = Camera('/camera_info'), Params(intrinsics_fx=1.0, intrinsics_fy=1.0, intrinsics_cx=1.0,
                                                    intrinsics_cy=1.0)
    assert (camera.source(Params()), camera.source(given_)) == ('none yet on /camera_info', 'parameters')
    camera.update(info(header=header(frame='left')))
    assert camera.source(Params()) == '/camera_info'
    assert "its frame_id is 'right' but that of /camera_info is 'left'" in camera.frame_problem('right', Params())
    assert camera.frame_problem('left', Params()) == camera.frame_problem('right', given_) == ''
    camera.update(info())  # a driver that sets no frame says nothing about the camera
    assert camera.frame_problem('right', Params()) == ''


def test_an_image_waits_for_the_camera_info_that_fits_it_and_no_longer() -> None:
    camera, params = Camera('/camera_info'), Params(camera_info_timeout=10.0)

    def waiting() -> Future:
        image = pool.submit(camera.intrinsics, 640, 480, params)
        while not camera.waiting and not wait([image], 0.001).done:
            pass
        return image

    with ThreadPoolExecutor() as pool:
        camera.update(info(width=320, height=240))
        image = waiting()
        camera.update(info())
        assert image.result(5).fx == 500 and not camera.waiting
        camera.update(info(width=320, height=240))
        image = waiting()
        camera.close()
        with pytest.raises(Closed):
            image.result(5)
        camera.update(info())
        assert camera.intrinsics(640, 480, params).fx == 500, 'an image in flight is still answered'
        camera.open()
        assert camera.intrinsics(640, 480, params).fx == 500, 'it may be published only once'
        camera.update(info(width=320, height=240))
        image = waiting()
        camera.update(info())
        assert image.result(5).fx == 500
    now = Params(camera_info_timeout=0.0)
    with pytest.raises(InputError, match=r'^/camera_info: .*640x480'):
        camera.intrinsics(320, 240, now)
    for wrong, remedy in ((info(k=[0.0] * 9), 'calibrate it'), (info(k=[-1.0] * 9), 'calibrate the camera'),
                          (info(width=0), 'give its size')):
        camera.update(wrong)
        with pytest.raises(InputError, match=rf'{remedy}, or set the parameters intrinsics\.fx, \.fy, \.cx and \.cy$'):
            camera.intrinsics(640, 480, now)


def test_depth_that_cannot_hold_a_hand_is_explained() -> None:
    far = np.full((48, 64), 4.0, np.float32)
    assert 'depth_scale' in depth_problem(far, 0.1, 1.5)
    assert 'no reading' in depth_problem(np.zeros((48, 64), np.float32), 0.1, 1.5)
    far[:16, :16] = 0.5
    assert depth_problem(far, 0.1, 1.5) == ''


@pytest.mark.parametrize('wrong, words', [
    ({'side': 'both'}, 'auto, left, right'), ({'device': 'gpu'}, 'cuda'), ({'min_depth': 1.5}, 'max_depth'),
    ({'cube_size': 0.01}, '0.05'),
    ({'transport': 'theora'}, 'compressedDepth')])
def test_contradicting_parameters_are_refused(wrong: dict, words: str) -> None:
    with pytest.raises(HandPoseError, match=words):
        Params(**wrong)


def test_the_parameter_file_has_every_parameter_with_its_default() -> None:
    text = resource('config/estimator.yaml').read_text()
    assert text == yaml_file(), 'write it again: hand_pose_ros.ros.params.yaml_file()'
    values = yaml.safe_load(text)['/**']['ros__parameters']
    assert values['depth_scale'] == 0.001 and values['autostart'] is True and values['intrinsics.fx'] == 0.0
    assert all(f'`{name}`' in markdown_table() for name in values)


def test_the_rviz_file_shows_the_markers() -> None:
    manager = yaml.safe_load(resource('rviz/hand_pose.rviz').read_text())['Visualization Manager']
    topics = [display['Topic']['Value'] for display in manager['Displays'] if 'Topic' in display]
    assert topics == ['/hand/markers']


@pytest.mark.parametrize('use_sim_time', ['', 'true'])
def test_the_launch_file_starts_the_node_with_its_parameter_file(use_sim_time: str,
                                                                 monkeypatch: pytest.MonkeyPatch) -> None:
    """With stand-ins for launch, which has no wheels: what the file passes to it is what is tested."""
    import sys
    from types import ModuleType

    calls: list[tuple[str, tuple, dict]] = []
    used: set[str] = set()

    def stand_in(module: str, *names: str) -> None:
        made = ModuleType(module)
        for name in names:
            def call(*args, _name=name, **kwargs):
                calls.append((_name, args, kwargs))
                return _name, args
            setattr(made, name, call)
        monkeypatch.setitem(sys.modules, module, made)

    class LaunchConfiguration(str):
        """Its value in a context, which is a dictionary here."""

        def __init__(self, name: str) -> None:
            used.add(name)

        def perform(self, context: dict[str, str]) -> str:
            return context[self]

    stand_in('launch', 'LaunchContext', 'LaunchDescription')
    stand_in('launch.actions', 'DeclareLaunchArgument', 'OpaqueFunction')
    stand_in('launch.conditions', 'IfCondition')
    stand_in('launch.substitutions')
    sys.modules['launch.substitutions'].LaunchConfiguration = LaunchConfiguration
    stand_in('launch_ros', 'actions')
    stand_in('launch_ros.actions', 'Node')
    path = resource('launch/estimator.launch.py')
    spec = importlib.util.spec_from_file_location('estimator_launch', path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.generate_launch_description()
    [function] = (kwargs['function'] for name, _, kwargs in calls if name == 'OpaqueFunction')
    function({'use_sim_time': use_sim_time, 'depth_topic': '/camera/depth/image_raw'})

    declared = {args[0]: kwargs for name, args, kwargs in calls if name == 'DeclareLaunchArgument'}
    assert used == set(declared) and all(kwargs['description'] for kwargs in declared.values())
    assert declared['use_sim_time']['default_value'] == ''
    node, rviz = (kwargs for name, _, kwargs in calls if name == 'Node')
    assert (node['package'], node['executable'], node['name']) == ('hand_pose_ros', 'estimator', 'estimator')
    given = [{'use_sim_time': 'use_sim_time'}] if use_sim_time else []  # else it would beat the file
    assert (node['parameters'], rviz['parameters']) == (['params_file', *given], given)
    assert (node['namespace'], node['remappings']) == ('namespace', [('depth/image_rect', 'depth_topic')])
    assert resource('config/estimator.yaml').samefile(declared['params_file']['default_value'])
    assert resource('rviz/hand_pose.rviz').samefile(rviz['arguments'][1])
    assert ('/depth/camera_info', '/camera/depth/camera_info') in rviz['remappings']  # no depth is drawn without it


def test_messages_hold_plain_arrays() -> None:
    """Slow lists would pass unnoticed: 21 confidences travel as one block."""
    assert isinstance(hands_to_msg(header(), [hand()], HAND21).hands[0].confidence, array)


def test_lost_images_of_a_slow_camera_are_told() -> None:
    def message(infos: int, images: int, published: bool = True) -> str:
        statistics.count(camera_infos=infos, received=images, answered=images)
        return str(statistics.report('node', 'active', published, {}).message)

    statistics = Statistics()
    assert 'but only' not in message(5, 1)  # too few to tell
    assert '10 camera_info but only 2 images arrived' in message(5, 1)
    assert 'but only' in message(5, 5)  # until there is better news
    assert 'but only' not in message(5, 5)
    statistics = Statistics()
    assert 'but only' not in message(30, 29) + message(30, 0, published=False)
    assert '30 camera_info but only 1 image arrived' in message(30, 1)
    statistics.count(received=10, answered=10)  # no camera_info any more: nothing to compare with
    assert 'but only' not in str(statistics.report('node', 'active', True, {}).message)


def test_a_complaint_is_repeated_after_a_while_whatever_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 3.0  # the machine has just started
    monkeypatch.setattr('hand_pose_ros.ros.diagnostics.time', SimpleNamespace(monotonic=lambda: now))
    complaints = Complaints()
    assert complaints.is_news('5 bytes are missing') and complaints.is_news('no readings')
    now += REPEAT_S - 1
    assert not complaints.is_news('17 bytes are missing')
    now += 2
    assert complaints.is_news('17 bytes are missing')
    assert all(complaints.is_news('x' * i) for i in range(1, 3 * MAX_KINDS)) and len(complaints._logged_at) <= MAX_KINDS


def test_a_report_tells_rates_times_and_the_worst_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    def report(state: str = 'active', **counts: int) -> DiagnosticStatus:
        nonlocal now
        for what in Counter(counts).elements():  # one after the other, as images come
            statistics.count(**{what: 1})
        now += 2.0
        return statistics.report('node', state, True, {'model': 'a'})

    now = 3.0
    monkeypatch.setattr('hand_pose_ros.ros.diagnostics.time', SimpleNamespace(perf_counter=lambda: now))
    statistics = Statistics()
    assert (report().level, report().message) == (DiagnosticStatus.STALE, 'no images')
    for milliseconds in range(101):
        statistics.time(total=milliseconds / 1000)
    for nanoseconds in (-1, 50_000_000, int(MAX_AGE_S * 1e9)):  # the others are no ages: the clocks differ
        statistics.age(nanoseconds)
    first = report(received=30, answered=25, dropped=5, hands=50)
    assert (first.level, first.message) == (DiagnosticStatus.OK, '25 images answered, 50 hands')
    values = {value.key: value.value for value in first.values}
    assert values['refused_total'] == '0'
    assert (values['input_hz'], values['output_hz']) == ('15.0', '12.5')
    assert (values['total_p50_ms'], values['total_p95_ms']) == ('50.00', '95.00')
    assert values['age_p50_ms'] == values['age_p95_ms'] == '50.00'
    second = report(received=30, answered=23, dropped=7, refused=0)
    assert second.level == DiagnosticStatus.WARN and '7 of 30 images of a second were dropped' in second.message
    values = {value.key: value.value for value in second.values}
    assert [values[f'{what}_total'] for what in ('received', 'answered', 'dropped', 'refused', 'hands')] == [
        '60', '48', '12', '0', '50']
    assert values['model'] == 'a' and 'total_p50_ms' not in values
    assert report(received=30, answered=4, dropped=26, waited=22).level == DiagnosticStatus.OK
    assert report(received=9, answered=1, dropped=8).level == DiagnosticStatus.OK  # too few to tell
    assert (report().level, report('inactive').message) == (DiagnosticStatus.STALE, 'the node is inactive')
    statistics.silence = 'nobody publishes'
    assert (report().level, report().message) == (DiagnosticStatus.STALE, 'nobody publishes')
    statistics.problem('no readings')
    last = report('inactive')  # what was wrong before is still told
    assert (last.level, last.message) == (DiagnosticStatus.WARN, 'no readings')
    statistics.failure = 'no such model'
    assert report().level == DiagnosticStatus.ERROR


def test_a_camera_with_less_than_an_image_a_second_is_not_stale_between_its_images(
        monkeypatch: pytest.MonkeyPatch) -> None:
    def report(*images: float, done: str = 'answered', state: str = 'active') -> tuple[bytes, str]:
        """The report of second `now`, with images that came at these times, and what was done with them."""
        nonlocal now
        second = now + 1
        for image_s in images:
            now = image_s
            statistics.count(received=1)
        now = second
        for _ in images if done else ():
            finish(done)
        status = statistics.report('node', state, True, {})
        return status.level, status.message

    def finish(done: str) -> None:
        statistics.count(**{done: 1})
        statistics.problem('no readings' if done == 'refused' else '')

    now = 0.0
    monkeypatch.setattr('hand_pose_ros.ros.diagnostics.time', SimpleNamespace(perf_counter=lambda: now))
    statistics = Statistics()
    nothing, one = (DiagnosticStatus.STALE, 'no images'), (DiagnosticStatus.OK, '1 image answered, 0 hands')
    assert [report(), report(1.5), report(), report(3.5), report()] == [nothing, one, one, one, one]
    warning = DiagnosticStatus.WARN, 'no readings'
    assert [report(5.5, done='refused'), report()] == [warning, warning], 'no news is no good news'
    assert [report(7.5), report(), report(), report(), report()] == [one, one, one, one, nothing], 'it died'
    assert [report(12.2, 12.23)[0], report()] == [DiagnosticStatus.OK, nothing], 'a fast one died'

    statistics, now = Statistics(), 0.0
    assert report(0.9, done='') == (DiagnosticStatus.OK, '0 images answered, 0 hands')
    finish('answered')
    assert [report(), report(2.9, done='')] == [one, one], 'the answer of an image comes in the next second'
    finish('refused')
    assert [report(), report(4.9, done='')] == [warning, warning], 'and so does its refusal'
    finish('answered')
    assert report() == one
    assert [report(6.5, state='inactive')[1], report()] == ['the node is inactive', one]


class Graph:
    """A node that sees these topics, each with its publishers, and listens to `/depth` as it was asked to."""

    publishers = (SimpleNamespace(topic_name='/estimator/debug/crop'),)

    def __init__(self, listens: ReliabilityPolicy = ReliabilityPolicy.BEST_EFFORT, **publishers: list) -> None:
        self.infos = {f'/{topic}': infos for topic, infos in publishers.items()}
        self.subscriptions = [
            SimpleNamespace(topic_name=topic, qos_profile=QoSProfile(depth=1, reliability=reliability))
            for topic, reliability in (('/depth', listens), ('/other', ReliabilityPolicy.RELIABLE))]

    def get_publishers_info_by_topic(self, topic: str) -> list:
        return self.infos.get(topic, [])

    def count_publishers(self, topic: str) -> int:
        return len(self.get_publishers_info_by_topic(topic))

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        types = [(topic, [info.topic_type for info in infos]) for topic, infos in self.infos.items()]
        return [*types, ('/depth', ['sensor_msgs/msg/Image']), ('/estimator/debug/crop', ['sensor_msgs/msg/Image'])]

    def create_subscription(self, *_: object, **__: object) -> str:
        return 'a subscription'


def publisher(name: str = 'camera', namespace: str = '/', kind: str = 'Image', **qos: object) -> SimpleNamespace:
    return SimpleNamespace(node_name=name, node_namespace=namespace, topic_type=f'sensor_msgs/msg/{kind}',
                           qos_profile=QoSProfile(depth=1, **qos))


def test_why_no_image_arrives_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def told(**graph: object) -> str:
        return topics.explain_silence(Graph(**graph), '/depth', Image, 5.0)

    best_effort, reliable = ({'reliability': policy} for policy in (ReliabilityPolicy.BEST_EFFORT,
                                                                    ReliabilityPolicy.RELIABLE))
    assert '5 s; the topic is without any publisher: start the camera' in told(points=[publisher(kind='PointCloud2')])
    assert 'publisher (sensor_msgs/msg/Image is published on /a, /b): start the camera' in told(
        a=[publisher()], points=[publisher(kind='PointCloud2')], b=[publisher()])
    points = publisher(kind='PointCloud2')
    assert 'but sensor_msgs/msg/Image is expected' in told(depth=[points])
    for publishers, listens in (([points, publisher()], ReliabilityPolicy.BEST_EFFORT),
                                ([publisher(**best_effort)], ReliabilityPolicy.BEST_EFFORT),
                                ([publisher(**best_effort), publisher(**reliable)], ReliabilityPolicy.RELIABLE)):
        assert 'if it does publish, start the camera driver with' in told(depth=publishers, listens=listens)
        assert topics.can_arrive(Graph(depth=publishers, listens=listens), '/depth', Image)
    with monkeypatch.context() as cyclone:
        cyclone.setattr(topics.qos, 'middleware', lambda: 'rmw_cyclonedds_cpp')
        said = told(depth=[publisher()])
        assert 'if it does publish, let rmw_cyclonedds_cpp pass large messages' in said and 'FAST' not in said
    weak = {'depth': [points, publisher(**best_effort)], 'listens': ReliabilityPolicy.RELIABLE}
    assert 'does not offer the reliability' in told(**weak)
    # Nothing is lost on the way, so what is said of lost images would only mislead.
    assert not any(topics.can_arrive(Graph(**graph), '/depth', Image) for graph in (weak, {'depth': [points]}, {}))
    assert topics.explain_incompatible(Graph(), '/depth', 'durability').endswith('.durability:=volatile')


def test_publishers_are_named_in_one_order() -> None:
    unknown = publisher('_NODE_NAME_UNKNOWN_')
    driver = publisher('driver', '/front', reliability=ReliabilityPolicy.BEST_EFFORT)
    for publishers in ([unknown, driver, publisher()], [publisher(), driver, unknown]):  # else it were news each second
        assert topics.describe_publishers(Graph(depth=publishers), '/depth') == (
            'published by /camera (sensor_msgs/msg/Image, reliable, volatile), /front/driver (sensor_msgs/msg/Image, '
            'best effort, volatile), a node (sensor_msgs/msg/Image, reliable, volatile)')


def test_what_is_kept_is_asked_for_only_where_all_keep_it() -> None:
    kept, other = publisher(durability=DurabilityPolicy.TRANSIENT_LOCAL), publisher()
    for publishers, expected in (([], None), ([kept, other], None), ([kept, kept], 'a subscription')):
        assert topics.subscribe_latched(Graph(info=publishers), CameraInfo, '/info', print) == expected
