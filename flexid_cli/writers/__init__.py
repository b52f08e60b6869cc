"""Writers of logs: one container, one file."""
