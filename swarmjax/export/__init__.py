"""Exports policies in several formats: NumPy, ONNX, C99 and a Webots controller.

This package imports `policy_file`, the sensor responses of `sim`, and `run`, which reads a run's
checkpoint. Read `__main__.main` first.
"""
