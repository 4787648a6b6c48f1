"""Maps, a format a file."""
