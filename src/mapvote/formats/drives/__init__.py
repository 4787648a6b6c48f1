"""Recorded drives, a format a file."""
