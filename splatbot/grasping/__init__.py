"""Grasping: locate a target from a hint, and sample, score and rank antipodal grasps of it."""
