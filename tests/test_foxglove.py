"""What the Foxglove layout promises: every panel is placed, and shows topics that the node really has."""

import json
import re

from hand_pose_ros.resources import resource


def panels(layout) -> list[str]:
    return [layout] if isinstance(layout, str) else panels(layout['first']) + panels(layout['second'])


def test_the_layout_shows_the_topics_of_the_node() -> None:
    text = resource('foxglove/hand_pose.json').read_text()
    layout = json.loads(text)
    assert sorted(panels(layout['layout'])) == sorted(layout['configById'])
    topics = set(re.findall(r'"(/[a-z_/]+)', text))
    assert topics == {'/depth/image_rect', '/depth/camera_info', '/hand/markers', '/hand/poses',
                      '/estimator/debug/crop', '/diagnostics'}
    assert layout['configById']['3D!hands']['topics']['/hand/markers']['visible']
