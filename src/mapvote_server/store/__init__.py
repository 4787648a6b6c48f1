"""SQL, the only system of record."""
