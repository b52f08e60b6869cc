"""Effects in the measurement only: stamps, sensors."""
