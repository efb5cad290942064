"""Drivers against devices that are not there but speak their bytes."""
