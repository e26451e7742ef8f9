"""Datasets are read in the formats they are distributed in, and samples are kept on disk without surprises."""

import gzip
import logging
import multiprocessing
import os
import shutil
import struct
import zlib
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from scipy.io import savemat

from hand_pose_ros.bags import BagWriter, DepthBag, read_hands
from hand_pose_ros.datasets import DatasetError, joints_in_metres, open_dataset
from hand_pose_ros.datasets import bags as bags_module
from hand_pose_ros.datasets import icvl as icvl_module
from hand_pose_ros.datasets import msra as msra_module
from hand_pose_ros.datasets import nyu as nyu_module
from hand_pose_ros.datasets.base import center_of_mass_cube
from hand_pose_ros.datasets.shards import DiskShards, MemoryShards
from hand_pose_ros.errors import InputError
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.skeleton import HAND21, Skeleton
from hand_pose_ros.synthetic import benchmark

SPLITS = ('train', 'val', 'test', 'test_1', 'test_2')


def blob(intrinsics: Intrinsics, center: np.ndarray, radius: float = 0.06) -> np.ndarray:
    """A ball (its front, roughly) in front of nothing; depth in metres."""
    v, u = np.mgrid[:intrinsics.height, :intrinsics.width]
    cu, cv = intrinsics.project(center)
    reach = radius * intrinsics.fx / center[2]
    away = ((u - cu) ** 2 + (v - cv) ** 2) / reach ** 2
    return np.where(away < 1, center[2] - radius * np.sqrt(np.clip(1 - away, 0, None)), 0).astype(np.float32)


def scattered(rng: np.random.Generator, joints: int, center: np.ndarray) -> np.ndarray:
    return center + rng.uniform(-0.04, 0.04, (joints, 3))


# NYU

