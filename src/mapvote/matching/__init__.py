"""Where the vehicle is (paper II)."""
