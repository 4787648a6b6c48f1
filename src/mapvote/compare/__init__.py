"""Whole clouds and maps of one place against each other: registered, compared, voted by, merged."""
