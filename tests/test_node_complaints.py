"""What the node says: whatever is wrong is named with its remedy, once, and what is right is not complained about."""

# ruff: noqa: F811 (a fixture from another file is imported, and then an argument)

import time
from array import array

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from test_node import (  # noqa: F401 (fixtures)
    BEST_EFFORT,
    FOCAL,
    HEIGHT,
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

from hand_pose_ros.msg import HandJointsArray
from hand_pose_ros.ros import node as node_module

pytestmark = pytest.mark.usefixtures('ros_domain', 'load_once')


def test_without_camera_info_the_remedy_is_named_and_works(rig: Rig) -> None:
    rig.start(camera_info_timeout=0.05)
    publish = rig.camera()
    publish(image(depth_with_hand()))
    rig.until_said('/depth/camera_info', 'intrinsics.fx')
    assert not rig.received[HandJointsArray]
    node = rig.node
    node.set_parameters_atomically([Parameter(f'intrinsics.{name}', value=value) for name, value in
                                    (('fx', FOCAL), ('fy', FOCAL), ('cx', WIDTH / 2), ('cy', HEIGHT / 2))])
    assert rig.answer(publish, image(depth_with_hand())).hands


def test_a_machine_is_not_called_slow_while_camera_info_is_missing(rig: Rig) -> None:
    rig.start(camera_info_timeout=1.5, publish_diagnostics=False)  # images that wait are replaced by newer ones
    publish, picture = rig.camera(RELIABLE), image(depth_with_hand())
    end = time.monotonic() + 3.5
    while time.monotonic() < end:
        publish(picture)
        time.sleep(0.02)
    rig.until_said('/depth/camera_info')
    assert not any('too slow' in text for text in rig.said()) and not rig.received[DiagnosticArray]


def test_nor_where_camera_info_is_wrong_now_and_then(rig: Rig) -> None:
    node = rig.start(camera_info_timeout=9.0)
    publish, picture = rig.camera(RELIABLE), image(depth_with_hand())
    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)
    rig.connected(infos)
    reports = rig.received[DiagnosticArray]
    seen = len(reports)
    while len(reports) < seen + 4:
        infos.publish(camera_info())
        rig.answer(publish, picture)
        infos.publish(camera_info(2 * WIDTH, 2 * HEIGHT))
        rig.until(lambda: node._camera._info.width == 2 * WIDTH, 'the wrong one')
        received = node._statistics._totals['received']
        for number in range(received + 1, received + 21):
            publish(picture)
            rig.until(lambda n=number: node._statistics._totals['received'] == n, 'the image')
    assert not any('too slow' in text for text in rig.said())


def test_to_stop_while_an_image_waits_for_its_camera_info_is_no_complaint(rig: Rig) -> None:
    rig.start(camera_info_timeout=9.0)
    publish = rig.camera(RELIABLE)
    publish(image(depth_with_hand()))
    rig.until(lambda: rig.node._camera._changed._waiters, 'the image to wait')
    assert rig.transition('deactivate') and rig.transition('activate')
    rig.until(lambda: sum('listening to' in text for text in rig.said()) == 2, 'to hear all that was said before')
    assert not any('camera_info arrived' in text for text in rig.said())
    assert rig.node._statistics._totals['dropped'] == 1  # each image is answered, refused or dropped
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand())).hands


def no_data(message: Image) -> None:
    message.data = array('B')


def colour(message: Image) -> None:
    message.encoding = 'rgb8'


def short(message: Image) -> None:
    message.data = message.data[:-1]


def empty(message: Image) -> None:
    message.width = message.height = message.step = 0
    message.data = array('B')


def narrow_step(message: Image) -> None:
    message.step = 3


def wrong_size(message: Image) -> None:
    message.height //= 2


