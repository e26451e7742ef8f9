"""What bags promise: three formats in, frame by frame with their camera; complete or not there at all when written."""

import os
import shutil
import sqlite3
import struct
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from hand_pose_ros.bags import Bag, BagWriter, DepthBag, check_frame, read_hands
from hand_pose_ros.bags.bag import typestore
from hand_pose_ros.errors import InputError
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.hand import SIDES
from hand_pose_ros.markers import HandMarkers, Marker
from hand_pose_ros.skeleton import HAND21, Skeleton

CAMERA = Intrinsics(300.5, 301.5, 31.5, 23.5, 64, 48)
STAMPS = [1_700_000_000_123_456_789 + i * 33_000_000 for i in range(12)]
BASE = 'depth/image_rect'


@pytest.fixture(scope='module')
def depths():
    units = np.random.default_rng(3).integers(0, 4000, (len(STAMPS), 48, 64), np.uint16)
    return [image * np.float32(0.001) for image in units]


def hand(seed):
    rng = np.random.default_rng(seed)
    return SimpleNamespace(
        id=f'hand_{seed}', side=('left', 'right')[seed % 2], score=0.75, joints=rng.normal(size=(21, 3)).astype('f4'),
        confidence=rng.random(21).astype('f4'), cube=Cube((0.1, -0.2, 0.6), 0.25))


def write(path, depths, codec=None, **options):
    with BagWriter(path, **options) as bag:
        for stamp, depth in zip(STAMPS, depths, strict=True):
            bag.write_depth(stamp, 'camera_optical', depth, CAMERA, codec=codec)
    return path


def write_ros1(path, depths, camera_first=True, encoding='16UC1'):
    store = get_typestore(Stores.ROS1_NOETIC)
    types, kinds = store.types, ('sensor_msgs/msg/CameraInfo', 'sensor_msgs/msg/Image')
    with Writer1(path) as bag:
        runs = [[bag.add_connection(topic, kind, typestore=store, callerid=driver)
                 for topic, kind in zip(('/cam/camera_info', '/cam/image'), kinds, strict=True)]
                for driver in ('/driver', '/driver_that_was_started_again')]
        for i, (stamp, depth) in enumerate(zip(STAMPS, depths, strict=True)):
            info, image = runs[i > 7]
            header = types['std_msgs/msg/Header'](
                seq=i, stamp=types['builtin_interfaces/msg/Time'](*divmod(stamp, 10**9)), frame_id='cam')
            k = np.array([CAMERA.fx, 0, CAMERA.cx, 0, CAMERA.fy, CAMERA.cy, 0, 0, 1])
            messages = [
                (info, kinds[0], types[kinds[0]](
                    header, 48, 64, 'plumb_bob', np.zeros(5), k, np.eye(3).ravel(), np.insert(k, [3, 6, 9], 0), 0, 0,
                    types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False))),
                (image, kinds[1], types[kinds[1]](
                    header, 48, 64, encoding, 0, 128, np.rint(depth * 1000).astype('<u2').view(np.uint8).ravel()))]
            for connection, kind, message in messages if camera_first else reversed(messages):
                bag.write(connection, stamp, store.serialize_ros1(message, kind))
    return path


def assert_same(path, depths, **options):
    with DepthBag(path, **options) as bag:
        assert len(bag) == len(depths)
        frames = list(bag)
    assert [frame.stamp_ns for frame in frames] == STAMPS
    for frame, depth in zip(frames, depths, strict=True):
        np.testing.assert_array_equal(frame.depth, depth)
        assert frame.intrinsics == CAMERA
    return frames


@pytest.mark.parametrize('name', ['bag.mcap', 'bag.db3', 'folder'])
@pytest.mark.parametrize('codec', [None, 'png', 'rvl'])
def test_depth_and_camera_come_back_as_written(tmp_path, depths, name, codec):
    frames = assert_same(write(tmp_path / name, depths, codec), depths)
    assert frames[0].frame_id == 'camera_optical'
    assert frames[0].topic == f'/{BASE}' + ('/compressedDepth' if codec else '')


def test_messages_are_those_of_a_rectified_depth_image(tmp_path, depths):
    with Bag(write(tmp_path / 'bag.mcap', depths)) as bag:
        messages = {connection.topic: bag.first(connection) for connection in bag.connections}
    assert messages[f'/{BASE}'].encoding == '16UC1', 'what depth_image_proc takes'
    info = messages['/depth/camera_info']
    k = [300.5, 0, 31.5, 0, 301.5, 23.5, 0, 0, 1]
    assert info.k.tolist() == k and info.p.tolist() == np.insert(k, [3, 6, 9], 0).tolist(), 'depth_image_proc reads p'
    assert info.r.tolist() == np.eye(3).ravel().tolist()
    assert info.distortion_model == 'plumb_bob' and not info.d.any()


def test_images_come_back_as_written_in_whatever_order_they_lie_in_memory(tmp_path, depths):
    assert_same(write(tmp_path / 'bag.mcap', [np.asfortranarray(depth) for depth in depths]), depths)


