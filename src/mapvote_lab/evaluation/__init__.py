"""Truth, metrics, cases and the report (paper V)."""
