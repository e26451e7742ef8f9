"""`hand-pose replay`: publish a bag of any kind on ROS topics, with its recorded types and stamps."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hand_pose_ros.cli.arguments import number
from hand_pose_ros.errors import InputError

DESCRIPTION = 'Publish a bag (ROS 1, sqlite3, MCAP) on ROS 2 topics, with its recorded types and stamps.'

EXAMPLES = """examples:
  hand-pose replay recording.mcap
  hand-pose replay old_ros1.bag --rate 0.5 --loop
  hand-pose replay recording.mcap --clock --start 12.5 --topics /depth/image_rect /depth/camera_info
  hand-pose replay recording.mcap --ros-args -r /camera/depth/image_rect_raw:=/depth/image_rect \\
                                             -r /camera/depth/camera_info:=/depth/camera_info

Pause (true) and continue (false) with
  ros2 service call /replay/pause std_srvs/srv/SetBool "{data: true}"
"""
_MAX = 1e9
"""Largest rate, and largest time in seconds. The nanoseconds of longer times do not fit into messages."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('bag', metavar='BAG', type=Path, help='a .bag, .mcap or .db3 file, or a ROS 2 folder')
    parser.add_argument('--topics', nargs='+', metavar='TOPIC', help='publish only these')
    parser.add_argument('--rate', type=number, default=1.0, metavar='X', help='play X times as fast as recorded (1)')
    parser.add_argument('--loop', action='store_true', help='start again at the end, until Ctrl-C')
    parser.add_argument('--start', type=number, default=0.0, metavar='S', help='begin S seconds into the bag (0)')
    parser.add_argument('--start-paused', action='store_true', help='start paused; continue as below')
    parser.add_argument('--clock', action='store_true', help='publish /clock, for nodes with use_sim_time')
    parser.add_argument('--qos', default='recorded', choices=('recorded', 'reliable', 'best_effort'),
                        help='reliability of the publishers (recorded; ROS 1 bags: reliable)')
    parser.add_argument('--wait', type=number, default=4.0, metavar='S',
                        help='seconds to wait before the first message, so that subscribers find the topics; they may '
                             'need 3 (4)')
    parser.add_argument('--ros-args', nargs=argparse.REMAINDER, default=[], metavar='...',
                        help='remappings (-r from:=to) and other ROS arguments, as for ros2 run')


def run(args: argparse.Namespace) -> int:
    """Play until the end of the bag, or with --loop until Ctrl-C. Returns 1 if Ctrl-C came before the end.

    Raises:
        HandPoseError: there is no ROS, the bag cannot be read, or it is damaged and there is no --loop.
    """
    if not 0 < args.rate <= _MAX:
        args.parser.error(f'--rate {args.rate:g}: must be more than 0 and at most {_MAX:g}')
    for name in ('start', 'wait'):
        if not 0 <= getattr(args, name) <= _MAX:
            args.parser.error(f'--{name} {getattr(args, name):g}: must be 0 to {_MAX:g}')
    from hand_pose_ros.ros.replay import replaying  # without ROS, this says what is missing

    with replaying(args.bag, args.ros_args, topics=args.topics, rate=args.rate, reliability=args.qos, clock=args.clock,
                   paused=args.start_paused) as replay:
        topics = ', '.join(sorted(map(replay.name, replay.published)))
        print(f'{args.bag}: publishing {topics} after {args.wait:g} s, in which subscribers can find it', flush=True)
        code = 0
        try:
            replay.wait_for_subscribers(args.wait)
            said = False
            while True:
                before = sum(replay.published.values())
                try:
                    replay.play(args.start)
                except InputError as error:
                    if not args.loop or sum(replay.published.values()) == before:
                        raise
                    if not said:
                        print(f'NOTE: {error}; the loop starts again at the damage', file=sys.stderr)
                    said = True
                if not args.loop:
                    break
        except KeyboardInterrupt:
            code = int(not args.loop)  # a loop ends this way
        finally:
            for topic, count in sorted((replay.name(topic), count) for topic, count in replay.published.items()):
                print(f'{count:7d}  {topic}')
            if any(replay.published.values()):
                print(f'no message was published more than {1000 * replay.lateness_s:.0f} ms after its time')
    return code