@pytest.mark.parametrize('name', ['bag.mcap', 'bag.db3'])
def test_stamps_may_be_those_of_an_array(tmp_path, depths, name):
    with BagWriter(tmp_path / name) as bag:
        for stamp, depth in zip(np.array(STAMPS), depths, strict=True):
            bag.write_depth(stamp, 'camera_optical', depth, CAMERA)
            bag.write_hands(stamp, 'camera_optical', [hand(0)])
    assert_same(tmp_path / name, depths)
    assert [hands.stamp_ns for hands in read_hands(tmp_path / name)] == STAMPS


@pytest.mark.parametrize('name', ['run#1?.db3', 'a%42.db3', os.fsdecode(b'\xff.db3'), 'run#1'])
def test_sqlite3_takes_any_name(tmp_path, depths, name):
    write(tmp_path / 'aB.db3', depths[::-1])  # what a%42.db3 would mean in a URI
    assert_same(write(tmp_path / name, depths, storage='sqlite3'), depths)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, 'aB.db3'])


def test_a_damaged_sqlite3_bag_is_told_by_its_name(tmp_path):
    (tmp_path / 'a b%.db3').write_bytes(b'no database')
    with pytest.raises(InputError, match=r'^[^%]*/a b%\.db3: the bag cannot be opened'):
        Bag(tmp_path / 'a b%.db3')


def test_sqlite3_folder(tmp_path, depths):
    path = write(tmp_path / 'new' / 'place' / 'folder', depths, storage='sqlite3')
    assert list(path.glob('*.db3')) and (path / 'metadata.yaml').is_file()
    assert_same(path, depths)


@pytest.mark.parametrize('camera_first', [True, False])
def test_ros1_bags_come_back_frame_by_frame(tmp_path, depths, camera_first):
    """Also where the first image was recorded before its camera_info."""
    frames = assert_same(write_ros1(tmp_path / 'old.bag', depths, camera_first), depths)
    assert frames[0].frame_id == 'cam'


@pytest.mark.parametrize(('name', 'topic'), [
    ('raw', ''), ('compressedDepth', '/compressedDepth'), ('compressed', '/compressed')])
def test_recorded_bags_of_all_transports_hold_the_same_image(shared_data, name, topic):
    given = (200.0, 200.0, 212.0, 120.0)
    with DepthBag(shared_data / f'bags/{name}.bag', intrinsics=given) as bag:
        assert bag.depth_topic == f'/spot/depth/frontleft/image{topic}'
        [frame] = bag
    assert frame.depth.shape == (240, 424) and (frame.depth > 0).sum() == 65429
    assert frame.intrinsics == Intrinsics(*given, 424, 240)
    with Bag(shared_data / 'bags/raw.bag') as raw:
        [connection] = [c for c in raw.connections if c.topic == '/spot/depth/frontleft/image']
        pixels = np.frombuffer(raw.first(connection).data, '<u2').reshape(240, 424)
    np.testing.assert_array_equal(frame.depth, pixels * np.float32(0.001))


def test_without_camera_info_the_remedy_is_named(shared_data):
    wanted = '/spot/depth/frontleft/camera_info'
    with pytest.raises(InputError, match=rf'raw\.bag: .*CameraInfo on {wanted}: give .*intrinsics'):
        DepthBag(shared_data / 'bags/raw.bag')


def test_colour_images_are_not_taken_for_depth(shared_data):
    bag = DepthBag(shared_data / 'bags/raw.bag', depth_topic='/spot/camera/hand_color/image', intrinsics=(1, 1, 0, 0))
    with bag, pytest.raises(InputError, match=r"^/spot/camera/hand_color/image: the encoding 'rgb8' is not depth"):
        _ = next(iter(bag)).depth


def test_a_bag_without_depth_is_refused(tmp_path, depths):
    with pytest.raises(InputError, match=r'colour\.bag: no topic carries depth'):
        DepthBag(write_ros1(tmp_path / 'colour.bag', depths, encoding='bgr8'))
    with BagWriter(tmp_path / 'empty.mcap'):
        pass
    with pytest.raises(InputError, match=r'empty\.mcap: no topic carries depth, .* \(this one has no messages\)'):
        DepthBag(tmp_path / 'empty.mcap')


def test_a_transport_that_is_not_read_is_named(tmp_path):
    topic, image, types = '/depth/image/zstd', 'sensor_msgs/msg/CompressedImage', typestore().types
    with BagWriter(tmp_path / 'zstd.mcap') as bag:
        bag.write(topic, image, types[image](bag._header(10**9, 'camera'), 'zstd', np.zeros(20, np.uint8)), 10**9)
    with pytest.raises(InputError, match=rf'zstd\.mcap: .* of {topic} the transport zstd is not read: convert it with'):
        DepthBag(tmp_path / 'zstd.mcap')
    with DepthBag(tmp_path / 'zstd.mcap', topic, intrinsics=(1, 1, 0, 0)) as bag, pytest.raises(
            InputError, match=f'^{topic}: the transport zstd is not read: convert it with'):
        _ = next(iter(bag)).depth


