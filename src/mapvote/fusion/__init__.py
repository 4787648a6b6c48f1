"""The second vote and the edit of a tile (paper IV); pure."""
