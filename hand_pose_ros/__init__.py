"""Metric 3D hand joints from depth images, in real time, with or without ROS 2.

Importing the package is light: no torch, no OpenCV, no ROS. Every bag reader, echo and viewer that needs only the
generated ``hand_pose_ros.msg`` runs this file.
"""

import pkgutil

__version__ = '0.1.0'

# A source tree shadows the installed package, and only the installed one has the generated `msg` (and its type
# support). Extending the path lets both be found, source files first.
__path__ = pkgutil.extend_path(__path__, __name__)
