"""Shapes of what changed: outlines, objects, GeoJSON, cut-out clouds, pictures."""