def test_of_several_depth_topics_one_must_be_chosen(tmp_path, depths):
    with BagWriter(tmp_path / 'two.mcap') as bag:
        for name, camera in (('left', Intrinsics(600, 600, 31.5, 23.5, 64, 48)), ('right', CAMERA)):
            bag.write_depth(STAMPS[0], name, depths[name == 'right'], camera, topic=f'/{name}/image', codec=None)
        bag._writer.add_connection('/never/image', 'sensor_msgs/msg/Image', typestore=typestore())
    with pytest.raises(InputError, match=r'carry depth: choose one with --depth-topic: /left/image, /right/image$'):
        DepthBag(tmp_path / 'two.mcap')
    with pytest.raises(InputError, match='on /never/image: give another depth topic') as error:
        DepthBag(tmp_path / 'two.mcap', depth_topic='/never/image')
    assert str(error.value).count('/never/image') == 1, 'what was never published is not among what the bag has'
    with DepthBag(tmp_path / 'two.mcap', depth_topic='/right/image') as bag:
        [frame] = bag
    np.testing.assert_array_equal(frame.depth, depths[1])
    assert frame.intrinsics == CAMERA
    with DepthBag(tmp_path / 'two.mcap', '/right/image', camera_info_topic='/left/camera_info') as bag:
        assert next(iter(bag)).intrinsics.fx == 600
    for topic in ('/middle/image', '/left/camera_info'):
        with pytest.raises(InputError, match=f'no sensor_msgs/Image or sensor_msgs/CompressedImage on {topic}'):
            DepthBag(tmp_path / 'two.mcap', depth_topic=topic)


def test_a_crop_that_the_node_published_is_no_depth(tmp_path, depths):
    """It is recorded where everything is, and whoever trains on bags cannot choose a topic."""
    with BagWriter(tmp_path / 'all.mcap') as bag:
        for topic in ('/estimator/debug/crop', f'/{BASE}'):
            bag.write_depth(STAMPS[0], 'camera', depths[0], CAMERA, topic=topic, codec=None)
    with DepthBag(tmp_path / 'all.mcap') as bag:
        assert bag.depth_topic == f'/{BASE}'


def test_transports_of_one_image_are_one_topic(tmp_path, depths):
    with BagWriter(tmp_path / 'both.mcap') as bag:
        for codec in (None, 'png'):
            bag.write_depth(STAMPS[0], 'camera', depths[0], CAMERA, codec=codec)
    with DepthBag(tmp_path / 'both.mcap') as bag:
        assert bag.depth_topic == f'/{BASE}' and len(bag) == 1
    with BagWriter(tmp_path / 'compressed.mcap') as bag:
        for image in (f'{BASE}/compressed', BASE):  # becomes .../compressed/compressedDepth, which no transport has
            bag.write_depth(STAMPS[0], 'camera', depths[0], CAMERA, codec='png', topic=f'/{image}')
    with pytest.raises(InputError, match='several topics carry depth'), DepthBag(tmp_path / 'compressed.mcap'):
        pass


def test_a_camera_info_of_another_size_is_refused_for_its_frame(tmp_path, depths):
    with BagWriter(tmp_path / 'bag.mcap') as bag:
        bag.write_depth(STAMPS[0], 'camera', depths[0], Intrinsics(300, 300, 160, 120, 320, 240))
    with DepthBag(tmp_path / 'bag.mcap') as bag:
        [frame] = bag
    with pytest.raises(InputError, match=r'^/depth/image_rect/compressedDepth: .*64x48 .*320x240'):
        _ = frame.intrinsics


@pytest.mark.parametrize('empty', [{0}, {5}, {0, 1, 2}, set(range(12))])
def test_a_camera_info_that_is_empty_is_passed_over(tmp_path, depths, empty):
    with BagWriter(tmp_path / 'bag.mcap') as bag:
        for i, (stamp, depth) in enumerate(zip(STAMPS, depths, strict=True)):
            camera = CAMERA if i not in empty else SimpleNamespace(fx=0.0, fy=0.0, cx=0.0, cy=0.0, width=64, height=48)
            bag.write_depth(stamp, 'camera_optical', depth, camera, codec=None)
    if len(empty) < len(STAMPS):
        assert_same(tmp_path / 'bag.mcap', depths)
    else:
        with DepthBag(tmp_path / 'bag.mcap') as bag, \
                pytest.raises(InputError, match=r'not calibrated; calibrate it, or give --intrinsics'):
            list(bag)


def test_the_newest_camera_info_counts(tmp_path, depths):
    zoomed = Intrinsics(600, 600, 31.5, 23.5, 64, 48)
    with BagWriter(tmp_path / 'zoom.mcap') as bag:
        for stamp, camera in zip(STAMPS[:4], (CAMERA, CAMERA, zoomed, zoomed), strict=True):
            bag.write_depth(stamp, 'camera', depths[0], camera)
    with DepthBag(tmp_path / 'zoom.mcap') as bag:
        assert [frame.intrinsics.fx for frame in bag] == [300.5, 300.5, 600, 600]


