"""What changed, who says so, and why."""
