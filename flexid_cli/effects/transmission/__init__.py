"""Effects between motor and load: the law of the joint torque, the gear's kinematics."""
