"""A street, its traffic and its LiDAR (paper V): the truth comes from here."""
