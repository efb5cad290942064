"""Measurements of speed, and of what accuracy costs in time (`splatbot bench`)."""
