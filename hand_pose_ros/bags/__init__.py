"""Bags without ROS: read depth images and camera_info from ROS 1, sqlite3 and MCAP bags; write hands to new ones."""

from hand_pose_ros.bags.bag import Bag
from hand_pose_ros.bags.reader import DepthBag, Frame, RecordedHands, check_frame, read_hands
from hand_pose_ros.bags.writer import BagWriter

__all__ = ['Bag', 'BagWriter', 'DepthBag', 'Frame', 'RecordedHands', 'check_frame', 'read_hands']
