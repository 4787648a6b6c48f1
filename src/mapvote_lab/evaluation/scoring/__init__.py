"""How good: cells, points, objects."""
