"""The topics that the node listens to, and why nothing may arrive on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import QoSReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from hand_pose_ros.conventions import TRANSPORTS, ZSTD, ZSTD_REMEDY, camera_info_beside, join_transport, split_transport
from hand_pose_ros.detection import Region
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.ros import qos

try:
    from rclpy.event_handler import SubscriptionEventCallbacks
except ImportError:  # ROS 2 Humble
    from rclpy.qos_event import SubscriptionEventCallbacks

IMAGE, CAMERA_INFO, REGION = 'depth/image_rect', 'depth/camera_info', 'hand/region'


def input_topics(node: Node, transport: str) -> tuple[str, str]:
    """Resolved names of the depth image (with its transport) and of camera_info.

    If the image is remapped, camera_info follows it: it is expected beside the image, as in image_transport, unless it
    is remapped itself. The topics of the compressed transports follow the image, too. The image may also be remapped to
    a name that already ends in the transport.
    """
    image, info = node.resolve_topic_name(IMAGE), node.resolve_topic_name(CAMERA_INFO)
    if split_transport(image)[1] == transport:
        image = split_transport(image)[0]
    if info == node.resolve_topic_name(CAMERA_INFO, only_expand=True):
        info = camera_info_beside(image)
    return join_transport(image, transport), info


def subscribe(node: Node, message_type: type, topic: str, callback: Callable[..., None],
              complain: Callable[[str], None]) -> Subscription:
    """Listen to a sensor.

    The user may override history, depth and reliability with the parameters `qos_overrides.<topic>.subscription.*`.

    Args:
        complain: called with a message if the quality of service of a publisher does not fit.

    Raises:
        HandPoseError: the parameters of the user are not a valid quality of service.
    """
    def incompatible(event: Any) -> None:
        complain(explain_incompatible(node, topic, qos_policy_name_from_kind(event.last_policy_kind).lower()))

    try:
        return node.create_subscription(
            message_type, topic, callback, qos.sensor(),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible))
    except (RuntimeError, ParameterException) as error:
        raise HandPoseError(f'cannot listen to {topic} ({error}): correct the parameters '
                            f'qos_overrides.{topic}.subscription.*') from error


def subscribe_latched(node: Node, message_type: type, topic: str, callback: Callable[..., None]) -> Subscription | None:
    """Also listen to latched messages, which were published once before. None if there is no latched publisher.

    This needs all publishers to be transient local: any other would log an incompatible QoS. If another publisher comes
    later, the ordinary subscription receives its messages. So there is no warning here.
    """
    infos = node.get_publishers_info_by_topic(topic)
    if not infos or any(info.qos_profile.durability != qos.LATCHED.durability for info in infos):
        return None
    return node.create_subscription(message_type, topic, callback, qos.LATCHED,
                                    event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))


def describe_publishers(node: Node, topic: str) -> str:
    """Who publishes on a topic and how, e.g. `published by /camera (sensor_msgs/msg/Image, best effort, volatile)`."""
    publishers = [
        f'{_name(info)} ({info.topic_type}, '
        f'{info.qos_profile.reliability.name.lower().replace("_", " ")}, '
        f'{info.qos_profile.durability.name.lower().replace("_", " ")})'
        for info in node.get_publishers_info_by_topic(topic)]
    return 'published by ' + ', '.join(sorted(publishers)) if publishers else 'without any publisher'


def _name(publisher: TopicEndpointInfo) -> str:
    if publisher.node_name == '_NODE_NAME_UNKNOWN_':  # its node is not discovered yet
        return 'a node'
    return f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}'


def can_arrive(node: Node, topic: str, message_type: type) -> bool:
    """Whether anybody publishes what the node listens to: messages of this type, as reliably as it asks for them."""
    fitting = _of_type(node, topic, message_type)
    return bool(fitting) and not _too_unreliable(node, topic, fitting)


def _of_type(node: Node, topic: str, message_type: type) -> list[TopicEndpointInfo]:
    return [info for info in node.get_publishers_info_by_topic(topic) if info.topic_type == _type_name(message_type)]


def _type_name(message_type: type) -> str:
    return f'sensor_msgs/msg/{message_type.__name__}'


def _too_unreliable(node: Node, topic: str, publishers: Sequence[TopicEndpointInfo]) -> bool:
    """Whether the node listens reliably, but none of these publishers is reliable."""
    wanted = QoSReliabilityPolicy.RELIABLE
    return all(info.qos_profile.reliability != wanted for info in publishers) and any(
        listener.topic_name == topic and listener.qos_profile.reliability == wanted for listener in node.subscriptions)


def explain_silence(node: Node, topic: str, message_type: type, seconds: float) -> str:
    """Why no image may have arrived for some seconds, and what to do.

    Args:
        topic: resolved name of the topic.
        message_type: the type that is expected on it.
        seconds: how long no image has arrived.
    """
    topic_type = _type_name(message_type)
    said = f'no image arrived on {topic} for {seconds:.0f} s; the topic is {describe_publishers(node, topic)}'
    infos, fitting = node.get_publishers_info_by_topic(topic), _of_type(node, topic, message_type)
    image, _ = split_transport(topic)
    if not infos:
        for transport in TRANSPORTS:
            other = join_transport(image, transport)
            if other != topic and node.count_publishers(other):
                return (f'{said}, but depth is published on {other}: set the parameter transport to {transport} '
                        f'(at the start: --ros-args -p transport:={transport})')
    zstd = f'{image.removesuffix(f"/{ZSTD}")}/{ZSTD}'
    if not fitting and node.count_publishers(zstd):
        return f'{said}, but on {zstd} there are images: {ZSTD_REMEDY}'
    if not infos:
        ours = {topic, *(publisher.topic_name for publisher in node.publishers)}
        others = [name for name, types in node.get_topic_names_and_types() if topic_type in types and name not in ours]
        where = f' ({topic_type} is published on {", ".join(others)})' if others else ''
        return f'{said}{where}: start the camera, or name its topic with --ros-args -r {IMAGE}:=/its/topic'
    if not fitting:
        return f'{said}, but {topic_type} is expected: remap {IMAGE}, or set the parameter transport'
    if _too_unreliable(node, topic, fitting):
        return explain_incompatible(node, topic, 'reliability')
    return f'{said}: if it does publish, {remedy_for_lost_images()}'


def region_problem(node: Node, regions: Sequence[Region], width: int, height: int) -> str:
    """Why the detector `region` looks for no hand in images of this size, and what to do. Empty if it does look, or if
    a region says that there is no hand.
    """
    topic = node.resolve_topic_name(REGION)
    if not regions:
        return (f'no region arrived on {topic}, so no hand is looked for: publish where it is in the depth image, or '
                'set the parameter detector to network')
    left, top, across, down = regions[0]
    if across and down and (left >= width or top >= height):
        return (f'the region on {topic} begins at pixel ({left}, {top}), outside of the image of {width}x{height}: '
                'give it in pixels of the depth image')
    return ''


def remedy_for_lost_images() -> str:
    """What to do if large images do not get through."""
    if 'fastrtps' not in (name := qos.middleware()):
        return (f'let {name} pass large messages (docs.ros.org: DDS tuning information), or send images with '
                'the transport compressedDepth')
    return f'start the camera driver with {"=".join(qos.large_image_profile())} in its environment (Fast DDS)'


def explain_incompatible(node: Node, topic: str, policy: str) -> str:
    """One sentence about a publisher whose quality of service does not fit the subscription."""
    fits = {'reliability': 'best_effort', 'durability': 'volatile'}.get(policy, '...')
    return (f'a publisher on {topic} does not offer the {policy} that was asked for, so nothing arrives from it (the '
            f'topic is {describe_publishers(node, topic)}): start this node '
            f'with --ros-args -p qos_overrides.{topic}.subscription.{policy}:={fits}')
