"""Effects at the load: its weight, its friction, its own flexibility."""
