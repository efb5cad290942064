"""The whole state of a run on disk: written atomically, read with checks, without pickle."""

from splatbot.run.state.checkpoint import Checkpoint, SavedRun

__all__ = ["Checkpoint", "SavedRun"]
