"""Which problems are logged, and what happened to the images of the last second, for /diagnostics (REP-107)."""

from __future__ import annotations

import math
import re
import threading
import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from hand_pose_ros.errors import counted
from hand_pose_ros.ros.topics import remedy_for_lost_images

MAX_DROPPED = 0.2
"""If a larger share of images is dropped or lost, there is a warning."""
MIN_SAMPLE = 10
"""Shares of fewer images than this mean nothing."""
LATE = 2.0
"""An image is late after this many times the time between the last two. A slow camera leaves whole seconds without one.
"""
REPEAT_S = 30.0
"""The same complaint is logged again after this time."""
MAX_AGE_S = 10.0
"""Images older than this come from a bag, not from a camera, so their age means nothing."""
MAX_KINDS = 100
"""Maximum number of different complaints that are remembered."""


@dataclass
class _Window:
    """Counts and times between two reports."""

    since: float
    counts: Counter[str] = field(default_factory=Counter)
    seconds: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    problem: str = ''


class Complaints:
    """Decides which problems are logged. Several threads may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._logged_at: dict[str, float] = {}

    def is_news(self, problem: str) -> bool:
        """Whether to log a problem: once, and again after REPEAT_S. Other numbers in it make no new problem."""
        kind, now = re.sub(r'\d+', '#', problem), time.monotonic()
        with self._lock:
            if now - self._logged_at.get(kind, -REPEAT_S) < REPEAT_S:
                return False
            if len(self._logged_at) >= MAX_KINDS:
                self._logged_at.clear()
            self._logged_at[kind] = now
            return True


class Statistics:
    """Counts (received, dropped, waited, refused, answered; camera_infos, hands) and times. Several threads may use it.

    `waited` counts the dropped images that were overtaken while another image waited for its camera_info.

    Attributes:
        failure: why a lifecycle transition failed; empty if none did.
        silence: why no images arrive; empty if they do.
    """

    def __init__(self) -> None:
        self.failure = self.silence = ''
        self._lock = threading.Lock()
        self._window = _Window(time.perf_counter())
        self._totals: Counter[str] = Counter()
        self._arriving: Counter[str] = Counter()
        self._arrived: Counter[str] = Counter()
        self._received_at, self._interval = -math.inf, 0.0  # seconds: of the last image, and since the one before it
        self._told = DiagnosticStatus.OK, '0 images answered, 0 hands'  # of the last window that finished an image

    def count(self, **counts: int) -> None:
        """Add to the named counts."""
        with self._lock:
            self._window.counts.update(counts)
            self._totals.update(counts)
            if counts.get('received'):
                now = time.perf_counter()
                self._received_at, self._interval = now, now - self._received_at

    def time(self, **seconds: float) -> None:
        """Add a time in seconds to each of the named stages."""
        with self._lock:
            for stage, value in seconds.items():
                self._window.seconds[stage].append(value)

    def age(self, nanoseconds: int) -> None:
        """Add the time from the stamp of an image to its answer. Ignored if the two clocks differ."""
        if 0 <= nanoseconds < MAX_AGE_S * 1e9:
            self.time(age=nanoseconds / 1e9)

    def problem(self, text: str) -> None:
        """Remember what is wrong, for the next report."""
        with self._lock:
            self._window.problem = text

    def report(self, node: str, state: str, published: bool, facts: dict[str, str]) -> DiagnosticStatus:
        """The status for the time since the last report. This starts a new period.

        Args:
            node: its name.
            state: of the node, for example `active`.
            published: whether anybody publishes images that can arrive. If not, none are lost on the way.
            facts: more keys and values.
        """
        with self._lock:
            now = time.perf_counter()
            window, self._window = self._window, _Window(now)
            totals = dict(self._totals)
            late = now - self._received_at > LATE * self._interval
        elapsed = now - window.since
        counts = window.counts
        self._count_arrivals(counts if state == 'active' and published else Counter())
        level, message = self._judge(window, state, late)
        if _finished(counts) and state == 'active' and not self.failure:
            self._told = level, message
        values = {'state': state, 'input_hz': f'{counts["received"] / elapsed:.1f}',
                  'output_hz': f'{counts["answered"] / elapsed:.1f}'}
        for stage, seconds in window.seconds.items():
            values[f'{stage}_p50_ms'] = f'{np.percentile(seconds, 50) * 1e3:.2f}'
            values[f'{stage}_p95_ms'] = f'{np.percentile(seconds, 95) * 1e3:.2f}'
        values |= {f'{what}_total': str(totals.get(what, 0))
                   for what in ('received', 'dropped', 'refused', 'answered', 'hands')}
        values |= facts
        return DiagnosticStatus(level=level, name=f'{node}: hand pose', message=message,
                                values=[KeyValue(key=key, value=value) for key, value in values.items()])

    def _count_arrivals(self, counts: Counter[str]) -> None:
        """Count what arrived in one window, or in several windows if the camera is slow."""
        if not counts['camera_infos']:
            self._arriving, self._arrived = Counter(), Counter()
        self._arriving.update({what: counts[what] for what in ('camera_infos', 'received')})
        if self._arriving['camera_infos'] >= MIN_SAMPLE:
            self._arrived, self._arriving = self._arriving, Counter()

    def _judge(self, window: _Window, state: str, late: bool) -> tuple[bytes, str]:
        """Level and message of the worst problem."""
        counts, arrived = window.counts, self._arrived
        if self.failure:
            return DiagnosticStatus.ERROR, self.failure
        if window.problem:
            return DiagnosticStatus.WARN, window.problem
        if state != 'active':
            return DiagnosticStatus.OK, f'the node is {state}'
        if self.silence:  # it says more than that images are missing
            return DiagnosticStatus.STALE, self.silence
        if arrived['received'] < (1 - MAX_DROPPED) * arrived['camera_infos']:
            return DiagnosticStatus.WARN, (
                f'{arrived["camera_infos"]} camera_info but only {counted(arrived["received"], "images")} arrived: if '
                f'there should be as many, {remedy_for_lost_images()}')
        if not _finished(counts):  # no image came, or its answer comes later
            return (DiagnosticStatus.STALE, 'no images') if late and not counts['received'] else self._told
        # Images that wait for their camera_info are reported elsewhere.
        too_many = counts['dropped'] - counts['waited'] > MAX_DROPPED * counts['received']
        if counts['received'] >= MIN_SAMPLE and too_many:
            return DiagnosticStatus.WARN, (
                f'{counts["dropped"]} of {counts["received"]} images of a second were dropped: this machine is too '
                'slow, or too busy, for their rate')
        return DiagnosticStatus.OK, (
            f'{counted(counts["answered"], "images")} answered, {counted(counts["hands"], "hands")}')


def _finished(counts: Counter[str]) -> int:
    """How many images were answered, refused or dropped."""
    return counts['answered'] + counts['refused'] + counts['dropped']