def test_each_image_has_the_camera_of_its_frame(tmp_path, depths):
    frame_ids = ['left', 'right', 'unknown']
    with BagWriter(tmp_path / 'two.mcap') as bag:
        write = bag.write_serialized

        def record(topic, kind, data, at, **more):
            if not topic.endswith('info'):
                write(topic, kind, data, at + 5, **more)
            elif at != STAMPS[2]:  # the third frame has no camera_info
                write(topic, kind, data, at - 10**9, **more)  # and the others come before all images

        bag.write_serialized = record
        for i, frame_id in enumerate(frame_ids):
            bag.write_depth(STAMPS[i], frame_id, depths[0], Intrinsics(300 + i, 300, 32, 24, 64, 48))
    with DepthBag(tmp_path / 'two.mcap', depth_scale=0.01) as bag:
        frames = list(bag)
    assert [frame.frame_id for frame in frames] == frame_ids
    assert [frame.intrinsics.fx for frame in frames] == [300, 301, 301], 'where there is no other, the newest counts'
    assert [(frame.stamp_ns, frame.recorded_ns - 5) for frame in frames] == [(at, at) for at in STAMPS[:3]]
    np.testing.assert_allclose(frames[0].depth, 10 * depths[0], rtol=1e-6)


def test_a_damaged_image_spoils_only_itself(tmp_path, depths):
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as bag:
        for i, stamp in enumerate(STAMPS[:3]):
            bag.write_depth(stamp, 'camera', depths[i], CAMERA, codec='rvl')
    data = bytearray(path.read_bytes())
    second = [i for i in range(len(data)) if data.startswith(struct.pack('<II', 64, 48), i)][1]
    data[second:second + 8] = struct.pack('<II', 64, 480)
    path.write_bytes(data)
    with DepthBag(path) as bag:
        frames = list(bag)
    with pytest.raises(InputError, match=f'^/{BASE}/compressedDepth: .*RVL'):
        _ = frames[1].depth
    np.testing.assert_array_equal(frames[2].depth, depths[2])


@pytest.mark.parametrize('partly', [False, True])
def test_a_message_that_is_damaged_is_named(tmp_path, partly):
    with BagWriter(tmp_path / 'bag.mcap') as bag:
        bag.write_serialized('/hand/joints', 'hand_pose_ros/msg/HandJointsArray', b'\0\1\0\0\1', 1)
    with pytest.raises(InputError, match=r'bag\.mcap: a message on /hand/joints is damaged .*: record or copy'):
        read_hands(tmp_path / 'bag.mcap', partly=partly)


def test_a_bag_may_be_read_from_a_time_on(tmp_path, depths):
    with Bag(write(tmp_path / 'bag.mcap', depths)) as bag:
        assert bag.start_ns == STAMPS[0]
        times = [at for _, at, _ in bag.messages(bag.connections, start=STAMPS[5])]
    assert times == sorted(2 * STAMPS[5:])


