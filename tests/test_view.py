"""What `hand-pose view` promises: depth images and hands where they belong, in a file that Rerun reads."""

import signal
import subprocess
import sys

import numpy as np
import pytest
from test_estimate import CAMERA, STAMPS, bag, depths  # noqa: F401 (fixtures)

from hand_pose_ros.bags import BagWriter
from hand_pose_ros.cli import main
from hand_pose_ros.estimator import HandPoseEstimator

# ruff: noqa: F811 (a fixture from another file is imported, and then an argument)

pytest.importorskip('rerun', reason="needs Rerun: pip install '.[view]'")


def with_(weights):
    return '--model', str(weights), '--min-score', '0'


def recorded(path, entity, column):
    """stamp in ns -> what was logged there, in the order of time."""
    RrdReader = pytest.importorskip('rerun.chunk', reason='this release of Rerun cannot read its files').RrdReader
    rows = {}
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity:
            table = chunk.to_record_batch()
            if column in table.schema.names:
                stamps = table.column('stamp').cast('int64').to_pylist()
                rows |= dict(zip(stamps, table.column(column).to_pylist(), strict=True))
    return dict(sorted(rows.items()))


def test_images_camera_and_hands_of_a_bag_are_where_they_belong(tmp_path, bag, depths, weights):
    out = tmp_path / 'made' / 'view.rrd'
    assert main(['view', str(bag), '--save', str(out), *with_(weights), '--side', 'left']) == 0
    assert [path.name for path in out.parent.iterdir()] == ['view.rrd']
    images = recorded(out, '/camera/depth', 'DepthImage:buffer')
    assert list(images) == STAMPS
    for image, depth in zip(images.values(), depths, strict=True):
        millimetres = np.frombuffer(bytes(np.array(image, np.uint8)), np.uint16).reshape(depth.shape)
        np.testing.assert_allclose(millimetres * 0.001, depth, atol=0.00051)
    assert set(map(tuple, recorded(out, '/camera/depth', 'DepthImage:meter').values())) == {(1000,)}
    [[size]] = list(recorded(out, '/camera', 'Pinhole:resolution').values())[:1]
    assert tuple(size) == (160, 120)
    [[matrix]] = list(recorded(out, '/camera', 'Pinhole:image_from_camera').values())[:1]
    np.testing.assert_allclose(np.array(matrix).reshape(3, 3).T, [[140, 0, 80], [0, 140, 60], [0, 0, 1]])
    estimator = HandPoseEstimator.from_pretrained(weights, min_score=0.0, side='left')
    joints = recorded(out, '/hands/hand_1/joints', 'Points3D:positions')
    assert list(joints) == STAMPS
    for stamp, points in joints.items():
        [hand] = estimator(depths[STAMPS.index(stamp)], CAMERA, time_s=stamp / 1e9)
        np.testing.assert_allclose(points, hand.joints, atol=1e-6)
    assert len(recorded(out, '/hands/hand_1/bones', 'LineStrips3D:strips')[STAMPS[0]]) == 20


def test_a_lost_hand_is_taken_away(tmp_path, depths, weights):
    with BagWriter(tmp_path / 'lost.mcap') as writer:
        for stamp, depth in zip(STAMPS, [depths[0], np.full_like(depths[0], 3)], strict=False):
            writer.write_depth(stamp, 'camera', depth, CAMERA)
    out = tmp_path / 'view.rrd'
    assert main(['view', str(tmp_path / 'lost.mcap'), '--save', str(out), *with_(weights)]) == 0
    assert list(recorded(out, '/hands/hand_1/joints', 'Points3D:positions')) == STAMPS[:1]
    assert list(recorded(out, '/hands/hand_1/joints', 'Clear:is_recursive')) == STAMPS[1:2]


