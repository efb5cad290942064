"""Offline training of Gaussians on posed photographs and on the frames of a run."""