def test_a_bag_that_is_damaged_in_the_middle_says_how_far_it_could_be_read(tmp_path):
    noise = np.random.default_rng(0).integers(1, 4000, (240, 320), np.uint16) * np.float32(0.001)
    with BagWriter(tmp_path / 'bag.db3') as bag:
        for i in range(6):
            bag.write_depth(STAMPS[0] + i, 'camera', noise, Intrinsics(300, 300, 160, 120, 320, 240), codec=None)
    with open(tmp_path / 'bag.db3', 'r+b') as file:
        file.seek(file.seek(0, os.SEEK_END) // 2 // 4096 * 4096)
        file.write(b'\xff' * 8192)
    frames, said = read_until_damage(tmp_path / 'bag.db3')
    assert 0 < len(frames) < 6
    assert f'bag.db3: the bag is damaged after {2 * len(frames) + 1} messages (' in said
    assert f'({len(frames)} of 6 depth images were read)' in said


def read_until_damage(path):
    """Depth images before the error, and its message."""
    frames = []
    with pytest.raises(InputError) as error, DepthBag(path) as bag:
        for frame in bag:
            frames.append(frame.depth)
    return frames, str(error.value)


@pytest.mark.parametrize('keep', [0.85, 0.97, 0.9999])
def test_an_interrupted_mcap_gives_what_was_complete(tmp_path, depths, keep):
    noise = np.random.default_rng(0).integers(1, 4000, (240, 320), np.uint16) * np.float32(0.001)
    camera = Intrinsics(300, 300, 160, 120, 320, 240)
    path = tmp_path / 'whole.mcap'
    with BagWriter(path) as bag:
        for i in range(20):
            bag.write_depth(STAMPS[0] + i, 'camera', noise, camera, codec=None)
    data = path.read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(data[:int(len(data) * keep)])
    frames, said = read_until_damage(tmp_path / 'cut.mcap')
    assert 1 <= len(frames) <= 20
    for depth in frames:
        np.testing.assert_array_equal(depth, noise)
    assert 'cut.mcap: the bag was cut short' in said and f'`mcap recover {tmp_path}/cut.mcap -o repaired.mcap`' in said
    assert f'{len(frames)} of' in said


def test_an_interrupted_mcap_may_end_anywhere(tmp_path, depths):
    data = write(tmp_path / 'whole.mcap', depths).read_bytes()
    end = data.rindex(struct.pack('<BQ', 0x0f, 4))  # of the data section
    for rest in (data[:end], *(data[:end - cut] for cut in range(1, 20)), data[:end] + bytes(100)):
        (tmp_path / 'cut.mcap').write_bytes(rest)
        frames, said = read_until_damage(tmp_path / 'cut.mcap')
        assert len(frames) == len(depths) and 'cut.mcap: the bag was cut short' in said
    at = 8
    while data[at] != 0x06:  # the only chunk
        at += 9 + struct.unpack_from('<Q', data, at + 1)[0]
    at += 9 + struct.unpack_from('<Q', data, at + 1)[0]
    (tmp_path / 'cut.mcap').write_bytes(data[:at])
    assert len(read_until_damage(tmp_path / 'cut.mcap')[0]) == len(depths)
    (tmp_path / 'cut.mcap').write_bytes(data[:at - 1])
    with pytest.raises(InputError, match='cut short before its first chunk was complete'):
        DepthBag(tmp_path / 'cut.mcap')


def test_a_folder_without_metadata_is_read(tmp_path, depths):
    """As `ros2 bag record` leaves it when it is killed."""
    path = write(tmp_path / 'folder', depths)
    (path / 'metadata.yaml').unlink()
    assert_same(path, depths)
    shutil.copy(path / 'folder.mcap', path / 'folder_1.mcap')  # which of several is to be read first?
    with pytest.raises(InputError, match=r'folder: there is no metadata\.yaml .* `ros2 bag reindex .*folder`'):
        DepthBag(path)
    (tmp_path / 'damaged').mkdir()
    (tmp_path / 'damaged' / 'a_0.db3').write_text('x')
    with pytest.raises(InputError, match=r'a_0\.db3: .* database .* `sqlite3 .*/a_0\.db3 \.recover'):
        DepthBag(tmp_path / 'damaged')
    (path / 'folder_1.mcap').unlink()
    data = (path / 'folder.mcap').read_bytes()
    (path / 'folder.mcap').write_bytes(data[:data.rindex(struct.pack('<BQ', 0x0f, 4))])
    frames, said = read_until_damage(path)
    assert len(frames) == len(depths) and 'folder: the bag was cut short' in said
    path = write(tmp_path / 'run#1', depths, storage='sqlite3')
    (path / 'metadata.yaml').unlink()
    assert_same(path, depths)


@pytest.mark.parametrize(('name', 'remedy'), [
    ('cut.bag', '`rosbag reindex .*/cut.bag`'), ('cut.db3', '`sqlite3 .*/cut.db3 .recover | sqlite3 repaired.db3`'),
    ('cut it.mcap', "`mcap recover '.*/cut it.mcap' -o repaired.mcap`")])
def test_a_bag_that_is_cut_to_pieces_names_the_repair(tmp_path, depths, name, remedy):
    whole = tmp_path / f'whole{Path(name).suffix}'
    write_ros1(whole, depths) if name.endswith('.bag') else write(whole, depths)
    (tmp_path / name).write_bytes(whole.read_bytes()[:3000])
    with pytest.raises(InputError, match=f'{name}: .*{remedy}') as error:
        DepthBag(tmp_path / name)
    assert '\n' not in str(error.value)
    assert ('before its first chunk was complete' in str(error.value)) == name.endswith('.mcap')


def test_what_is_no_bag_is_refused(tmp_path):
    (tmp_path / 'notes.txt').write_text('hello')
    (tmp_path / 'empty.mcap').touch()
    (tmp_path / 'text.mcap').write_text('hello')
    for name, reason in (('missing.mcap', 'no such bag'), ('notes.txt', 'give a .bag'), ('empty.mcap', 'it is empty'),
                         ('text.mcap', 'it is no MCAP file'), ('.', 'give a .bag')):
        with pytest.raises(InputError, match=reason) as error:
            Bag(tmp_path / name)
        assert ('ros2 bag reindex' in str(error.value)) == (name == '.'), 'that is for folders'


def test_hands_come_back_as_written(tmp_path):
    hands = [[], [hand(1)], [hand(2), hand(3)]]
    with BagWriter(tmp_path / 'hands.mcap') as bag:
        bag.write_skeleton(STAMPS[0], 'camera', HAND21, 'a network', '1.2')
        for stamp, present in zip(STAMPS[:3], hands, strict=True):
            bag.write_hands(stamp, 'camera', present)
    recorded = read_hands(tmp_path / 'hands.mcap')
    assert [record.stamp_ns for record in recorded] == STAMPS[:3]
    for record, present in zip(recorded, hands, strict=True):
        assert record.joints.shape == (len(present), 21, 3) and record.confidence.shape == (len(present), 21)
        assert record.frame_id == 'camera' and record.skeleton == 'hand21'
        assert record.sides == tuple(h.side for h in present) and record.ids == tuple(h.id for h in present)
        for i, h in enumerate(present):
            np.testing.assert_array_equal(record.joints[i], h.joints)
            np.testing.assert_array_equal(record.confidence[i], h.confidence)
            assert record.scores[i] == h.score
    with Bag(tmp_path / 'hands.mcap') as bag:
        [joints] = [connection for connection in bag.connections if connection.topic == '/hand/joints']
        *_, last = (bag.deserialize(joints, data) for _, _, data in bag.messages([joints]))
    for message in last.hands:
        center = message.cube_center
        assert (center.x, center.y, center.z, message.cube_size) == pytest.approx((0.1, -0.2, 0.6, 0.25))
    with pytest.raises(InputError, match='no hand_pose_ros/HandJointsArray on /other: choose one of /hand/joints'):
        read_hands(tmp_path / 'hands.mcap', topic='/other')
    message = typestore().types['hand_pose_ros/msg/HandJoints']
    assert [getattr(message, side.upper()) for side in SIDES] == [0, 1, 2]


@pytest.mark.parametrize('skeleton', [HAND21, Skeleton('paw', ('toe',), (-1,))])
def test_hands_without_all_their_joints_are_refused(tmp_path, skeleton):
    whole, part, unsure = hand(1), hand(1), hand(1)
    part.joints, part.confidence = part.joints[:20], part.confidence[:20]
    unsure.confidence = unsure.confidence[:20]
    for name, hands in (('part', [part]), ('both', [whole, part]), ('unsure', [unsure])):
        with BagWriter(tmp_path / f'{name}.mcap') as bag:
            bag.write_hands(STAMPS[0], 'camera', hands, skeleton)
    for name in ('both', 'unsure'):
        with pytest.raises(InputError, match=fr'joints and confidences, but all must have 21 \({skeleton.name}\)'):
            read_hands(tmp_path / f'{name}.mcap')
    if skeleton == HAND21:
        with pytest.raises(InputError, match=r'part.mcap: /hand/joints: .* have \[20\] joints'):
            read_hands(tmp_path / 'part.mcap')
    else:  # how many an unknown one has is not known
        [record] = read_hands(tmp_path / 'part.mcap')
        assert record.skeleton == 'paw' and record.joints.shape == (1, 20, 3)


def test_of_several_topics_of_hands_one_must_be_chosen(tmp_path):
    with BagWriter(tmp_path / 'two.mcap') as bag:
        for i, topic in enumerate(('/right', '/left')):
            bag.write_hands(STAMPS[i], 'camera', [hand(i)], topic=topic)
    with pytest.raises(InputError, match=r'several topics carry .*HandJointsArray: choose one of /left, /right$'):
        read_hands(tmp_path / 'two.mcap')
    assert [record.ids for record in read_hands(tmp_path / 'two.mcap', '/left')] == [('hand_1',)]


def test_hands_before_damage_are_read_where_part_of_them_is_enough(tmp_path):
    with BagWriter(tmp_path / 'whole.mcap') as bag:
        for stamp in range(4000):  # more than one chunk
            bag.write_hands(stamp, 'camera', [hand(1)] if stamp % 500 == 0 else [])
            bag.write('/noise', 'std_msgs/msg/String', typestore().types['std_msgs/msg/String']('x' * 500), stamp)
    data = (tmp_path / 'whole.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(data[:len(data) * 3 // 4])
    with pytest.raises(InputError, match=r'cut\.mcap: the bag was cut short'):
        read_hands(tmp_path / 'cut.mcap')
    stamps = [record.stamp_ns for record in read_hands(tmp_path / 'cut.mcap', partly=True)]
    assert 0 < len(stamps) < 4000 and stamps == list(range(len(stamps)))


def test_hands_and_images_of_other_frames_do_not_belong_together():
    check_frame('bag', 'camera', 'camera')
    check_frame('bag', '', 'camera')  # who gives no name may mean any
    check_frame('bag', 'camera', '')
    with pytest.raises(InputError, match=r"^bag: .* joints are in frame 'world', but the images in 'camera'"):
        check_frame('bag', 'world', 'camera')


def test_markers_come_back_as_written(tmp_path):
    markers = [*HandMarkers(HAND21).update([hand(1)]), Marker('gone', action=2)]
    with BagWriter(tmp_path / 'markers.mcap') as bag:
        bag.write_markers(1, 'camera', markers)
    with Bag(tmp_path / 'markers.mcap') as bag:
        shown = bag.first(bag.connections[0]).markers
    for message, marker in zip(shown, markers, strict=True):
        assert (message.ns, message.type, message.action) == (marker.namespace, marker.type, marker.action)
        assert (message.header.frame_id, message.header.stamp.nanosec) == ('camera', 1)
        assert (message.lifetime.sec, message.lifetime.nanosec) == (0, 0), 'it is shown until it is deleted'
        assert message.pose.orientation.w == 1 and not message.frame_locked
        assert (message.scale.x, message.scale.y, message.scale.z) == tuple(marker.scale)
        assert [(p.x, p.y, p.z) for p in message.points] == [tuple(map(float, point)) for point in marker.points]
        colors = [(c.r, c.g, c.b, c.a) for c in message.colors]
        np.testing.assert_allclose(colors, list(marker.colors), rtol=1e-6)


@pytest.mark.parametrize('recorded', [9, 0])  # clocks of simulators begin at 0
def test_hands_are_recorded_at_any_time(tmp_path, recorded):
    with BagWriter(tmp_path / 'hands.mcap') as bag:
        bag.write_skeleton(1, 'camera', HAND21, 'a network', '1.2', recorded_ns=recorded)
        bag.write_hands(1, 'camera', [hand(1)], recorded_ns=recorded)
        bag.write_markers(1, 'camera', [], recorded_ns=recorded)
    with Bag(tmp_path / 'hands.mcap') as bag:
        assert [at for _, at, _ in bag.messages(bag.connections)] == [recorded] * 3
    assert read_hands(tmp_path / 'hands.mcap')[0].stamp_ns == 1


def test_the_skeleton_is_recorded_latched(tmp_path):
    paw = Skeleton('paw', ('palm', 'toe'), (-1, 0))
    with BagWriter(tmp_path / 'hands.mcap') as bag:
        bag.write_skeleton(STAMPS[0], 'camera', paw, 'a network', '1.2')
        bag.write_hands(STAMPS[0], 'camera', [], paw)
    with Bag(tmp_path / 'hands.mcap') as bag:
        offered = {connection.topic: connection.ext.offered_qos_profiles for connection in bag.connections}
        message = bag.first(next(one for one in bag.connections if one.topic == '/hand/skeleton'))
    for topic, wanted in (('/hand/skeleton', ('TRANSIENT_LOCAL', 1)), ('/hand/joints', ('VOLATILE', 10))):
        [qos] = offered[topic]
        assert (qos.durability.name, qos.depth) == wanted
        assert qos.reliability.name == 'RELIABLE', 'else who wants that gets nothing from a player'
    assert tuple(message.joint_names) == paw.joint_names and tuple(message.parents) == paw.parents
    assert (message.name, message.model, message.model_version) == ('paw', 'a network', '1.2')


def test_a_bag_behind_a_link_is_written_where_that_leads(tmp_path, depths):
    (tmp_path / 'disk').mkdir()
    (tmp_path / 'bag.mcap').symlink_to(tmp_path / 'disk' / 'other.mcap')
    with BagWriter(tmp_path / 'bag.mcap'):
        assert list((tmp_path / 'disk').iterdir()), 'what is written elsewhere cannot be moved to another disk'
    assert_same(write(tmp_path / 'bag.mcap', depths), depths)
    assert (tmp_path / 'bag.mcap').is_symlink() and (tmp_path / 'disk' / 'other.mcap').is_file()


def test_a_fifo_is_not_replaced_by_a_bag(tmp_path):
    os.mkfifo(tmp_path / 'bag.mcap')
    with pytest.raises(InputError, match=r'bag\.mcap: there is something already'):
        BagWriter(tmp_path / 'bag.mcap')
    assert (tmp_path / 'bag.mcap').is_fifo()


def test_a_folder_where_a_bag_of_one_file_is_to_be_is_refused_at_once(tmp_path):
    (tmp_path / 'bag.mcap').mkdir()
    with pytest.raises(InputError, match='there is something already'), BagWriter(tmp_path / 'bag.mcap'):
        pytest.fail('after minutes of work it would be too late')
    (tmp_path / 'file').touch()
    with pytest.raises(InputError, match='there is something already'), BagWriter(tmp_path / 'file'):
        pytest.fail('a bag of many files does not fit into one')
    with pytest.raises(InputError, match=r'file/new\.mcap: the bag cannot be written \(.*\): choose another place'):
        BagWriter(tmp_path / 'file' / 'new.mcap')
    with pytest.raises(InputError, match=r'give a \.bag, \.mcap or \.db3 file'):
        Bag(tmp_path / 'bag.mcap')


@pytest.mark.parametrize('metadata', ['rosbag2_bagfile_information:\n  files: [\n', 'a: b: c\n'])
def test_metadata_that_is_damaged_is_told_in_one_line(tmp_path, depths, metadata):
    write(tmp_path / 'bag', depths)
    (tmp_path / 'bag' / 'metadata.yaml').write_text(metadata)
    (tmp_path / 'bag' / 'another.mcap').touch()  # else the only file would be read without it
    with pytest.raises(InputError, match=r'cannot be opened .*reindex') as caught:
        Bag(tmp_path / 'bag')
    assert '\n' not in str(caught.value)


def test_messages_that_are_counted_but_lost_are_told(tmp_path, depths):
    path = write(tmp_path / 'bag', depths, storage='sqlite3')
    with sqlite3.connect(path / 'bag.db3') as database:
        database.execute("DELETE FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name LIKE '%camera_info')")
    with pytest.raises(InputError, match='bag: the bag counts messages of camera_info that are not there'), \
            DepthBag(path) as bag:
        next(iter(bag))
    with sqlite3.connect(path / 'bag.db3') as database:
        database.execute('DELETE FROM messages')
    with pytest.raises(InputError, match=f'bag: the bag counts messages on /{BASE} that are not there'):
        DepthBag(path)


def test_hands_are_read_where_the_bag_does_not_define_them(tmp_path):
    """As ROS 2 Humble records them with sqlite3."""
    with BagWriter(tmp_path / 'bag.db3') as bag:
        bag.write_hands(1, 'camera', [hand(1)])
    with sqlite3.connect(tmp_path / 'bag.db3') as database:
        assert database.execute('DELETE FROM message_definitions').rowcount
    assert read_hands(tmp_path / 'bag.db3')[0].ids == ('hand_1',)


def test_a_bag_that_was_closed_is_not_called_damaged(tmp_path, depths):
    with DepthBag(write(tmp_path / 'bag.mcap', depths)) as bag:
        frames = iter(bag)
        next(frames)
    for read in (lambda: next(frames), lambda: list(bag), lambda: bag.first(bag.connections[0])):
        with pytest.raises(InputError, match=r'bag\.mcap: the bag was closed'):
            read()
    bag.close()  # once more does no harm


def test_a_bag_may_be_closed_or_given_up_before_its_block_ends(tmp_path):
    with BagWriter(tmp_path / 'closed.mcap') as bag:
        bag.write_hands(1, 'camera', [hand(0)])
        bag.close()
    assert len(read_hands(tmp_path / 'closed.mcap')) == 1
    with BagWriter(tmp_path / 'given_up.mcap') as bag:
        bag.abort()
    assert [path.name for path in tmp_path.iterdir()] == ['closed.mcap']


def test_unknown_storage_is_named_and_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match="unknown storage 'sqlite': choose mcap or sqlite3"):
        BagWriter(tmp_path / 'folder', storage='sqlite')
    assert list(tmp_path.iterdir()) == []


def test_a_bag_appears_only_when_it_is_complete(tmp_path, depths):
    path = tmp_path / 'bag.mcap'
    path.write_text('what was there before')
    with pytest.raises(RuntimeError), BagWriter(path) as bag:
        bag.write_depth(STAMPS[0], 'camera', depths[0], CAMERA)
        raise RuntimeError
    assert path.read_text() == 'what was there before'
    write(path, depths)
    assert_same(path, depths)
    assert [p.name for p in tmp_path.iterdir()] == ['bag.mcap']
    (tmp_path / 'folder').mkdir()
    with pytest.raises(InputError, match='something already'):
        BagWriter(tmp_path / 'folder')


@pytest.mark.parametrize('storage', ['MCAP', 'SQLITE3'])
def test_messages_that_are_compressed_one_by_one_need_their_folder(tmp_path, storage):
    plain, packed = tmp_path / 'plain.mcap', tmp_path / 'packed'
    with BagWriter(plain) as bag:
        bag.write_depth(STAMPS[0], 'camera', np.ones((48, 64), np.float32), CAMERA, codec=None)
    writer = Writer2(packed, version=9, storage_plugin=StoragePlugin[storage])
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer, Bag(plain) as bag:
        topics = {connection.topic: writer.add_connection(connection.topic, connection.msgtype, typestore=typestore())
                  for connection in bag.connections}
        for connection, stamp, data in bag.messages(bag.connections):
            writer.write(topics[connection.topic], stamp, data)
    with DepthBag(packed) as bag:
        assert len([frame.depth for frame in bag]) == 1
    file = next(path for path in packed.iterdir() if path.suffix in ('.mcap', '.db3'))
    with pytest.raises(InputError, match=r'its messages are compressed, .*: give the folder'), \
            DepthBag(file) as bag:
        list(bag)


@pytest.mark.parametrize('when', ['write', 'close'])
@pytest.mark.parametrize('name', ['x.mcap', 'x.db3', 'folder'])
def test_a_full_disk_is_told_of_with_the_bag(tmp_path, monkeypatch, name, when):
    def full(*_):
        raise OSError(28, 'No space left on device') if name != 'x.db3' else sqlite3.OperationalError(
            'database or disk is full')

    bag = BagWriter(tmp_path / name)
    for attempt in (when, 'abort'):  # which flushes a buffer
        monkeypatch.setattr(bag._writer, attempt, full)
    with pytest.raises(InputError, match=f'{name}: cannot be written, for the disk is full'), bag:
        bag.write_depth(1, 'camera', np.ones((120, 160), np.float32), Intrinsics(150, 150, 80, 60, 160, 120))
    assert not list(tmp_path.iterdir())


def test_a_disk_that_is_full_before_a_bag_begins_is_told_and_leaves_nothing(tmp_path):
    command = [sys.executable, '-m', 'hand_pose_ros.cli', 'synth', 'record', str(tmp_path / 'x.db3'), '--number', '1']
    done = subprocess.run(['bash', '-c', 'ulimit -f 4; "$@"', 'bash', *command], capture_output=True, text=True)
    assert done.returncode == 1 and not list(tmp_path.iterdir())
    assert done.stderr == (
        f'hand-pose synth: {tmp_path}/x.db3: cannot be written (disk I/O error): choose another place\n')