def test_damage_does_not_lose_what_came_before_it(tmp_path, weights, capsys):
    noise = np.random.default_rng(0).integers(500, 4000, (120, 160), np.uint16) * np.float32(0.001)
    with BagWriter(tmp_path / 'whole.mcap') as writer:
        for i in range(40):
            writer.write_depth(STAMPS[0] + i * 33_000_000, 'camera', noise, CAMERA, codec=None)
    data = (tmp_path / 'whole.mcap').read_bytes()
    cut, out = tmp_path / 'cut.mcap', tmp_path / 'cut.rrd'
    cut.write_bytes(data[:int(len(data) * 0.9)])
    assert main(['view', str(cut), '--save', str(out), *with_(weights)]) == 1
    assert 'cut.mcap' in capsys.readouterr().err
    assert 0 < len(recorded(out, '/camera/depth', 'DepthImage:buffer')) < 40


def test_a_failure_leaves_no_file_and_is_one_sentence(tmp_path, bag, weights, capsys, monkeypatch):
    assert main(['view', str(tmp_path / 'missing.bag'), '--save', str(tmp_path / 'a.rrd')]) == 1
    assert 'missing.bag: there is no such bag' in capsys.readouterr().err
    (tmp_path / 'file').touch()
    assert main(['view', str(bag), '--model', str(weights), '--save', str(tmp_path / 'file' / 'a.rrd')]) == 1
    assert 'a.rrd: cannot be written' in capsys.readouterr().err
    with BagWriter(tmp_path / 'bad.mcap') as writer:
        writer.write_depth(STAMPS[0], 'camera', np.zeros((60, 160), np.float32), CAMERA)  # another size than it says
    assert main(['view', str(tmp_path / 'bad.mcap'), '--model', str(weights), '--save', str(tmp_path / 'a.rrd')]) == 1
    assert 'none of its images could be used' in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, 'rerun', None)
    monkeypatch.setenv('DISPLAY', ':0')
    assert main(['view', str(bag), '--model', str(weights)]) == 1
    assert 'rerun-sdk' in capsys.readouterr().err
    assert not list(tmp_path.glob('*.rrd*')) and not list(tmp_path.glob('.*rrd*'))


def test_options_that_say_nothing_are_refused(bag, capsys):
    for more, message in ((('--depth-topic', '/cam/depth'), '--depth-topic is for bags'),
                          ((str(bag), '--transport', 'compressed'), '--transport is for live topics')):
        with pytest.raises(SystemExit):
            main(['view', *more])
        assert message in capsys.readouterr().err


def test_live_topics_are_saved_as_they_were_published(tmp_path, weights, ros_domain):
    pytest.importorskip('rclpy', reason='needs ROS 2')
    pytest.importorskip('hand_pose_ros.msg', reason='needs the compiled messages')
    from test_node import Rig, camera_info, depth_with_hand, image
    out = tmp_path / 'live.rrd'
    process = subprocess.Popen([sys.executable, '-m', 'hand_pose_ros.cli', 'view', '--save', str(out)])
    rig = Rig(weights)
    try:
        rig.start(side='right')
        publish = rig.camera(info=camera_info())
        rig.until(lambda: rig.client.count_subscribers('/depth/image_rect') == 2
                  and rig.client.count_subscribers('/hand/joints') == 2, 'the viewer', seconds=90)
        answers = {}
        for i in range(200):  # best effort: the first images may not reach it
            hands = rig.answer(publish, image(depth_with_hand(), 1000 + 33 * i)).hands
            answers[(1000 + 33 * i) * 1_000_000] = {
                hand.id: [(p.x, p.y, p.z) for p in hand.joints] for hand in hands}
            if i >= 20 and any(part.stat().st_size > 100_000 for part in tmp_path.glob('.live.rrd.*')):
                break
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    finally:
        process.kill()
        rig.close()
    images = recorded(out, '/camera/depth', 'DepthImage:buffer')
    joints = recorded(out, f'/hands/{hands[0].id}/joints', 'Points3D:positions')
    assert images and joints and set(images) | set(joints) <= set(answers)
    for stamp, points in joints.items():
        np.testing.assert_allclose(points, answers[stamp][hands[0].id], atol=1e-6)
