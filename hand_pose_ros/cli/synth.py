"""`hand-pose synth`: draw synthetic hands, write them to disk, and compare them with real ones."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from hand_pose_ros.bags import BagWriter
from hand_pose_ros.cli.arguments import count, none_or_more
from hand_pose_ros.drawing import FINGER_COLORS, Picture, caption, contact_sheet
from hand_pose_ros.errors import HandPoseError, counted
from hand_pose_ros.evaluation.tables import text_table
from hand_pose_ros.files import in_one_step, write_bytes
from hand_pose_ros.geometry import Cube
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.runtime import check_device
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic.generator import LEFT, SyntheticHands
from hand_pose_ros.synthetic.rig import Rig
from hand_pose_ros.synthetic.sensors import SENSORS
from hand_pose_ros.synthetic.stages import Ingredients
from hand_pose_ros.synthetic.statistics import real_patches, summarise

DESCRIPTION = 'Make or show synthetic hands, seen by simulated depth sensors: the networks are trained on these.'

EXAMPLES = """examples:
  hand-pose synth show hands.png --joints
  hand-pose synth show sensors.png --per-sensor --number 8
  hand-pose synth show both.png --sensors kinect2 --real frames/kinect2 363.9 363.9 255.4 206.3 0.001
  hand-pose synth write data/ --number 100000
  hand-pose synth record hand.mcap --sensors kinect2 --number 90
  hand-pose synth stats --sensors kinect2 --real frames/kinect2 363.9 363.9 255.4 206.3 0.001
