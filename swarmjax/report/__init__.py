"""What a run came to, on one page."""
