"""Episodes as a page or a film."""
