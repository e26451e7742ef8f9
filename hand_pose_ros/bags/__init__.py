"""Bags without ROS: depth images with their camera out of ROS 1, sqlite3 and MCAP bags, and hands into new ones."""

from hand_pose_ros.bags.bag import Bag
from hand_pose_ros.bags.reader import DepthBag, Frame, RecordedHands, check_frame, read_hands
from hand_pose_ros.bags.writer import BagWriter

__all__ = ['Bag', 'BagWriter', 'DepthBag', 'Frame', 'RecordedHands', 'check_frame', 'read_hands']
