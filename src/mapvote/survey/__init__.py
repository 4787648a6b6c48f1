"""The first map (paper II, [7], [9])."""
