"""The curriculum: its engine, and the modes that decide."""