def test_bad_images_are_refused_with_one_sentence_each_and_the_next_one_is_answered(rig: Rig) -> None:
    rig.start(camera_info_timeout=0.01)
    publish = rig.camera(RELIABLE, info=camera_info())
    complaints = 0
    for harm, words in ((colour, ['rgb8', '16UC1']), (no_data, [' 0 bytes']), (short, ['bytes']), (empty, ['0x0']),
                        (narrow_step, ['step']), (wrong_size, ['camera_info', f'{WIDTH}x{HEIGHT // 2}'])):
        for stamp in range(3):
            bad = image(depth_with_hand(), stamp)
            harm(bad)
            publish(bad)
            time.sleep(0.02)
        rig.until_said('/depth/', *words)
        assert stamp_of(rig.answer(publish, image(depth_with_hand(), 99))) == 99
        said = [text for text in rig.said() if 'listening' not in text]
        assert len(said) <= complaints + 1, f'the same complaint more than once: {said}'
        complaints = len(said)
    assert len(rig.received[HandJointsArray]) == 6


def test_bad_camera_info_is_refused_and_a_good_one_is_taken(rig: Rig) -> None:
    rig.start(camera_info_timeout=0.01)
    images = rig.camera()
    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)
    rig.connected(infos)
    for info, words in ((camera_info(focal=0.0), ['not calibrated', 'intrinsics.fx']),
                        (camera_info(WIDTH * 2, HEIGHT * 2), ['320x240']), (camera_info(focal=float('nan')), ['nan'])):
        infos.publish(info)
        rig.until(lambda info=info: repr(rig.node._camera._info) == repr(info), 'the camera_info')
        images(image(depth_with_hand()))
        rig.until_said('/depth/camera_info', *words)
    assert not rig.received[HandJointsArray]
    infos.publish(camera_info())
    rig.until(lambda: rig.node._camera._info == camera_info(), 'the camera_info')
    assert rig.answer(images, image(depth_with_hand())).hands


def test_depth_without_readings_is_answered_and_explained(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())
    for value in (0.0, np.nan, np.inf, -np.inf, -1.0):
        answer = rig.answer(publish, image(np.full((HEIGHT, WIDTH), value), encoding='32FC1'))
        assert answer.hands == [], value
    rig.until_said('/depth/image_rect', 'no reading')
    assert rig.answer(publish, image(depth_with_hand())).hands


def test_a_wrong_depth_scale_is_suspected(rig: Rig) -> None:
    rig.start()
    rig.answer(rig.camera(info=camera_info()), image(depth_with_hand() * 10))
    rig.until_said('/depth/image_rect', 'depth_scale')


def test_an_empty_room_is_no_wrong_depth_scale_once_a_hand_was_seen(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())
    assert rig.answer(publish, image(depth_with_hand())).hands
    assert rig.answer(publish, image(np.full((HEIGHT, WIDTH), 3.0))).hands == []
    rig.answer(publish, image(np.zeros((HEIGHT, WIDTH))))
    rig.until_said('no reading')  # which was said after all that there was to say before
    assert not any('depth_scale' in text for text in rig.said())
    assert rig.set_parameter('depth_scale', 0.0011)[0]  # of which nothing is known yet
    rig.answer(publish, image(np.full((HEIGHT, WIDTH), 3.0)))
    rig.until_said('check depth_scale')


