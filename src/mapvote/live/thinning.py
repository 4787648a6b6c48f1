"""Which scans vote if the computer is too slow for all of them: evenly chosen, and none much older than its time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mapvote.core.record import record

Waiting = TypeVar("Waiting")


@record()
@dataclass(frozen=True, slots=True)
class ThinningRule:
    """When scans are left out."""

    crowded: int = 30
    """If more scans wait some are left out: a short stop of the process costs no scan."""
    relaxed: int = 5
    """None is left out any more once no more than these wait."""
    least_share: float = 0.2
    """Share of the scans that is admitted at least while they are crowded."""
    most: int = 120
    """Scans that wait at most: the memory that they take."""
    longest_s: float = 6.0
    """Time for which the scans that wait may take the computer at most, seconds; more are left out, evenly."""
    costs: int = 11
    """Scans whose median time tells how long the others will take: a search of the map slows a single one."""
    memory: float = 0.1
    """Weight of the newest scan in the usual time of a scan and between scans."""
    spare: float = 0.9
    """Share of the time between scans that voting may take."""


THINNING = ThinningRule()


class Thinning:
    """Which scans are left out if there is time for some of them only: evenly, never two where one is enough."""

    def __init__(self, rule: ThinningRule = THINNING) -> None:
        self._rule = rule
        self._period_s = 0.0
        self._cost_s = 0.0
        self._costs_s: deque[float] = deque(maxlen=rule.costs)
        self._credit = 0.0
        self._came_s = 0.0
        self._crowded = False

    def cost(self, seconds: float) -> None:
        """Time that a scan took."""
        self._cost_s += self._rule.memory * (seconds - self._cost_s)
        self._costs_s.append(seconds)

    @property
    def most(self) -> int:
        """Scans that may wait, by the time that each takes now. The first few, which load the kernels, do not tell."""
        if len(self._costs_s) < self._rule.costs:
            return self._rule.most
        usual_s = float(np.median(self._costs_s))
        return int(np.clip(self._rule.longest_s / max(usual_s, 1e-3), 2, self._rule.most))

    def admits(self, came_s: float, waiting: int) -> bool:
        """Whether the scan that arrived at ``came_s``, of any clock, shall vote while ``waiting`` others wait."""
        rule = self._rule
        self._period_s += rule.memory * (np.clip(came_s - self._came_s, 0.0, 1.0) - self._period_s)
        self._came_s = came_s
        crowd = min(rule.crowded, self.most)
        if self._crowded != (waiting > (min(rule.relaxed, crowd - 1) if self._crowded else crowd)):
            self._crowded = not self._crowded
            self._credit = 1.0
        if not self._crowded:
            return True
        self._credit += np.clip(rule.spare * self._period_s / max(self._cost_s, 1e-3), rule.least_share, 0.95)
        if self._credit < 1.0 or waiting > rule.most:
            return False
        self._credit -= 1.0
        return True

    def shed(self, waiting: deque[Waiting]) -> int:
        """Leave out scans that wait, evenly, where all of them would take too long; returns how many. The oldest and
        the newest stay."""
        most = self.most
        scans = len(waiting)
        if scans <= most:
            return 0
        kept = [waiting[i] for i in np.linspace(0, scans - 1, most).round().astype(np.int64).tolist()]
        waiting.clear()
        waiting.extend(kept)
        return scans - most
