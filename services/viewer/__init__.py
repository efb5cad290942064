"""A live view of maps in a web browser (viser)."""