"""
_COLUMNS = 8
_ZOOM = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument('--split', default='train', choices=('train', 'val', 'test'),
                        help='which hands, poses and seeds (train)')
    common.add_argument('--start', type=none_or_more, default=0, metavar='I', help='index of the first sample (0)')
    common.add_argument('--sensors', nargs='+', metavar='NAME',
                        help=f'any of {", ".join(sensor.name for sensor in SENSORS)} (all)')
    common.add_argument('--rig', type=Path, metavar='GLB', help="another skin: a glTF hand with WebXR's joint names")
    real = argparse.ArgumentParser(add_help=False)
    real.add_argument('--real', nargs=6, action='append', default=[],
                      metavar=('FOLDER', 'FX', 'FY', 'CX', 'CY', 'SCALE'),
                      help='folder of 16-bit depth PNGs, intrinsics in pixels, metres per unit; may be repeated')
    actions = parser.add_subparsers(dest='action', metavar='show|write|record|stats', required=True)

    show = actions.add_parser('show', parents=[common, real],
                              help='draw a contact sheet; left hands are mirrored, as networks see them')
    show.add_argument('out', type=Path, metavar='FILE', help='the PNG to write')
    show.add_argument('--number', type=count, default=48, metavar='N',
                      help='number of samples, or of columns per sensor (48)')
    show.add_argument('--joints', action='store_true', help='draw the joints; hidden ones are hollow')
    show.add_argument('--clean', action='store_true', help='show them as a perfect sensor would see them')
    show.add_argument('--per-sensor', action='store_true',
                      help='show the same hands for each sensor, one sensor per row')

    write = actions.add_parser('write', parents=[common], help='write a dataset in .npz shards')
    write.add_argument('out', type=Path, metavar='FOLDER')
    write.add_argument('--number', type=count, required=True, metavar='N', help='number of samples')
    write.add_argument('--shard', type=count, default=4096, metavar='N', help='samples per file (4096)')
    write.add_argument('--device', default='cpu', help='cpu, cuda or cuda:N (cpu)')

    record = actions.add_parser('record', parents=[common], help='write a bag of one moving hand, with its true joints')
    record.add_argument('out', type=Path, metavar='BAG', help='a .mcap or .db3 file, or the folder of a ROS 2 bag')
    record.add_argument('--number', type=count, default=90, metavar='N', help='number of images, 30 per second (90)')
    record.add_argument('--raw', action='store_true',
                        help='write depth as sensor_msgs/Image instead of compressedDepth')

    stats = actions.add_parser('stats', parents=[common, real], help='compare statistics of synthetic and real crops')
    stats.add_argument('--number', type=count, default=512, metavar='N', help='number of synthetic samples (512)')


def run(args: argparse.Namespace) -> int:
    """Do one of show, write, record and stats."""
    {'show': _show, 'write': _write, 'record': _record, 'stats': _stats}[args.action](args)
    return 0


def _hands(args: argparse.Namespace, sensors: list[str] | None, **options: Any) -> SyntheticHands:
    return SyntheticHands(args.split, sensors=sensors, hand=Rig(args.rig) if args.rig else None, **options)


def _indices(args: argparse.Namespace, step: int) -> tuple[Tensor, ...]:
    return torch.arange(args.start, args.start + args.number).split(step)


def _real(args: argparse.Namespace) -> Iterator[tuple[str, list[tuple[NDArray[np.float32], float]]]]:
    for folder, *numbers in args.real:
        try:
            *intrinsics, scale = map(float, numbers)
        except ValueError:
            raise HandPoseError(f'--real {folder} {" ".join(numbers)}: after the folder come five numbers, '
                                'FX FY CX CY SCALE') from None
        yield Path(folder).name, real_patches(Path(folder), intrinsics, scale)


def _show(args: argparse.Namespace) -> None:
    if not cv2.haveImageWriter(str(args.out)):
        raise HandPoseError(f'{args.out}: pictures of this kind cannot be written: give a name that ends in .png')
    names = args.sensors or [sensor.name for sensor in SENSORS]
    columns = min(_COLUMNS, args.number)
    number = columns if args.per_sensor else args.number
    pictures = []
    for name, patches in _real(args):
        shown = min(columns, len(patches))
        row = [_relief(patches[i * len(patches) // shown][0], f'real {name}') for i in range(shown)]
        pictures += row + [row[0] * 0] * (columns - len(row)) if row else []
    for group in [[name] for name in names] if args.per_sensor else [names]:
        hands = _hands(args, group, ingredients=Ingredients(noise=not args.clean))
        batch = hands.batch(torch.arange(args.start, args.start + number))
        for i in range(number):
            side = 'none' if not batch['hand_present'][i] else 'left' if batch['side'][i] == LEFT else 'right'
            label = f"{SENSORS[int(batch['sensor'][i])].name} {float(batch['cube_center'][i, 2]):.2f} m {side}"
            picture = _relief(batch['patch'][i, 0].numpy(), label)
            if args.joints and side != 'none':
                _draw_joints(picture, batch['joints'][i].numpy(), batch['visible'][i].numpy())
            pictures.append(picture)
    sheet = contact_sheet(pictures, columns)
    write_bytes(args.out, cv2.imencode(args.out.suffix, sheet)[1].tobytes())
    print(f'{args.out}: {counted(len(pictures), "pictures")}')


def _relief(patch: NDArray[np.float32], label: str) -> Picture:
    """A patch as a surface that is lit from the upper left. Nothing smooths it, so its noise can be judged."""
    slope_y, slope_x = np.gradient(patch * (len(patch) / 2))
    light = (0.4 * slope_x + 0.5 * slope_y + 0.77) / np.sqrt(slope_x ** 2 + slope_y ** 2 + 1)
    shade = np.clip(light, 0, 1) * 0.75 + 0.125 * (1 - patch)
    grey = np.where(patch < 1, shade * 255, 40).astype(np.uint8).repeat(_ZOOM, 0).repeat(_ZOOM, 1)
    picture: Picture = np.repeat(grey[..., None], 3, axis=2)
    caption(picture, label, (4, 12), 0.38)
    return picture


def _draw_joints(picture: Picture, joints: NDArray[np.float32], visible: NDArray[np.bool_]) -> None:
    at = ((joints[:, :2] + 1) * (len(picture) / 2)).round().astype(int).tolist()
    colors = [FINGER_COLORS[finger][::-1] for finger in HAND21.fingers]
    for parent, child in HAND21.bones:
        cv2.line(picture, at[parent], at[child], colors[child], 1, cv2.LINE_AA)
    for point, color, seen in zip(at, colors, visible, strict=True):
        cv2.circle(picture, point, 3, color, cv2.FILLED if seen else 1, cv2.LINE_AA)


def _write(args: argparse.Namespace) -> None:
    check_device(args.device)
    hands = _hands(args, args.sensors, device=args.device)
    args.out.mkdir(parents=True, exist_ok=True)
    for indices in tqdm(_indices(args, args.shard), unit='shard', disable=None):
        arrays: dict[str, Any] = {name: values.cpu().numpy() for name, values in hands.batch(indices).items()}
        arrays['index'] = indices.numpy()
        arrays['patch'] = arrays['patch'].astype(np.float16)  # exact to 0.1 mm
        path = args.out / f'{args.split}_{int(indices[0]):09d}.npz'
        with in_one_step(path) as part, part.open('wb') as file:
            np.savez_compressed(file, **arrays)


def _record(args: argparse.Namespace) -> None:
    """Depth with camera_info, as a camera publishes them, and the truth on a topic of its own."""
    sequence = _hands(args, args.sensors).sequence(args.start, args.number)
    with BagWriter(args.out) as bag:
        images = tqdm(sequence, total=args.number, unit='images', disable=None)
        for i, (depth, camera, joints, side) in enumerate(images):
            stamp, frame = (i + 1) * 1_000_000_000 // 30, 'camera_depth_optical_frame'
            middle = joints.mean(axis=0)
            truth = HandEstimate(joints, HAND21.joint_names, np.ones(len(HAND21), np.float32), 1.0, side,
                                 Cube.at(middle, 0.3), 'truth')
            bag.write_depth(stamp, frame, depth, camera, codec=None if args.raw else 'png')
            bag.write_hands(stamp, frame, [truth], topic='/truth/joints')
    print(f'{args.out}: {counted(args.number, "images")}')


def _stats(args: argparse.Namespace) -> None:
    columns = {f'real {name}': summarise(patches) for name, patches in _real(args)}
    hands, patches = _hands(args, args.sensors), []
    for indices in _indices(args, 64):
        batch = hands.batch(indices)
        patches += [(batch['patch'][i, 0].numpy(), float(batch['cube_side'][i]))
                    for i in batch['hand_present'].nonzero()[:, 0].tolist()]
    columns['synthetic'] = summarise(patches)
    print(text_table(('median (quartiles)', *columns), [
        (row, *(f'{column[row][1]:.3g} ({column[row][0]:.3g} - {column[row][2]:.3g})' for column in columns.values()))
        for row in columns['synthetic']]))
