"""The HTTP service: reads snapshots of maps and answers questions about them."""
