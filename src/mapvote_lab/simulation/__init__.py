"""Streets, LiDARs and drives that never existed, with the truth beside them (paper V)."""

from mapvote_lab.simulation.drives import simulate

__all__ = ["simulate"]