def write_nyu(root: Path, part: str, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Joints (N, 36, 3) in metres, optical frame."""
    folder = root / part
    folder.mkdir(parents=True)
    joints = np.stack([scattered(rng, 36, np.array([0.05 * i, 0.02, 0.7])) for i in range(frames)])
    in_file = joints * (1000, -1000, 1000)
    savemat(folder / 'joint_data.mat', {'joint_xyz': np.stack([in_file, in_file + 7, in_file - 7]),
                                        'joint_uvd': np.zeros((3, frames, 36, 3))})
    for i in range(frames):
        millimetres = (blob(nyu_module.INTRINSICS, joints[i].mean(0)) * 1000).round().astype(np.uint16)
        millimetres[millimetres == 0] = 2001
        write_nyu_png(folder / f'depth_1_{i + 1:07d}.png', millimetres)
    return joints


def write_nyu_png(path: Path, millimetres: np.ndarray) -> None:
    image = np.zeros((*millimetres.shape, 3), np.uint8)
    image[..., 0], image[..., 1] = millimetres & 255, millimetres >> 8  # OpenCV: blue, green, red
    cv2.imwrite(str(path), image)


def test_nyu_is_read_as_it_is_distributed(tmp_path, monkeypatch):
    monkeypatch.setattr(nyu_module, 'FIRST_SUBJECT', 2)
    rng = np.random.default_rng(1)
    train, test = write_nyu(tmp_path, 'train', 6, rng), write_nyu(tmp_path, 'test', 3, rng)
    sizes = {split: open_dataset('nyu', split, tmp_path).size for split in SPLITS}
    assert sizes == {'train': 5, 'val': 1, 'test': 3, 'test_1': 2, 'test_2': 1}

    dataset = open_dataset('nyu', 'test', tmp_path)
    frame = dataset.frame(1)
    np.testing.assert_allclose(frame.joints, test[1][list(nyu_module.JOINTS)], atol=1e-9)
    surface = blob(nyu_module.INTRINSICS, test[1].mean(0))
    np.testing.assert_allclose(frame.depth, surface, atol=0.0006)
    assert (frame.depth[surface == 0] == 0).all()
    assert [dataset.frame(i).cube_side for i in range(3)] == pytest.approx([0.3, 0.3, 0.249])
    val = open_dataset('nyu', 'val', tmp_path).frame(0)
    np.testing.assert_allclose(val.joints, train[5][list(nyu_module.JOINTS)])
    assert val.cube_side == 0.3, 'only the second subject that tests has a smaller hand'

    batch = dataset.batch(torch.tensor([2, 0]))
    metres = joints_in_metres(batch['joints'], batch['cube_center'], batch['cube_side'])
    np.testing.assert_allclose(metres, test[[2, 0]][:, list(nyu_module.JOINTS)], atol=1e-5)


def test_nyu_real_frame_and_its_published_label(tmp_path, shared_data):
    """The surface lies 3 to 33 mm in front of the labelled joints, where their label says."""
    with gzip.open(shared_data / 'published' / 'nyu' / 'groundtruth.txt.gz', 'rt') as file:
        uvd = np.array(file.readline().split(), float).reshape(14, 3)
    fx, fy = nyu_module.INTRINSICS.fx, nyu_module.INTRINSICS.fy
    xyz = np.zeros((3, 1, 36, 3))  # as in the dataset: mm, y up
    xyz[0, 0, nyu_module.JOINTS] = np.stack([(uvd[:, 0] - 320) * uvd[:, 2] / fx, (240 - uvd[:, 1]) * uvd[:, 2] / fy,
                                             uvd[:, 2]], axis=1)
    (tmp_path / 'test').mkdir()
    savemat(tmp_path / 'test' / 'joint_data.mat', {'joint_xyz': xyz})
    name = 'depth_1_0000001.png'
    (tmp_path / 'test' / name).symlink_to(shared_data / 'frames' / 'nyu' / name)

    dataset = open_dataset('nyu', 'test', tmp_path)
    frame = dataset.frame(0)
    np.testing.assert_allclose(frame.intrinsics.project(frame.joints), uvd[:, :2], atol=1e-6)
    batch = dataset.batch(torch.tensor([0]))
    patch, joints = batch['patch'][0, 0].numpy(), batch['joints'][0].numpy()
    columns, rows = ((joints[:, :2] + 1) * 64 - 0.5).round().astype(int).T
    behind_surface = (joints[:, 2] - patch[rows, columns]) * 150
    assert (behind_surface > 0).all() and (behind_surface < 40).all()


# ICVL

def write_icvl(root: Path, rng: np.random.Generator, labels: str = 'labels.txt') -> None:
    def write(path: Path, names: list[str]) -> None:
        lines = []
        for name in names:
            joints = scattered(rng, 16, np.array([0.0, 0.0, 0.4]))
            uv = icvl_module.INTRINSICS.project(joints)
            lines.append(' '.join([name, *(f'{u:.3f} {v:.3f} {z:.3f}' for (u, v), z in
                                           zip(uv, joints[:, 2] * 1000, strict=True))]))
            (root / 'Depth' / name).parent.mkdir(parents=True, exist_ok=True)
            depth = blob(icvl_module.INTRINSICS, joints.mean(0)) * 1000
            cv2.imwrite(str(root / 'Depth' / name), depth.round().astype(np.uint16))
        path.write_text('\n\n'.join(lines) + '\n \n')
    root.mkdir(parents=True, exist_ok=True)
    write(root / labels, ['201403121135/image_0000.png', '201403121135/image_0001.png', '45/image_0000.png',
                          '122-5/image_0000.png', '201405151126/image_0000.png'])
    write(root / 'test_seq_1.txt', ['test_seq_1/image_0000.png', 'test_seq_1/image_0001.png'])
    write(root / 'test_seq_2.txt', ['test_seq_2/image_0000.png'])


@pytest.mark.parametrize('labels', ['labels.txt', 'train.txt'])
def test_icvl_is_read_as_it_is_distributed(tmp_path, labels):
    write_icvl(tmp_path, np.random.default_rng(2), labels)
    sizes = {split: open_dataset('icvl', split, tmp_path).size for split in SPLITS}
    assert sizes == {'train': 2, 'val': 1, 'test': 3, 'test_1': 2, 'test_2': 1}  # rotated copies are left out
    frame = open_dataset('icvl', 'test', tmp_path).frame(2)
    words = (tmp_path / 'test_seq_2.txt').read_text().split()
    np.testing.assert_allclose(frame.intrinsics.project(frame.joints[3]), [float(w) for w in words[10:12]], atol=1e-6)
    assert frame.depth.max() == pytest.approx(0.4, abs=0.02)
    assert (frame.seed == frame.joints[0]).all() and frame.cube_side == 0.25
    (tmp_path / 'Testing').mkdir()
    for name in ('test_seq_1.txt', 'test_seq_2.txt', 'Depth'):
        (tmp_path / name).rename(tmp_path / 'Testing' / name)
    assert open_dataset('icvl', 'test', tmp_path).size == 3  # as distributed


def test_icvl_says_what_is_missing(tmp_path):
    with pytest.raises(DatasetError, match=r'neither .* holds labels\.txt or train\.txt'):
        open_dataset('icvl', 'train', tmp_path)
    write_icvl(tmp_path, np.random.default_rng(2))
    (tmp_path / 'Depth' / '201403121135' / 'image_0001.png').unlink()
    with pytest.raises(DatasetError, match=r'Depth/201403121135/image_0001\.png is missing'):
        open_dataset('icvl', 'train', tmp_path)
    (tmp_path / 'Depth' / '201405151126' / 'image_0000.png').write_bytes(b'half a download')
    with pytest.raises(DatasetError, match=r'image_0000\.png is damaged'):
        open_dataset('icvl', 'val', tmp_path).frame(0)
    (tmp_path / 'labels.txt').write_text('201403121135/image_0000.png 1 2 3')
    with pytest.raises(DatasetError, match=r'line 1 of .*labels\.txt'):
        open_dataset('icvl', 'train', tmp_path)


# MSRA15

def write_msra(root: Path, rng: np.random.Generator) -> np.ndarray:
    """Every subject has one gesture with frames 0, 1 and 3 of 4; returns the joints of P2, optical frame."""
    kept = None
    for subject in range(9):
        folder = root / f'P{subject}' / '1'
        folder.mkdir(parents=True)
        joints = np.stack([scattered(rng, 21, np.array([0.0, 0.0, 0.4])) for _ in range(4)])
        kept = joints if subject == 2 else kept
        lines = [' '.join(f'{value:.6f}' for value in frame.ravel()) for frame in joints * (1000, -1000, -1000)]
        (folder / 'joint.txt').write_text('4\n' + '\n'.join(lines) + '\n')
        for i in (0, 1, 3):
            header = np.array([320, 240, 100, 80, 220, 160], '<i4')
            part = (blob(icvl_module.INTRINSICS, joints[i].mean(0)) * 1000)[80:160, 100:220]
            (folder / f'{i:06d}_depth.bin').write_bytes(header.tobytes() + part.astype('<f4').tobytes())
    assert kept is not None
    return kept


def test_msra_leaves_one_subject_out_and_goes_by_file_name(tmp_path, monkeypatch):
    joints = write_msra(tmp_path, np.random.default_rng(3))
    sizes = {split: open_dataset('msra:P2', split, tmp_path).size for split in ('train', 'val', 'test')}
    assert sizes == {'train': 21, 'val': 3, 'test': 3}
    test = open_dataset('msra:P2', 'test', tmp_path)
    np.testing.assert_allclose(test.frame(2).joints, joints[3], atol=1e-8)  # the third file is frame 3
    surface = blob(icvl_module.INTRINSICS, joints[3].mean(0))
    np.testing.assert_allclose(test.frame(2).depth[80:160, 100:220], surface[80:160, 100:220], atol=1e-6)
    assert test.frame(2).depth[:80].max() == 0
    assert test.frame(0).cube_side == 0.2 and (test.frame(0).seed == test.frame(0).joints[5]).all()
    monkeypatch.setitem(msra_module.FAULTY, ('P3', '1'), {1})
    assert open_dataset('msra:P2', 'val', tmp_path).size == 2, 'wrong labels are left out'
    path = tmp_path / 'P2' / '1' / '000001_depth.bin'
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(DatasetError, match=r'000001_depth\.bin is damaged'):
        test.frame(1)
    with pytest.raises(DatasetError, match=r"no subject 'P9'"):
        open_dataset('msra:P9', 'test', tmp_path)


# Bags

BAG_CAMERA = Intrinsics(300, 300, 160, 120, 320, 240)


def write_hand(bag: BagWriter, stamp: int, side: str, joints: np.ndarray) -> None:
    bag.write_hands(stamp, 'camera', [labelled(side, joints)], HAND21)


def labelled(side: str, joints: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(id='0', side=side, score=1.0, joints=joints, confidence=np.ones(21, np.float32),
                           cube=Cube((0.1, 0.0, 0.5), 0.3))


def test_hands_of_one_image_have_sides_of_their_own_and_must_be_told_in_its_frame(tmp_path):
    joints = scattered(np.random.default_rng(4), 21, np.array([0.1, 0.0, 0.5]))
    for name, frame in (('train', 'camera'), ('test', 'world')):
        with BagWriter(tmp_path / name / 'mine.mcap') as bag:
            bag.write_depth(1000, 'camera', blob(BAG_CAMERA, joints.mean(0)), BAG_CAMERA)
            bag.write_hands(1000, frame, [labelled('right', joints), labelled('left', joints)], HAND21)
    train = open_dataset('bags', 'train', tmp_path)
    assert [train.frame(i).left for i in range(2)] == [False, True]
    assert train.frame(0).seed == pytest.approx(joints.mean(0))
    with pytest.raises(InputError, match="its joints are in frame 'world', but the images in 'camera'"):
        open_dataset('bags', 'test', tmp_path).frame(0)


def test_labelled_images_of_bags_are_samples_and_left_hands_are_mirrored_in(tmp_path, caplog):
    rng, camera = np.random.default_rng(4), BAG_CAMERA
    hands = []
    (tmp_path / 'train' / 'notes').mkdir(parents=True)  # is no bag
    with BagWriter(tmp_path / 'train' / 'mine') as bag:
        for i, side in enumerate(('left', 'right', 'right')):
            joints = scattered(rng, 21, np.array([0.1, 0.0, 0.5])).astype(np.float32)
            hands.append(joints)
            bag.write_depth(1000 + i, 'camera', blob(camera, joints.mean(0)), camera)
            if i == 1:
                continue  # a frame without a label
            write_hand(bag, 1000 + i, side, joints)
    dataset = open_dataset('bags', 'train', tmp_path)
    assert dataset.size == 2 and dataset.skeleton.name == 'hand21' and dataset.cube_side == 0.3
    batch = dataset.batch(torch.tensor([1, 0]))
    metres = joints_in_metres(batch['joints'], batch['cube_center'], batch['cube_side'])
    np.testing.assert_allclose(metres[0], hands[2], atol=1e-5)
    np.testing.assert_allclose(metres[1], hands[0] * (-1, 1, 1), atol=1e-5)  # a left hand is mirrored in
    assert (batch['patch'] < 1).float().mean() > 0.05
    assert not caplog.messages, 'every hand can be used as it is'
    with pytest.raises(DatasetError, match='val holds no bags'):
        open_dataset('bags', 'val', tmp_path)
    with BagWriter(tmp_path / 'train' / 'other.mcap') as bag:
        bag.write_hands(1, 'elsewhere', [labelled('right', hands[0])], Skeleton('other', HAND21.joint_names,
                                                                                HAND21.parents))
    with pytest.raises(DatasetError, match='train must hold hands of one skeleton, not of hand21, other'):
        open_dataset('bags', 'train', tmp_path)


@pytest.mark.parametrize('name', ['mine.mcap', 'mine'])
def test_bags_that_were_corrected_are_not_read_from_the_cache_and_those_that_were_moved_are(tmp_path, name):
    joints = scattered(np.random.default_rng(4), 21, np.array([0.1, 0.0, 0.5]))
    path, middle = tmp_path / 'train' / name, joints.mean(0)
    with BagWriter(tmp_path / 'train' / 'another.mcap') as bag:
        write_hand(bag, 1000, 'right', joints)

    def recorded(camera: Intrinsics, side: str, seconds: int, joints: np.ndarray = joints) -> str:
        shutil.rmtree(path, ignore_errors=True)
        with BagWriter(path) as bag:
            bag.write_depth(1000, 'camera', blob(BAG_CAMERA, middle), camera)
            write_hand(bag, 1000, side, joints)
        for file in (path, *path.rglob('*')):  # a folder does not become newer with what is in its files
            os.utime(file, (0, 0) if file.is_dir() else (seconds, seconds))
        return open_dataset('bags', 'train', tmp_path).fingerprint

    first = recorded(BAG_CAMERA, 'right', 1)
    assert recorded(BAG_CAMERA, 'right', 1) == first
    assert recorded(BAG_CAMERA, 'left', 1) != first
    assert recorded(BAG_CAMERA, 'right', 1, joints + 0.01) != first
    last = recorded(Intrinsics(310, 310, 160, 120, 320, 240), 'right', 2)
    assert last != first
    (tmp_path / 'moved').mkdir()
    (tmp_path / 'train').rename(tmp_path / 'moved' / 'train')
    assert open_dataset('bags', 'train', tmp_path / 'moved').fingerprint == last


def test_images_of_a_bag_are_found_in_whatever_order_they_were_recorded(tmp_path):
    rng, path = np.random.default_rng(4), tmp_path / 'train' / 'mine.mcap'
    middles = {stamp: np.array([0.0, 0.0, 0.4 + 0.1 * i]) for i, stamp in enumerate((1000, 1001, 1002))}
    with BagWriter(path) as bag:
        write = bag.write_serialized
        for at, stamp in enumerate((1001, 1002, 1000)):
            bag.write_serialized = lambda topic, kind, data, _, at=at, **more: write(topic, kind, data, at, **more)
            bag.write_depth(stamp, 'camera', blob(BAG_CAMERA, middles[stamp]), BAG_CAMERA)
            write_hand(bag, stamp, 'right', scattered(rng, 21, middles[stamp]))
        write_hand(bag, 1003, 'right', scattered(rng, 21, middles[1000]))
    dataset = open_dataset('bags', 'train', tmp_path)
    for index in (0, 1, 2, 1):
        depth = dataset.frame(index).depth
        np.testing.assert_allclose(depth, blob(BAG_CAMERA, middles[1000 + index]), atol=0.001)
    with pytest.raises(DatasetError, match=r'mine\.mcap has hands with the stamp 1003 ns, but no depth image with it'):
        dataset.frame(3)


def test_a_bag_is_read_once_and_stamps_may_be_those_of_another(tmp_path, monkeypatch):
    rng, opened, listed = np.random.default_rng(4), [], Path.glob
    monkeypatch.setattr(bags_module, 'DepthBag', lambda path: opened.append(path.stem) or DepthBag(path))
    for k, name in enumerate('ab'):
        with BagWriter(tmp_path / 'train' / f'{name}.mcap') as bag:
            for stamp in range(3):
                middle = np.array([0.0, 0.0, 0.4 + 0.1 * stamp + 0.05 * k])
                hand = labelled('right', scattered(rng, 21, middle))
                bag.write_depth(stamp, 'camera', blob(BAG_CAMERA, middle), BAG_CAMERA)
                bag.write_hands(stamp, 'camera', [hand, hand], HAND21)
    monkeypatch.setattr(Path, 'glob', lambda *where: sorted(listed(*where), reverse=True))  # disks differ in it
    dataset = open_dataset('bags', 'train', tmp_path)
    nearest = [dataset.frame(index).depth[120, 160] for index in (*range(12), 2, 8)]
    expected = [0.34, 0.34, 0.44, 0.44, 0.54, 0.54, 0.39, 0.39, 0.49, 0.49, 0.59, 0.59, 0.44, 0.49]
    assert nearest == pytest.approx(expected, abs=1e-3)
    assert opened == ['a', 'b', 'a', 'b']


@pytest.mark.parametrize('name', ['mine.bag', 'mine.mcap', 'mine.db3'])
def test_a_bag_that_cannot_be_read_is_named_and_not_passed_over(tmp_path, name):
    (tmp_path / 'train').mkdir()
    (tmp_path / 'train' / name).touch()
    with pytest.raises(InputError, match=rf'train/{name}: .*it is empty: record or copy it again'):
        open_dataset('bags', 'train', tmp_path)


def test_a_bag_that_is_damaged_is_not_learned_from_in_part(tmp_path):
    joints = scattered(np.random.default_rng(4), 21, np.array([0.1, 0.0, 0.5]))
    (tmp_path / 'train').mkdir()
    with BagWriter(tmp_path / 'whole.mcap') as bag:
        for stamp in range(12):
            bag.write_depth(stamp, 'camera', blob(BAG_CAMERA, joints.mean(0)), BAG_CAMERA, codec=None)
            write_hand(bag, stamp, 'right', joints)
    whole = (tmp_path / 'whole.mcap').read_bytes()
    (tmp_path / 'train' / 'cut.mcap').write_bytes(whole[:len(whole) * 3 // 4])
    assert read_hands(tmp_path / 'train' / 'cut.mcap', partly=True)
    with pytest.raises(InputError, match=r'cut\.mcap: the bag was cut short'):
        open_dataset('bags', 'train', tmp_path)


def test_hands_without_a_joint_are_left_out_and_those_without_a_side_are_told_of(tmp_path, caplog, monkeypatch):
    joints = scattered(np.random.default_rng(4), 21, np.array([0.1, 0.0, 0.5]))
    lost, unset = joints.copy(), joints.copy()
    lost[7], unset[:] = np.nan, 0
    with BagWriter(tmp_path / 'train' / 'mine.mcap') as bag:
        for stamp, hands in enumerate(([('right', joints)], [('left', lost), ('unknown', joints), ('right', joints)],
                                       [('left', unset)])):
            bag.write_depth(stamp, 'camera', blob(BAG_CAMERA, joints.mean(0)), BAG_CAMERA)
            bag.write_hands(stamp, 'camera', [labelled(*hand) for hand in hands], HAND21)
    with BagWriter(tmp_path / 'val' / 'mine.mcap') as bag:
        write_hand(bag, 0, 'left', unset)
    with caplog.at_level(logging.WARNING):
        dataset = open_dataset('bags', 'train', tmp_path)
        monkeypatch.setattr(multiprocessing, 'parent_process', lambda: 'the training')
        open_dataset('bags', 'train', tmp_path)  # as the processes that make samples do, which tell nothing again
    assert dataset.size == 3 and dataset.batch(torch.arange(3))['joints'].isfinite().all()
    assert not any(dataset.frame(index).left for index in range(3))
    left_out, sideless = caplog.messages
    assert 'mine.mcap: 2 of 5 hands' in left_out and 'left out' in left_out
    assert 'mine.mcap: the side of 1 of 3 hands is unknown' in sideless
    with pytest.raises(DatasetError, match='val must hold hands of one skeleton, not of none'):
        open_dataset('bags', 'val', tmp_path)


# All of them

def test_the_crop_is_centred_on_what_is_there():
    camera = Intrinsics(300, 300, 160, 120, 320, 240)
    cube = center_of_mass_cube(blob(camera, np.array([0.04, 0.02, 0.5])), Cube((0.0, 0.0, 0.52), 0.3), camera)
    np.testing.assert_allclose(camera.project(cube.center), camera.project([0.04, 0.02, 0.5]), atol=0.5)
    assert 0.44 < cube.center[2] < 0.48
    nothing = Cube((0.0, 0.0, 2.0), 0.3)
    assert center_of_mass_cube(np.zeros((240, 320), np.float32), nothing, camera) == nothing
    close = blob(camera, np.array([0.0, 0.0, 0.12]))
    near = center_of_mass_cube(close, Cube((0.0, 0.0, 0.12), 0.3), camera)
    assert near.center[2] == pytest.approx(close[close > 0].mean()), 'pixels without a reading are no surface'
    corner = Cube((-0.26, -0.2, 0.5), 0.3)  # partly outside of the image
    assert center_of_mass_cube(blob(camera, np.array(corner.center)), corner, camera).center[2] < 0.49
    outside = Cube((-0.6, 0.0, 0.5), 0.3)
    assert center_of_mass_cube(np.full((240, 320), 0.5, np.float32), outside, camera) == outside
    outside = Cube((0.0, -0.5, 0.5), 0.3)
    assert center_of_mass_cube(np.full((240, 320), 0.5, np.float32), outside, camera) == outside
    flat = Intrinsics(300, 100, 160, 120, 320, 240)
    strip = np.zeros((240, 320), np.float32)
    strip[120:160] = 0.5  # of which the cube holds 30 rows
    assert flat.project(center_of_mass_cube(strip, Cube((0.0, 0.0, 0.5), 0.3), flat).center)[1] == pytest.approx(134.5)


def test_training_hands_can_do_without_an_ingredient():
    numbers = torch.arange(8)
    complete = open_dataset('synthetic', 'train')
    noiseless, bare = (open_dataset(f'synthetic:without-{name}', 'train') for name in ('noise', 'everything'))
    assert len({complete.fingerprint, noiseless.fingerprint, bare.fingerprint}) == 3  # nor do they share shards
    a, b, c = (hands.batch(numbers) for hands in (complete, noiseless, bare))
    assert torch.equal(a['joints'], b['joints']) and not torch.equal(a['patch'], b['patch'])
    assert not torch.equal(a['joints'], c['joints'])
    held_out = open_dataset('synthetic:without-everything', 'val')
    assert torch.equal(held_out.batch(numbers)['patch'], open_dataset('synthetic', 'val').batch(numbers)['patch'])
    assert held_out.fingerprint == open_dataset('synthetic', 'val').fingerprint


def test_samples_of_other_code_are_not_those_of_a_cache(monkeypatch):
    before, read = open_dataset('synthetic', 'val').fingerprint, Path.read_bytes
    for changed in ('synthetic/generator.py', 'datasets/synthetic.py'):
        def as_changed(path: Path, name: str = changed) -> bytes:
            return read(path) + (b'#' if path.as_posix().endswith(name) else b'')
        monkeypatch.setattr(Path, 'read_bytes', as_changed)
        assert open_dataset('synthetic', 'val').fingerprint != before


def test_synthetic_hands_are_right_hands_to_the_network():
    from hand_pose_ros.synthetic.generator import SyntheticHands
    scene = SyntheticHands('val').batch(torch.arange(16))
    seen = open_dataset('synthetic', 'val').batch(torch.arange(16))
    left = scene['side'] == 1
    assert left.any() and not left.all()
    expected = scene['joints_m'].clone()
    expected[left, :, 0] *= -1
    metres = joints_in_metres(seen['joints'], seen['cube_center'], seen['cube_side'])
    torch.testing.assert_close(metres[seen['hand_present']], expected[seen['hand_present']], atol=1e-6, rtol=0)
    test, [judged] = open_dataset('synthetic', 'test').batch(torch.arange(8)), benchmark.frames(8)
    assert torch.equal(test['patch'], judged['patch'])  # it is synthetic-test-v1


@pytest.mark.parametrize(('name', 'split', 'message'), [
    ('nyuu', 'train', "unknown dataset 'nyuu'"), ('nyu', 'train', r'joint_data\.mat is missing'),
    ('msra', 'train', 'P2 with its gestures is missing'), ('bags', 'train', 'holds no bags'),
    ('synthetic', 'tset', "unknown split 'tset'"), ('synthetic:without-skin', 'train', 'synthetic:without-NAME'),
    ('icvl', 'train', 'give the folder of the dataset'), ('icvl', 'tset', "unknown split 'tset'")])
def test_what_is_not_there_is_one_sentence(tmp_path, name, split, message):
    with pytest.raises(DatasetError, match=message) as raised:
        open_dataset(name, split, tmp_path)
    assert '--' not in str(raised.value), 'the verbs have different options for the folder'


def test_shards_are_the_same_wherever_they_are_made_and_mended_when_damaged(tmp_path):
    write_icvl(tmp_path / 'icvl', np.random.default_rng(5))
    opening = partial(open_dataset, 'icvl', 'test', tmp_path / 'icvl')
    memory = MemoryShards(opening(), 2)
    disk = DiskShards(opening, tmp_path / 'cache', 2)
    try:
        disk.keep([0, 1])
        for number, size in ((0, 2), (1, 1)):  # three frames
            assert len(disk.read(number)['patch']) == size
            for key, value in memory.read(number).items():
                assert torch.equal(value, disk.read(number)[key])
        elsewhere = DiskShards(opening, tmp_path / 'cache', 2, device=torch.device('meta'))  # as a GPU would be
        assert {value.device.type for value in elsewhere.read(0).values()} == {'meta'}
        good = disk.path(0).read_bytes()
        for damage in (good[:-100], good[:-1] + bytes([good[-1] ^ 1]), b''):
            disk.keep([])
            disk.path(0).unlink()
            disk.path(0).write_bytes(damage)
            assert torch.equal(disk.read(0)['patch'], memory.read(0)['patch'])
            assert disk.path(0).read_bytes() == good
    finally:
        disk.close()
    assert not list((tmp_path / 'cache').rglob('*.tmp'))


def test_what_a_killed_process_left_of_a_shard_goes_when_that_is_made(tmp_path):
    write_icvl(tmp_path / 'icvl', np.random.default_rng(5))
    disk = DiskShards(partial(open_dataset, 'icvl', 'test', tmp_path / 'icvl'), tmp_path / 'cache', 2)
    left = disk.path(0).with_name(f'.{disk.path(0).name}.1234567.part')
    left.write_bytes(b'half of it')
    try:
        disk.read(0)
    finally:
        disk.close()
    assert not left.exists()


def test_a_missing_frame_stops_the_making_of_its_shard(tmp_path):
    write_icvl(tmp_path / 'icvl', np.random.default_rng(5))
    opening = partial(open_dataset, 'icvl', 'test', tmp_path / 'icvl')
    shards = DiskShards(opening, tmp_path / 'cache', 2)
    (tmp_path / 'icvl' / 'Depth' / 'test_seq_2' / 'image_0000.png').write_bytes(b'')
    try:
        with pytest.raises(DatasetError, match=r'test_seq_2/image_0000\.png is damaged'):
            shards.read(1)
    finally:
        shards.close()


def test_closing_ends_the_processes_at_once_and_reading_starts_them_again(tmp_path):
    write_icvl(tmp_path / 'icvl', np.random.default_rng(5))
    endless = DiskShards(partial(open_dataset, 'synthetic', 'train'), tmp_path / 'cache', 200_000)
    endless.keep([0, 1])
    endless.close()
    assert not multiprocessing.active_children()
    shards = DiskShards(partial(open_dataset, 'icvl', 'test', tmp_path / 'icvl'), tmp_path / 'cache', 2)
    try:
        for number in (0, 1):
            assert len(shards.read(number)['patch']) > 0
            shards.close()
    finally:
        shards.close()


def test_the_cache_forgets_what_was_used_longest_ago(tmp_path):
    write_icvl(tmp_path / 'icvl', np.random.default_rng(5))
    opening = partial(open_dataset, 'icvl', 'test', tmp_path / 'icvl')
    shards = DiskShards(opening, tmp_path / 'cache', 1, limit_gb=1e-4)  # room for three
    try:
        for number in (0, 1, 2, 0):
            assert shards.read(number)['joints'].shape == (1, 16, 3)
    finally:
        shards.close()
    assert sum(path.stat().st_size for path in (tmp_path / 'cache').rglob('*.safetensors')) <= 100_000


def test_a_cache_too_small_for_one_shard_is_used_all_the_same(tmp_path):
    write_icvl(tmp_path / 'icvl', np.random.default_rng(5))
    opening = partial(open_dataset, 'icvl', 'test', tmp_path / 'icvl')
    shards = DiskShards(opening, tmp_path / 'cache', 1, limit_gb=1e-6)
    try:
        assert [shards.read(number)['joints'].shape for number in (0, 1, 0)] == [(1, 16, 3)] * 3
    finally:
        shards.close()


def test_a_cache_is_not_used_after_depth_images_were_replaced(tmp_path):
    write_nyu(tmp_path / 'nyu', 'test', 2, np.random.default_rng(1))
    write_icvl(tmp_path / 'icvl', np.random.default_rng(2))
    write_msra(tmp_path / 'msra', np.random.default_rng(3))
    images = {'nyu': 'test/depth_1_0000002.png', 'icvl': 'Depth/test_seq_1/image_0001.png',
              'msra': 'P0/1/000001_depth.bin'}
    for name, image in images.items():
        before = open_dataset(name, 'test', tmp_path / name).fingerprint
        assert open_dataset(name, 'test', tmp_path / name).fingerprint == before
        path = tmp_path / name / image
        path.write_bytes(path.read_bytes()[:-1] + b'x')
        assert open_dataset(name, 'test', tmp_path / name).fingerprint != before


def test_images_of_another_size_are_refused(tmp_path):
    """They would be cropped somewhere else than where the hand is."""
    write_nyu(tmp_path / 'nyu', 'test', 1, np.random.default_rng(1))
    write_icvl(tmp_path / 'icvl', np.random.default_rng(2))
    write_msra(tmp_path / 'msra', np.random.default_rng(3))
    for name, image in (('nyu', 'test/depth_1_0000001.png'), ('icvl', 'Depth/test_seq_1/image_0000.png')):
        path = str(tmp_path / name / image)
        cv2.imwrite(path, cv2.imread(path, cv2.IMREAD_UNCHANGED)[::2, ::2])
    path = tmp_path / 'msra/P0/1/000000_depth.bin'
    path.write_bytes(np.array([640, 480], '<i4').tobytes() + path.read_bytes()[8:])
    for name, sizes in (('nyu', '320x240 .* have 640x480'), ('icvl', '160x120 .* have 320x240'),
                        ('msra', r'000000_depth\.bin has 640x480 .* have 320x240')):
        with pytest.raises(DatasetError, match=sizes):
            open_dataset(name, 'test', tmp_path / name).batch(torch.arange(1))


def test_recorded_frames_without_a_joint_are_left_out(tmp_path, caplog):
    write_icvl(tmp_path / 'icvl', np.random.default_rng(2))
    path = tmp_path / 'icvl/test_seq_1.txt'
    words = path.read_text().split()
    words[3] = '0'  # the depth of the palm in the first frame
    path.write_text(' '.join(words[:49]) + '\n' + ' '.join(words[49:]) + '\n')
    joints = write_nyu(tmp_path / 'nyu', 'test', 3, np.random.default_rng(1))
    joints[1, 0] = np.nan
    savemat(tmp_path / 'nyu/test/joint_data.mat', {'joint_xyz': np.stack([joints * (1000, -1000, 1000)] * 3)})
    assert [open_dataset(name, 'test', tmp_path / name).size for name in ('icvl', 'nyu')] == [2, 2]
    assert 'icvl-test: 1 of 3 hands have a joint that is not finite' in caplog.text
    assert 'nyu-test: 1 of 3 hands' in caplog.text
    assert torch.isfinite(open_dataset('nyu', 'test', tmp_path / 'nyu').batch(torch.arange(2))['joints']).all()


def test_other_damage_of_recorded_datasets_is_one_sentence(tmp_path):
    write_nyu(tmp_path / 'nyu', 'test', 2, np.random.default_rng(1))
    with pytest.raises(DatasetError, match='no labelled frame of test_2 among its 2'):
        open_dataset('nyu', 'test_2', tmp_path / 'nyu')
    savemat(tmp_path / 'nyu/test/joint_data.mat', {'joint_xyz': np.zeros((3, 36, 2))})
    with pytest.raises(DatasetError, match=r'joint_data\.mat is damaged .* shape \(36, 2\)'):
        open_dataset('nyu', 'test', tmp_path / 'nyu')
    write_icvl(tmp_path / 'icvl', np.random.default_rng(2))
    lines = [line for line in (tmp_path / 'icvl/labels.txt').read_text().splitlines() if '20140515' not in line]
    (tmp_path / 'icvl/labels.txt').write_text('\n'.join(lines))
    with pytest.raises(DatasetError, match='sequence 201403121135, which validates'):
        open_dataset('icvl', 'train', tmp_path / 'icvl')
    (tmp_path / 'icvl/labels.txt').write_bytes(gzip.compress(b'201403121135/image_0000.png'))
    with pytest.raises(DatasetError, match='is not text; unpack it if it is packed'):
        open_dataset('icvl', 'train', tmp_path / 'icvl')
    huge = tmp_path / 'icvl/Depth/test_seq_1/image_0000.png'
    header = b'IHDR' + struct.pack('>IIBBBBB', 65536, 32768, 16, 0, 0, 0, 0)
    huge.write_bytes(b'\x89PNG\r\n\x1a\n' + struct.pack('>I', 13) + header + struct.pack('>I', zlib.crc32(header)))
    with pytest.raises(DatasetError, match=r'image_0000\.png is damaged'):
        open_dataset('icvl', 'test', tmp_path / 'icvl').frame(0)


def test_a_shared_cache_can_be_read_by_others_and_what_cannot_be_read_is_kept(tmp_path, monkeypatch):
    write_icvl(tmp_path / 'icvl', np.random.default_rng(5))
    shards = DiskShards(partial(open_dataset, 'icvl', 'test', tmp_path / 'icvl'), tmp_path / 'cache', 1)
    (tmp_path / 'usual').touch()
    try:
        shards.read(0)
        assert shards.path(0).stat().st_mode == (tmp_path / 'usual').stat().st_mode

        def refuse(*_):
            raise PermissionError(13, 'Permission denied')

        monkeypatch.setattr('hand_pose_ros.datasets.shards.os.utime', refuse)  # as on a file of another user
        shards.keep([])
        assert shards.read(0)['joints'].shape == (1, 16, 3)
        monkeypatch.setattr('hand_pose_ros.datasets.shards.os.open', refuse)
        shards.keep([])
        with pytest.raises(DatasetError, match=r'000000\.safetensors cannot be read \(Permission denied\)'):
            shards.read(0)
        assert shards.path(0).exists()
    finally:
        shards.close()
