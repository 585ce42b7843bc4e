"""Recordings and servo models as tables, ONNX and TorchScript."""