def test_silence_names_the_topic_and_its_publishers(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    rig.client.create_publisher(Image, '/somewhere/else', RELIABLE)
    rig.start()
    rig.until_said('/depth/image_rect', 'without any publisher', '(sensor_msgs/msg/Image is published on /somewhere/')
    # In the diagnostics as long as it lasts: first as a warning, then as the reason of staleness.
    reports = rig.received[DiagnosticArray]
    rig.until(lambda: reports and '/somewhere' in reports[-1].status[0].message
              and reports[-1].status[0].level == b'\x03', 'staleness')
    assert sum('/somewhere/else' in text for text in rig.said()) == 1


def test_who_has_just_come_is_not_said_to_be_missing(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.5)
    rig.start()

    reports = rig.received[DiagnosticArray]
    rig.until(lambda: reports and 'without any publisher' in reports[-1].status[0].message, 'the silence to be told')
    before = len(reports)
    rig.client.create_publisher(Image, 'depth/image_rect', BEST_EFFORT)
    rig.until(lambda: any(report.status[0].message == 'no images' for report in reports[before:]),
              'the publisher to be seen, and given its time')


def test_a_transport_that_is_not_read_is_named(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    rig.client.create_publisher(CompressedImage, 'depth/image_rect/zstd', RELIABLE)
    rig.start()
    rig.until_said('on /depth/image_rect/zstd there are images: the transport zstd is not read: convert it with')


def test_depth_that_is_only_raw_is_found(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    rig.client.create_publisher(Image, 'depth/image_rect', RELIABLE)
    rig.start(transport='compressedDepth')
    rig.until_said('no image arrived on /depth/image_rect/compressedDepth',
                   'depth is published on /depth/image_rect: set the parameter transport to raw')


@pytest.mark.parametrize('transport', ['compressedDepth', 'compressed'])
def test_depth_that_is_only_compressed_is_found(rig: Rig, monkeypatch: pytest.MonkeyPatch, transport: str) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    rig.start()
    rig.until_said('/depth/image_rect', 'without any publisher', 'start the camera')
    rig.client.create_publisher(CompressedImage, f'depth/image_rect/{transport}', RELIABLE)
    rig.until_said(f'depth is published on /depth/image_rect/{transport}: set the parameter transport to {transport}')


def test_why_no_image_arrives_is_told_also_where_camera_info_does(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    rig.start()
    rig.client.create_publisher(CompressedImage, 'depth/image_rect/compressed', RELIABLE)

    def newest_message(infos: rclpy.publisher.Publisher, reports: int = 3) -> str:
        """Of the diagnostics, after some seconds of camera_info alone."""
        end = len(rig.received[DiagnosticArray]) + reports
        while len(rig.received[DiagnosticArray]) < end:
            infos.publish(camera_info())
            time.sleep(0.02)
        return rig.received[DiagnosticArray][-1].status[0].message

    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)
    rig.connected(infos)
    assert 'set the parameter transport to compressed' in newest_message(infos)
    assert not any('camera_info but only' in text for text in rig.said())
    rig.connected(rig.client.create_publisher(Image, 'depth/image_rect', RELIABLE))
    assert 'if it does publish, start the camera driver with' in newest_message(infos)


def test_incompatible_quality_of_service_is_named_with_its_remedy(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, 'SILENCE_S', 1e9)  # images of others may arrive
    rig.start(**{'qos_overrides./depth/image_rect.subscription.reliability': 'reliable'})
    rig.client.create_publisher(Image, 'depth/image_rect', BEST_EFFORT)
    rig.until_said('does not offer', '/depth/image_rect', '/client', 'best effort',
                   '-p qos_overrides./depth/image_rect.subscription.reliability:=best_effort')
    monkeypatch.setattr(node_module, 'SILENCE_S', 0.1)
    # In the diagnostics, too, as long as it lasts, whatever arrives beside the images: none of them are lost.
    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)

    def told() -> bool:
        infos.publish(camera_info())
        reports = [report.status[0] for report in rig.received[DiagnosticArray]]
        return len(reports) > 3 and all(':=best_effort' in status.message for status in reports[-2:])
    rig.until(told, 'diagnostics')


def test_a_quality_of_service_that_has_no_effect_is_named(rig: Rig) -> None:
    name = 'qos_overrides./camera/depth/image_raw.subscription'
    without = f'{name}.durability', 'qos_overrides.depth/image_rect.subscription.depth'
    rig.start('depth/image_rect:=/camera/depth/image_raw', **{f'{name}.reliability': 'reliable', without[0]: 'volatile',
                                                              without[1]: 5})
    for each in without:
        rig.until_said(f"there is no parameter '{each}', so it has no effect", 'of /camera/depth/camera_info')
    assert sum('has no effect' in text for text in rig.said()) == 2


@pytest.mark.parametrize('policy, value', [('reliability', 'perhaps'), ('depth', 'deep'), ('reliability', True)])
def test_a_wrong_quality_of_service_is_named(rig: Rig, policy: str, value: object) -> None:
    name = 'qos_overrides./depth/image_rect.subscription'
    rig.start(**{f'{name}.{policy}': value})
    rig.until_said('cannot listen to', name, str(value))
    assert rig.state() == 'inactive' and rig.client.count_subscribers('/depth/camera_info') == 0


def test_diagnostics_tell_rates_times_and_hints(rig: Rig) -> None:
    rig.start()
    publish = rig.camera(info=camera_info())

    def newest() -> dict[str, str]:
        status = rig.received[DiagnosticArray][-1].status[0]
        return {'name': status.name, 'message': status.message, 'level': status.level,
                **{v.key: v.value for v in status.values}}

    for stamp in (*range(4), time.time_ns() // 1_000_000):  # the others are from a bag, of whatever age
        rig.answer(publish, image(depth_with_hand(), stamp))
    rig.until(lambda: rig.received[DiagnosticArray] and newest().get('answered_total') == '5', 'diagnostics')
    report = newest()
    assert report['received_total'] == report['hands_total'] == '5' and report['dropped_total'] == '0'
    assert {'decode_p50_ms', 'predict_p50_ms', 'total_p95_ms', 'age_p50_ms', 'input_hz', 'output_hz'} <= report.keys()
    assert {key: report[key] for key in ('name', 'state', 'model', 'detector', 'intrinsics')} == {
        'name': 'estimator: hand pose', 'state': 'active', 'model': str(rig.weights), 'detector': 'nearest',
        'intrinsics': '/depth/camera_info'}
    assert report['engine'] == rig.node._estimator.engine.name
    assert report['image'].startswith('/depth/image_rect published by /client (sensor_msgs/msg/Image, best effort')
    assert rig.received[DiagnosticArray][-1].header.stamp.sec > 0
    assert report['level'] == b'\x00'
    publish(Image(encoding='rgb8', width=1, height=1, step=3, data=array('B', b'abc')))
    rig.until(lambda: 'rgb8' in newest()['message'] and newest()['level'] == b'\x01', 'a warning')
    assert newest()['refused_total'] == '1' and newest()['answered_total'] == '5'
    rig.until(lambda: newest()['level'] == b'\x03', 'staleness')


def test_camera_info_that_is_published_twice_does_not_make_images_missing(rig: Rig) -> None:
    """As by openni2_camera, which has two depth images, and for each of them publishes the same camera_info."""
    node = rig.start()
    publish = rig.camera()
    infos = rig.client.create_publisher(CameraInfo, 'depth/camera_info', RELIABLE)
    rig.connected(infos)
    for stamp in range(1, 21):
        for _ in range(2):
            before = node._camera._info
            infos.publish(stamped(camera_info(), stamp))
            rig.until(lambda before=before: node._camera._info is not before, 'the camera_info')
        rig.answer(publish, image(depth_with_hand(), stamp))
    reports = rig.received[DiagnosticArray]
    seen = len(reports)
    rig.until(lambda: len(reports) > seen + 1, 'diagnostics of all of them')
    assert not any('but only' in report.status[0].message for report in reports)


def test_two_nodes_that_publish_the_same_joints_are_told(rig: Rig) -> None:
    rig.start()
    assert not any('somebody else' in text for text in rig.said())
    other = rig.client.create_publisher(HandJointsArray, 'hand/joints', 1)
    rig.until_said('somebody else publishes /hand/joints', 'namespace')
    rig.client.destroy_publisher(other)


def test_a_camera_info_of_another_frame_is_suspected(rig: Rig) -> None:
    rig.start()
    assert rig.answer(rig.camera(info=camera_info()), image(depth_with_hand(), frame='other_camera')).hands
    rig.until_said('/depth/camera_info', 'other_camera', 'camera_optical')
