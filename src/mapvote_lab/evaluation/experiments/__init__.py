"""What is varied."""
