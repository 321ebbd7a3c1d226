"""Policies in other forms: ONNX, C99, Webots."""
