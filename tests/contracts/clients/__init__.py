"""Programs of other people's libraries, run in processes of their own against a running service."""
