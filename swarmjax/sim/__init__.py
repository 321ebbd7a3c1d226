"""The robot and its world: model, drive, physics, infrared."""
