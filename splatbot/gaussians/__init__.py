"""The Gaussian map and its snapshots."""

from splatbot.gaussians.model import GaussianModel
from splatbot.gaussians.snapshot import Snapshot

__all__ = ["GaussianModel", "Snapshot"]
