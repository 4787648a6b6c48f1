"""Recorded messages in the order of their stamps, also where headers lack stamps, or stamps are out of order, doubled
or of two passes.

Receipt is not the order of measurement: drivers of several threads, a re-recording under ``use_sim_time`` or files
joined in another order leave stamps that go back. A stamp that cannot be a time of this drive is left out and counted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.record import record
from mapvote.core.types import I64


@record()
@dataclass(frozen=True, slots=True)
class StampRules:
    """Bounds on the stamps of one sensor on one drive."""

    day_ns: int = 86_400 * 10**9
    """No stamp is farther than this from the median stamp, nanoseconds: before a clock is set, stamps are 0 or count
    from the boot of the computer."""
    set_back_ns: int = 10**9
    """A stamp smaller by this than the one received before it begins another part of the recording, nanoseconds."""
    part: int = 10
    """Parts of fewer messages in the mean are disorder, and are sorted; longer ones may be passes."""
    dense: float = 0.75
    """A step between sorted stamps of less than this share of the recorded one lies between two passes."""
    overlap: float = 0.1
    """Share of such steps from which on there are two passes."""


STAMP_RULES = StampRules()


@dataclass(frozen=True, slots=True)
class StampOrder:
    """Which messages are used, in their order."""

    chosen: I64
    """(m,) numbers of messages as they were received, by ascending stamp."""
    stamps_ns: I64
    """(m,) strictly ascending."""
    told: list[str]
    """Mended and omitted stamps in words, after "the topic"."""


def in_order_of_stamps(stamps_ns: I64, received_ns: I64, rules: StampRules = STAMP_RULES) -> StampOrder:
    """The order of messages by the stamps of their headers (n,), given in the order of their receipt (n,)."""
    lines: list[str] = []
    chosen = np.arange(len(stamps_ns))
    stamps = stamps_ns
    # Headers without stamps: the time of receipt is the only one.
    if len(stamps) and (stamps == 0).all():
        lines.append("has no stamps in its headers; the times of receipt are used")
        stamps = received_ns
    # Stamps of a clock that was not set yet.
    if len(stamps):
        far = np.abs(stamps - np.int64(np.median(stamps))) > rules.day_ns
        if far.any():
            zero = int((stamps[far] == 0).sum())
            cause = f"{zero} of them 0: use_sim_time before the first /clock" if zero else "a clock that was set later"
            lines.append(f"has {int(far.sum())} stamps of another day ({cause}); these messages are left out")
            chosen = chosen[~far]
    # A bag played in a loop, or two recordings joined: one pass is a drive.
    passes = _passes(stamps[chosen], rules)
    if len(passes) > 1:
        longest = max(passes, key=len)
        lines.append(
            f"has stamps that were set back {len(passes) - 1} times over the same time (a bag played in a loop, "
            f"recordings joined): the longest part is read, {len(chosen) - len(longest)} messages are left out"
        )
        chosen = chosen[longest]
    # The rest is sorted; the first of equal stamps is kept.
    back = int((np.diff(stamps[chosen]) < 0).sum())
    if back:
        lines.append(f"has stamps out of order in {back} places (use_sim_time, a driver of several threads): sorted")
    chosen = chosen[np.argsort(stamps[chosen], kind="stable")]
    equal = np.diff(stamps[chosen], prepend=stamps[chosen][:1] - 1) == 0
    if equal.any():
        lines.append(f"has {int(equal.sum())} stamps that an earlier message has too; these messages are left out")
    chosen = chosen[~equal]
    return StampOrder(chosen, stamps[chosen], lines)


def _passes(stamps_ns: I64, rules: StampRules) -> list[I64]:
    """The parts of a recording, as indices, if they are few and stamped over the same time; else one part.

    One pass in disorder is as dense as it was recorded once it is sorted. Two passes are denser where they overlap.
    """
    everything = np.arange(len(stamps_ns))
    steps = np.diff(stamps_ns)
    parts = np.split(everything, np.flatnonzero(steps < -rules.set_back_ns) + 1)
    if len(parts) < 2 or len(everything) < rules.part * len(parts):
        return [everything]
    recorded_ns = float(np.median(steps[steps > 0]))
    sorted_ns = np.diff(np.unique(stamps_ns)).astype(np.float64)
    return parts if (sorted_ns < rules.dense * recorded_ns).mean() > rules.overlap else [everything]
