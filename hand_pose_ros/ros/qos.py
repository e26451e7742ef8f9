"""Quality of service: what the topics ask for and offer."""

from __future__ import annotations

from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions

RESULTS = QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
"""Out: reliable connects to every subscriber."""
LATCHED = QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=1, reliability=QoSReliabilityPolicy.RELIABLE,
                     durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
"""Out, published once: whoever comes later still receives it."""


def sensor() -> QoSProfile:
    """In: best effort connects to every publisher, reliable or not, and only the newest image matters (REP-2003).

    A new profile each time, because overrides by parameters are written into it.
    """
    return QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)


def overriding_options() -> QoSOverridingOptions:
    """Let the user override history, depth and reliability by `qos_overrides.<topic>.subscription.*` parameters."""
    return QoSOverridingOptions.with_default_policies()


def policy_name(kind: int) -> str:
    """The policy that an event is about, as parameters spell it, e.g. `reliability`."""
    return str(qos_policy_name_from_kind(kind)).lower()
