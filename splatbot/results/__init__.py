"""Output files of a run and their scores."""
