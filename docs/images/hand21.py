"""Draws hand21.png: the 21 joints in the package's own synthetic hand. `python docs/images/hand21.py`"""

import argparse
from pathlib import Path

import cv2
import torch

from hand_pose_ros.drawing import FINGER_COLORS, Picture, draw_joints, shade
from hand_pose_ros.geometry import Intrinsics
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic.hand import HandModel, rest_pose
from hand_pose_ros.synthetic.renderer import View, depth_of, rasterise
from hand_pose_ros.synthetic.shapes import mean_shape

WIDTH, HEIGHT, FOCAL, DISTANCE = 1040, 900, 2550.0, 0.7


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    hand = HandModel()
    skin, joints = hand(mean_shape(), rest_pose()[None])
    # A right hand that shows its palm to the camera, fingers up: x right, y down, z forward.
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    skin, joints = (points @ turn + torch.tensor([-0.048, 0.095, DISTANCE]) for points in (skin, joints))
    one = torch.ones(1)
    view = View(FOCAL * one, FOCAL * one, WIDTH / 2 * one, HEIGHT / 2 * one, HEIGHT, WIDTH)
    depth = depth_of(rasterise(skin, hand.faces, view))[0].numpy()
    camera = Intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    picture = shade(depth, camera, near=DISTANCE - 0.06, far=DISTANCE + 0.12)
    draw_joints(picture, joints[0], camera)
    pixels = camera.project(joints[0])
    for number, (name, finger, (u, v)) in enumerate(zip(HAND21.joint_names, HAND21.fingers, pixels, strict=True)):
        color = FINGER_COLORS[finger][::-1]
        write(picture, str(number), (round(u) + 13, round(v) + 6), 0.6, (255, 255, 255))
        group, row = divmod(number - 1, 4)
        at = (700, 60) if number == 0 else (700, 110 + group * 158 + row * 32)
        write(picture, f'{number:2d}  {name}', at, 0.75, color)
    cv2.imwrite(str(Path(__file__).with_suffix('.png')), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def write(picture: Picture, text: str, at: tuple[int, int], size: float, color: tuple[int, ...]) -> None:
    for ink, thickness in (((0, 0, 0), 4), (color, 1)):
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, ink, thickness, cv2.LINE_AA)


if __name__ == '__main__':
    main()
