"""One scan against the map: what changed (paper III)."""
