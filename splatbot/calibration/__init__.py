"""Calibration of cameras and sensors from logs."""
