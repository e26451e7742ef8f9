"""What happened to the images of the last second, as one status of /diagnostics (REP-107)."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from hand_pose_ros.ros.topics import remedy_for_lost_images

MAX_DROPPED = 0.2
"""A larger share of dropped or lost images is worth a warning."""
MIN_SAMPLE = 10
"""Fewer than this tell nothing about shares."""
REPEAT_S = 30.0
"""The same complaint is logged again after so long."""
MAX_AGE_S = 10.0
"""Older images come from a bag, not from a camera: their age says nothing."""
MAX_KINDS = 100
"""So many different complaints are remembered."""


@dataclass
class _Window:
    """Counts and times between two reports."""

    since: float = field(default_factory=time.perf_counter)
    counts: Counter[str] = field(default_factory=Counter)
    seconds: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    problem: str = ''


class Statistics:
    """Counts (received, dropped, refused, answered; camera_infos, hands) and times; for use from several threads.

    Those `waited` are of the dropped ones, overtaken while another waited for its camera_info.

    Attributes:
        failure: why the node could not do as it was told, empty if it could.
        silence: why images stay away, empty if they do not.
    """

    def __init__(self) -> None:
        self.failure = self.silence = ''
        self._lock = threading.Lock()
        self._window = _Window()
        self._totals: Counter[str] = Counter()
        self._arriving: Counter[str] = Counter()
        self._arrived: Counter[str] = Counter()
        self._logged_at: dict[str, float] = {}

    def count(self, **counts: int) -> None:
        """Add to the counts that are named."""
        with self._lock:
            self._window.counts.update(counts)
            self._totals.update(counts)

    def time(self, **seconds: float) -> None:
        """Add a time to each of the stages that are named."""
        with self._lock:
            for stage, value in seconds.items():
                self._window.seconds[stage].append(value)

    def age(self, nanoseconds: int) -> None:
        """Add the time from the stamp of an image to its answer, unless the two clocks are not the same one."""
        if 0 <= nanoseconds < MAX_AGE_S * 1e9:
            self.time(age=nanoseconds / 1e9)

    def problem(self, text: str) -> None:
        """Remember what is wrong, for the next report."""
        with self._lock:
            self._window.problem = text

    def is_news(self, problem: str) -> bool:
        """Whether a problem should be logged: once, and again after a while; numbers do not make it another problem."""
        kind, now = re.sub(r'\d+', '#', problem), time.monotonic()
        with self._lock:
            if now - self._logged_at.get(kind, -REPEAT_S) < REPEAT_S:
                return False
            if len(self._logged_at) >= MAX_KINDS:
                self._logged_at.clear()
            self._logged_at[kind] = now
            return True

    def report(self, node: str, state: str, published: bool, facts: dict[str, str]) -> DiagnosticStatus:
        """The status of the time since the last report, which begins a new one.

        Args:
            node: its name.
            state: of the lifecycle, e.g. `active`.
            published: whether the topic of the images has a publisher; without one, none can be lost on the way.
            facts: more keys and values.
        """
        with self._lock:
            window, self._window = self._window, _Window()
            totals = dict(self._totals)
        elapsed = time.perf_counter() - window.since
        counts = window.counts
        self._count_arrivals(counts if state == 'active' and published else Counter())
        level, message = ((DiagnosticStatus.ERROR, self.failure) if self.failure
                          else _judge(window, state, self._arrived, self.silence))
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
        """What arrived in one window or, of slow cameras, in several."""
        if not counts['camera_infos']:
            self._arriving, self._arrived = Counter(), Counter()
        self._arriving.update({what: counts[what] for what in ('camera_infos', 'received')})
        if self._arriving['camera_infos'] >= MIN_SAMPLE:
            self._arrived, self._arriving = self._arriving, Counter()


def _judge(window: _Window, state: str, arrived: Counter[str], silence: str) -> tuple[bytes, str]:
    """Level and message: the worst that happened."""
    counts = window.counts
    if window.problem:
        return DiagnosticStatus.WARN, window.problem
    if state != 'active':
        return DiagnosticStatus.OK, f'the node is {state}'
    if silence:  # which knows more than that images are missing
        return DiagnosticStatus.STALE, silence
    if arrived['received'] < (1 - MAX_DROPPED) * arrived['camera_infos']:
        return DiagnosticStatus.WARN, (f'{arrived["camera_infos"]} camera_info but only {arrived["received"]} images '
                                       f'arrived: if there should be as many, {remedy_for_lost_images()}')
    if counts['received'] == 0:
        return DiagnosticStatus.STALE, 'no images'
    # That images wait for their camera_info is said in its time.
    too_many = counts['dropped'] - counts['waited'] > MAX_DROPPED * counts['received']
    if counts['received'] >= MIN_SAMPLE and too_many:
        return DiagnosticStatus.WARN, (f'{counts["dropped"]} of {counts["received"]} images of a second were dropped: '
                                       'this machine is too slow, or too busy, for their rate')
    return DiagnosticStatus.OK, f'{counts["answered"]} images answered, {counts["hands"]} hands'
