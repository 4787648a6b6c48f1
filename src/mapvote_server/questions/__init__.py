"""Questions on changes: where, by whom and why."""
