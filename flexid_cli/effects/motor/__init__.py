"""Effects at the motor: its torque, its friction, its magnets."""
