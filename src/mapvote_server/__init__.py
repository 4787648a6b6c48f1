"""The central server (paper IV)."""
